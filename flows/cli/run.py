"""`ss-flow run` and `ss-flow demo`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ss_flow.engine import Report, run_flows
from ss_flow.errors import InputError
from ss_flow.flows import settings
from ss_flow.flows.cli.context import OptionalPath, console, file_digests
from ss_flow.flows.cli.prepare import RunOptions, display, finish, prepare, tell_remarks
from ss_flow.flows.cli.telling import hits_of, print_table, would_run
from ss_flow.flows.deliver import STATUS_EXIT
from ss_flow.flows.params import Params
from ss_flow.tasks.capture.names import capture_name
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.deliver.places import RESULT, check_outside, check_replaceable
from ss_flow.tasks.gaussians.read_ply import read_columns

_MOST_LABELS = 3
"""So many nodes of a step that would run for one reason are told by name."""


@dataclass(frozen=True)
class Run:
    """Turn a capture into instance-labelled Gaussians."""

    capture: Annotated[Path, tyro.conf.Positional]
    """A folder of photos, a video, a COLMAP workspace, a nerfstudio transforms.json, a ScanNet export or .sens file, a
    TUM RGB-D folder, a room of Replica, Polycam's raw data, or a recording of Stray Scanner."""
    out: OptionalPath = None
    """The folder to write; by default ss-flow-out/NAME, the name of the folder, or of the file without its
    ending; for a transforms.json, the name of its folder."""
    scene: OptionalPath = None
    """A splat (.ply) that was trained elsewhere from this capture, to be labelled in the place of a reconstruction; its
    Gaussians stay as they are."""
    masks: OptionalPath = None
    """Ready-made instance masks in the place of a segmenter: a folder of uint16 PNG files named like the photos, or a
    COCO file (.json)."""
    hints: OptionalPath = None
    """A file (.json) of a few points clicked on objects in a few views; the segmenter looks for these objects only."""
    correct: OptionalPath = None
    """A file (.json) of points clicked on what an earlier run joined or broke, as the viewer saves it: what holds
    points of one thing becomes one instance, what holds points of several is divided; all else stays."""
    calibrate: Literal["auto", "none", "depth"] = "auto"
    """"depth" scales and shifts the sensor's depth so that its edges fit the photos, where that is found to be better;
    "auto" leaves it to the preset: where it is clearly better, or not at all."""
    refine_poses: bool = False
    """Refine the poses that come with the capture by bundle adjustment before anything else, also where photos and
    depth do not tell that this is better."""
    undistorted: bool = False
    """Also write the photos and cameras that the run worked with, without distortion, as a COLMAP workspace."""
    execution: tyro.conf.OmitArgPrefixes[RunOptions] = RunOptions()
    """How to run."""

    def run(self) -> int:
        params = settings.preset(Params(), self.execution.preset)
        calibrate = (f"capture.calibrate={self.calibrate}",) if self.calibrate != "auto" else ()
        texts = calibrate + (("capture.refine_poses=always",) if self.refine_poses else ())
        options = replace(self.execution, assignments=(texts, *self.execution.assignments))
        out = self.out or Path("ss-flow-out") / capture_name(self.capture)
        scene = open_scene(self.capture, self.masks, self.hints, self.correct)
        if self.scene is not None:
            read_columns(self.scene)  # what is no PLY is refused before anything is computed
            if scene.poses is None:
                raise InputError(
                    f"{self.capture} has no poses, and those that a run would find lie in another frame than "
                    f"{self.scene}; give the capture with the poses that it was trained with, such as COLMAP's folder."
                )
            scene = replace(scene, given_scene=self.scene)
        given = {"masks": self.masks, "hints": self.hints, "correct": self.correct}
        return run_scene(scene, out, params, options, given=given, undistorted=self.undistorted)


@dataclass(frozen=True)
class Demo:
    """Build a small room, run everything on it, and measure the result against its ground truth."""

    out: Path = Path("ss-flow-demo")
    """The folder to write: scene/ (the capture that was made) and result/."""
    masks: Literal["auto", "truth", "degraded"] = "auto"
    """Where masks come from: "auto" is a segmenter, as for your own photos; "truth" and "degraded" are the room's."""
    objects: int = 10
    """How many small things stand in the room."""
    views: int = 24
    """How many photos are taken of it."""
    seed: int = 0
    """Another seed is another room."""
    execution: tyro.conf.OmitArgPrefixes[RunOptions] = RunOptions(preset="fast")
    """How to run."""

    def run(self) -> int:
        from ss_flow.flows.demo import generated_scene, photographs
        from ss_flow.flows.generated import RoomParams

        options, scene = self.execution, self.out / "scene"
        params = settings.preset(Params(), options.preset)
        settings.apply(params, options.texts)  # refuses what is wrong before anything is written, as all of this does
        engine = options.engine()
        if self.seed < 0:
            raise InputError(f"--seed {self.seed} is out of range; it must be 0 or more.")
        check_outside(scene, options.store.location)
        check_replaceable(self.out / "result", RESULT, options.store.location)
        room = RoomParams(objects=self.objects, views=self.views, seed=self.seed)
        out = console(json=options.json)
        with display(out) as screen:
            there = generated_scene(scene, room, self.masks, options.store.open_store(), screen, engine)
        if there:
            return run_scene(open_scene(scene), self.out / "result", params, options)
        first = {"label": photographs.name, "why": f"{scene} does not hold this room"}
        if options.json:
            print(json.dumps({"would_run": [first]}))
        else:
            out.print(escape("would run {label}: {why}; what follows depends on the photos".format(**first)))
        return 0


