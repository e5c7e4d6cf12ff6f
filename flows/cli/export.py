"""`ss-flow export`: a finished run in other formats."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro
from rich.markup import escape

from ss_flow.cache.files import write_atomically
from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.flows import export as formats
from ss_flow.flows.cli.context import InStore, OptionalPath, StoreOptions, console, file_digests, open_run, references
from ss_flow.flows.cli.prepare import display
from ss_flow.flows.deliver import STATUS_EXIT, failure_records
from ss_flow.flows.results import BACKGROUND, FinishedRun, not_of_an_edit
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.deliver.export.coco import coco
from ss_flow.tasks.deliver.output import check_named
from ss_flow.tasks.deliver.places import Written, check_outside, check_replaceable, replacing_own
from ss_flow.tasks.deliver.undistorted import write_nerfstudio, write_undistorted
from ss_flow.tasks.geometry.images import suffix_of
from ss_flow.tasks.words import size_in_words

MANIFEST = "export.json"
EXPORT = Written(MANIFEST, "an earlier export")
_ADDED = {"labelled-ply": "-labelled", "gltf-flat": "-flat", "mesh-glb": "-mesh"}
"""What the default names of formats have before a suffix that is another's too."""
_MOST_IN_A_NAME = 3
"""Of the chosen instances, in the default name of their file."""
_ALSO_NEEDED = {"coco": ("ingest", "masks"), "colmap": ("ingest", "masks"), "nerfstudio": ("ingest",)}
"""Results of a run that only some formats are made of: an edited run has no masks."""


