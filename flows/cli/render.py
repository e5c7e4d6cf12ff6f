"""`ss-flow render`: pictures and films of a finished run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.markup import escape

from ss_flow.cache.files import write_atomically
from ss_flow.cache.store import Store
from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import InStore, OptionalPath, StoreOptions, console, file_digests, open_run, references
from ss_flow.flows.cli.prepare import display
from ss_flow.flows.render import CameraPath, Shot, shoot
from ss_flow.flows.results import FinishedRun
from ss_flow.graph import stored
from ss_flow.tasks.capture.layout_nerfstudio import transforms_document
from ss_flow.tasks.deliver.output import check_named
from ss_flow.tasks.deliver.pictures import What
from ss_flow.tasks.deliver.places import Written, check_outside, check_replaceable, replacing_own

CAMERAS_FILE = "transforms.json"
MANIFEST = "render.json"
"""Tells earlier pictures, which may be replaced, from a capture, which has a transforms.json too."""
PICTURES = Written(MANIFEST, "earlier pictures", frozenset({CAMERAS_FILE}))
_LEAST, _MOST = 8, 8192


@dataclass(frozen=True)
class Render:
    """Render a result along a path of cameras, as PNG files or an MP4 film."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    path: str = "input"
    """input (through the input views), orbit (round the scene, or round the instances of --instance), or a
    transforms.json with cameras."""
    what: What = "colour"
    """What to render; PNG files of labels hold ids, those of depth thousandths of a metre or of the scene's unit."""
    instance: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An instance by id or name, 0 = the background; may be given several times. Only these are rendered."""
    surroundings: bool = False
    """Render the whole scene all the same; --instance then says only what an orbit goes round."""
    before: bool = False
    """Of an edited result: show on the left what each picture showed before the edit."""
    frames: int = 120
    """How many; with --path input, 0 = the input views as they are. Cameras of a file are all taken."""
    width: int = 0
    """Of the pictures, pixels; 0 = that of the cameras."""
    elevation: float = 25.0
    """How many degrees above an instance an orbit stands."""
    fps: int = 24
    """Frames a second of a film."""
    out: OptionalPath = None
    """A file that ends in .mp4, or a folder of PNG files and their cameras; by default ss-flow-render/NAME.mp4."""
    jobs: int = 0
    """How many tasks may run at once; 0 = one a core."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        self._check_numbers()
        run = open_run(self.result, self.store, ("scene", "cameras", "dense"))
        out = self.out or Path("ss-flow-render") / f"{run.name}.mp4"
        is_film = out.suffix.lower() == ".mp4"
        _check_place(out, run.store.location, is_film=is_film)
        ids = run.ids(self.instance) if self.instance else None
        unit = float(run.results.one("dense").unit) / 1000
        earlier = _scene_before(run) if self.before else None
        shot = Shot(self._path(run.store), self.frames, self.elevation, self.what, self.width, unit, self.fps)
        written = 0

        def build() -> dict[str, Any]:
            scene, cameras = run.results.node("scene"), run.results.node("cameras")
            before = None if earlier is None else stored("before", earlier)
            whole = self.surroundings or ids is None
            return shoot(scene, cameras, ids, shot, whole=whole, is_film=is_film, before=before)

        def done(report: Report) -> None:
            nonlocal written
            if is_film:
                written = _write_film(out, run, report)
            else:
                panels, depth_unit = 1 + self.before, unit if self.what == "depth" else None
                about = {"result": str(run.folder), "what": self.what, "path": self.path}
                written = _write_pictures(out, run, report, about, panels=panels, depth_unit=depth_unit)

        with display(console(json=self.json)) as screen:
            request = Request(build, run.document["scene"], reporter=screen, done=done)
            run_flows([request], run.store, jobs=self.jobs, recorded=False)
        if self.json:
            print(json.dumps({"status": "ok", "what": self.what, "out": str(out), "frames": written}))
        else:
            console(json=False).print(escape(f"ok: {out} ({self.what}, {written} frames)"))
        return 0

    def _check_numbers(self) -> None:
        least = 0 if self.path == "input" else 1
        for name, value, low, high in (
            ("frames", self.frames, least, 100_000),
            ("width", self.width, 0, _MOST),
            ("elevation", self.elevation, -85, 85),
            ("fps", self.fps, 1, 240),
            ("jobs", self.jobs, 0, 100_000),
        ):
            if not low <= value <= high:
                raise InputError(f"--{name} {value:g} is out of range; it must be from {low} to {high}.")
        if 0 < self.width < _LEAST:
            raise InputError(f"--width {self.width} is out of range; it must be 0 or from {_LEAST} to {_MOST}.")

    def _path(self, store: Store) -> CameraPath:
        if self.path in ("input", "orbit"):
            return "input" if self.path == "input" else "orbit"
        file = Path(self.path)
        if not file.is_file():
            raise InputError(f"--path {self.path} is neither input nor orbit, nor a file of cameras (transforms.json).")
        with file_digests(store) as digests:
            return references(digests)(file)


def _scene_before(run: FinishedRun) -> str:
    """The digest of the scene that an edited run began with. Raises InputError where it was not edited, or the store no
    longer holds it."""
    begun = [node["outputs"][0] for node in run.document["nodes"] if node["step"] == "edit.begin"]
    if not begun:
        raise InputError(f"{run.folder} is not an edited run; --before shows what an edit has changed.")
    if begun[0] not in run.store:
        raise InputError(f"the store {run.store.location} no longer holds the scene before the edit; edit it again.")
    return str(begun[0])


def _write_film(out: Path, run: FinishedRun, report: Report) -> int:
    """Write the film; returns how many frames it has."""
    made = report.succeeded()
    write_atomically(out, run.store.get(str(made["film"])).content.tobytes())
    return len(made["pictures"])


def _write_pictures(
    out: Path, run: FinishedRun, report: Report, about: dict[str, Any], *, panels: int, depth_unit: float | None
) -> int:
    """Write the pictures and their cameras; returns how many there are.

    about: what render.json says of them. panels: so many renderings stand side by side in each.
    """
    made = report.succeeded()
    paths, pictures = made["cameras"], made["pictures"]
    sizes = []
    with replacing_own(out, PICTURES) as filling:
        files = [f"{number:05d}.png" for number in range(len(pictures))]
        for file, value in zip(files, pictures, strict=True):
            content = run.store.get(value).content.tobytes()
            (filling / file).write_bytes(content)
            width, height = (int.from_bytes(content[place : place + 4]) for place in (16, 20))  # PNG's header
            sizes.append((width // panels, height))
        cameras = [run.store.get(value).scaled(*size) for value, size in zip(paths, sizes, strict=True)]
        document = transforms_document(cameras, files)
        if depth_unit is not None:
            document["depth_unit_scale_factor"] = depth_unit
        for name, content in ((CAMERAS_FILE, document), (MANIFEST, about | {"files": files})):
            (filling / name).write_text(json.dumps(content, indent=1), encoding="utf-8")
    return len(files)


def _check_place(out: Path, store: str, *, is_film: bool) -> None:
    """Raises InputError unless the pictures can be written here: a new place, or that of earlier ones."""
    if is_film:
        check_outside(out, store)
        check_named(out, "--out")
    elif out.is_file():
        raise InputError(f"{out} is a file that does not end in .mp4; --out must name a film or a folder.")
    else:
        check_replaceable(out, PICTURES, store)