def run_scene(
    scene: SceneFiles,
    out: Path,
    params: Params,
    options: RunOptions,
    *,
    given: Mapping[str, Path | None] | None = None,
    undistorted: bool = False,
) -> int:
    """Run the DAG on a scene, write the output folder, print what came out. Returns the exit code.

    given: see `prepare`.
    """
    params = settings.apply(params, options.texts)
    engine = options.engine()
    if options.until is None:
        check_replaceable(out, RESULT, options.store.location, scene.files())
    store = options.store.open_store()
    digests = file_digests(store, verify=options.verify)
    prepared = prepare(scene, params, options, digests, given=given)
    console_out = console(json=options.json)
    documents: list[dict[str, Any]] = []

    def done(report: Report) -> None:
        if not options.dry_run:
            place = out if options.delivers else None
            documents.append(finish(prepared, report, store, place, undistorted=undistorted))

    tell_remarks([prepared], console_out)
    with digests, display(console_out) as screen:
        (report,) = run_flows([prepared.request(options, screen, done)], store, **engine)
    if options.dry_run:
        return _tell_plan(report, console_out, json_wanted=options.json)
    (document,) = documents
    if options.json:
        print(json.dumps(document))
    else:
        _tell(document, out if options.delivers else None, console_out)
    if not options.delivers:
        console_out.print(escape(f"{options.stops_early}: {out} is not written"))
    return STATUS_EXIT[document["status"]]


def _tell_plan(report: Report, out: Console, *, json_wanted: bool) -> int:
    would = would_run(report)
    follow = [n for n in report.nodes if n["event"] == "skipped"]
    if json_wanted:
        print(json.dumps({"would_run": would}))
        return 0
    alike: dict[tuple[str, str], list[str]] = {}
    for node in would:
        alike.setdefault((node["label"].partition("[")[0], node["why"]), []).append(node["label"])
    for (step, why), labels in alike.items():
        what = ", ".join(labels) if len(labels) <= _MOST_LABELS else f"{step} {len(labels)} times"
        out.print(escape(f"would run {what}: {why}"))
    for label in dict.fromkeys(n["step"] for n in follow):
        out.print(f"would follow {label}")
    out.print(
        f"{hits_of(report)} results are there, {len(would)} would be computed first, {len(follow)} or more would follow"
    )
    return 0


def _tell(document: dict[str, Any], out_folder: Path | None, out: Console) -> None:
    for failure in document["failures"]:
        out.print(f"[red]failed[/] {escape(failure['label'])}: {escape(failure['error'])}")
    if rows := [(stage, row) for stage in ("split", "splat") if (row := document["metrics"].get(stage))]:
        table = Table("measured against the ground truth", "mIoU", "mAcc(25)", "mAcc(50)", "PQ", box=None)
        for stage, row in rows:
            figures = (f"{100 * row[name]:.1f}" for name in ("miou", "macc25", "macc50", "pq"))
            table.add_row(f"after {stage.title()}", *figures)
        print_table(table, out)
    if views := document["metrics"].get("novel_view"):
        beside = "psnr_neighbour_colours"
        out.print(
            f"views that were kept back: PSNR {views['psnr']:.2f} dB, "
            + (f"{views[beside]:.2f} in the colours of the photos beside, " if beside in views else "")
            + f"{views['psnr_colour_fitted']:.2f} with colours fitted to each view, SSIM {views['ssim']:.3f}, "
            + (f"LPIPS {views['lpips']:.3f}" if "lpips" in views else "LPIPS not measured (no network)")
        )
    hits = sum(node["hit"] for node in document["nodes"])
    made = len(document["nodes"]) - hits
    place = f"; see {out_folder}" if out_folder else ""
    out.print(escape(f"{document['status']}: {made} results computed, {hits} reused{place}"))