@dataclass(frozen=True)
class Export:
    """Write a result, or some of its instances, in another format."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    format: formats.Format
    """What to write; docs/export.md tells what each format carries and what it loses."""
    instance: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An instance by id or name, 0 = the background; may be given several times. All when left out."""
    each: bool = False
    """A file for each instance, in a folder with export.json; mesh-ply and mesh-obj are written so at all times."""
    holes: Literal["open", "closed"] = "open"
    """For meshes: "closed" closes by a guess what no view shows."""
    out: OptionalPath = None
    """The file or folder to write; by default in ss-flow-export: NAME of the result with the format's suffix, as in
    NAME.ply; NAME-labelled.ply, NAME-flat.glb and NAME-mesh.glb; NAME-0004.ply with --instance 4; and NAME-FORMAT,
    or NAME-0004-FORMAT, for a folder."""
    jobs: int = 0
    """How many tasks may run at once; 0 = one a core."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        workspace = self.format in formats.WORKSPACES
        self._check_options()
        run = open_run(self.result, self.store, ("scene", "cameras", *_ALSO_NEEDED.get(self.format, ())))
        several = self.each or self.format in formats.MESHES
        by_instance = several or self.format == "coco" or self.format in formats.SURFACES
        solid = self.format != "coco"  # masks show instances without Gaussians, too
        ids = (
            run.ids(self.instance, solid=solid) if self.instance else run.all_ids(solid=solid) if by_instance else None
        )
        folder = several or workspace
        out = self.out or Path("ss-flow-export") / f"{run.name}{self._ending(ids or (), folder=folder)}"
        self._check_place(out, run.store.location, folder=folder)
        if workspace:
            if "edit" in run.document:
                raise not_of_an_edit(run.folder, run.document, "photos")
            return self._write_workspace(out, run)
        if ids == ():
            lack = "has a file of its own" if solid else "is more than a crumb"
            raise InputError(
                f"no instance of {run.folder} {lack} (instances.json), so there is nothing to export; --instance names "
                "others, 0 the background."
            )
        if solid:
            _check_there(run.results.one("scene"), ids, run.folder)
        pixels = _masks_and_photos(run) if self.format == "coco" else ((), ())

        def build() -> dict[str, Any]:
            if self.format == "coco":
                return {"file": coco(masks=pixels[0], photos=pixels[1], names=run.names, instances=ids or ())}
            source = formats.Source(run.results.node("scene"), run.results.node("cameras"), run.names, ids)
            if several:
                return formats.a_file_each(source, self.format, self.holes)
            return {"file": formats.one_file(source, self.format, self.holes)}

        written: list[dict[str, Any]] = []

        def done(report: Report) -> None:
            written[:] = self._write(out, run, report, ids)

        with display(console(json=self.json)) as screen:
            request = Request(build, run.document["scene"], reporter=screen, done=done)
            (report,) = run_flows([request], run.store, jobs=self.jobs, recorded=False)
        return self._tell(out, report, written)

    def _check_options(self) -> None:
        """Raises InputError for options that mean nothing for the format, or are out of range."""
        if self.holes != "open" and self.format not in formats.SURFACES:
            raise InputError(f"--holes {self.holes} is for meshes, and {self.format} holds none.")
        if self.format in formats.WORKSPACES and (self.instance or self.each):
            raise InputError(f"--instance and --each are for parts of a scene; {self.format} holds photos and cameras.")
        if self.format == "coco" and self.each:
            raise InputError("--each is for formats of Gaussians and meshes; coco tells all instances in one file.")
        if self.jobs < 0:
            raise InputError(f"--jobs {self.jobs} is out of range; it must be 0 (one a core) or more.")

    def _ending(self, ids: tuple[int, ...], *, folder: bool) -> str:
        """What the default name has after that of the result: chosen instances must not replace the whole."""
        chosen = ""
        if self.instance and self.format != "coco":
            chosen = "".join(f"-{i:04d}" for i in ids) if len(ids) <= _MOST_IN_A_NAME else "-selected"
        if folder:
            return f"{chosen}-{self.format}"
        return chosen + _ADDED.get(self.format, "") + formats.suffix_of(self.format)

    def _check_place(self, out: Path, store: str, *, folder: bool) -> None:
        """Raises InputError unless the export can be written here: a new place, or that of an earlier export; and for
        a file that would be taken for one of another format by its name."""
        if folder:
            check_replaceable(out, EXPORT, store)
            return
        check_outside(out, store)
        check_named(out, "--out")
        own = formats.suffix_of(self.format)
        others = {formats.suffix_of(name) for name in get_args(formats.Format)} - {""} | {".gltf"}  # glTF's JSON form
        if out.suffix in others and not own.endswith(out.suffix):
            raise InputError(f"{out} is named like another format; a file of {self.format} ends in {own}.")

    def _write_workspace(self, out: Path, run: FinishedRun) -> int:
        """Write the photos and cameras that the run worked with."""
        frames, cameras = run.results.all("ingest"), run.results.one("cameras")
        with replacing_own(out, EXPORT) as filling:
            if self.format == "colmap":
                write_undistorted(filling, frames, cameras, run.results.all("masks"))
            else:
                write_nerfstudio(filling, frames, cameras)
            files = [
                {"file": str(file.relative_to(filling)), "instances": None, "bytes": file.stat().st_size}
                for file in sorted(filling.rglob("*"))
                if file.is_file()
            ]
            manifest = {"result": str(run.folder), "format": self.format, "files": files}
            (filling / MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
        return self._tell(out, None, files)

    def _write(self, out: Path, run: FinishedRun, report: Report, ids: tuple[int, ...] | None) -> list[dict[str, Any]]:
        """Write what came out; returns what each file is."""
        good = {name: value for name, value in report.values.items() if isinstance(value, str)}
        if not good and report.failures:
            raise report.failures[0].error
        if "file" in good:
            content = run.store.get(good["file"]).content.tobytes()
            write_atomically(out, content)
            return [{"file": out.name, "instances": None if ids is None else list(ids), "bytes": len(content)}]
        files = []
        with replacing_own(out, EXPORT) as filling:
            for name, value in good.items():
                content = run.store.get(value).content.tobytes()
                file = f"{int(name):04d}{formats.suffix_of(self.format)}"
                (filling / file).write_bytes(content)
                called = run.names.get(name, "background")
                files.append({"file": file, "instances": [int(name)], "name": called, "bytes": len(content)})
            manifest = {"result": str(run.folder), "format": self.format, "files": files}
            (filling / MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
        return files

    def _tell(self, out: Path, report: Report | None, files: list[dict[str, Any]]) -> int:
        failures = failure_records(report) if report else []
        status = "degraded" if failures else "ok"
        warnings = sorted({w for node in (report.nodes if report else ()) for w in node.get("warnings") or ()})
        if self.json:
            document = {"status": status, "format": self.format, "out": str(out), "files": files}
            print(json.dumps({**document, "warnings": warnings, "failures": failures}))
            return STATUS_EXIT[status]
        words = console(json=False)
        for failure in failures:
            words.print(f"[red]failed[/] {escape(failure['label'])}: {escape(failure['error'])}")
        told = size_in_words(sum(file["bytes"] for file in files))
        words.print(escape(f"{status}: {out} ({self.format}, {len(files)} file{'s' * (len(files) != 1)}, {told})"))
        return STATUS_EXIT[status]


def _masks_and_photos(run: FinishedRun) -> tuple[tuple[FileRef, ...], tuple[str, ...]]:
    """The final id images of a run, and the file name of the photo of each.

    Where the capture is gone or has no photos of its own (a video), photos are called as the frames are.
    """
    names = run.results.one("cameras").names
    try:
        scene = open_scene(Path(run.document["scene"]))
        photos = {name: file_name(name, photo) for name, photo in zip(scene.names, scene.photos, strict=False)}
    except InputError:
        photos = {}
    files = [run.folder / "masks" / f"{name}.png" for name in names]
    missing = next((file for file in files if not file.is_file()), None)
    if missing is not None:
        raise InputError(f"{missing} is not there; run the scene again.")
    with file_digests(run.store) as digests:
        masks = tuple(map(references(digests), files))
    for name, value in zip(names, run.document["results"]["ingest"], strict=True):
        if name not in photos:
            photos[name] = f"{name}.{suffix_of(run.store.get(value))}"
    return masks, tuple(photos[name] for name in names)


def file_name(view: str, photo: Path) -> str:
    """What a COCO file calls a photo: its name, after the folders that its view is called after too (`view_names`)."""
    above = photo.parent.parts
    places = range(len(above), -1, -1)
    first = next((i for i in places if "_".join([*above[i:], photo.stem]) == view), len(above))
    return "/".join([*above[first:], photo.name])


def _check_there(scene: Gaussians, ids: tuple[int, ...] | None, folder: Path) -> None:
    """Raises InputError where a file would hold no Gaussian: other instances are known to have some."""
    held, what = scene.instance_id, str(folder)
    if ids == (BACKGROUND,):
        held, what = held[held == BACKGROUND], f"the background of {folder}"
    if not len(held):
        raise InputError(f"{what} has no Gaussians, so there is nothing to export.")
