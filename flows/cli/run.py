"""`ss-flow run` and `ss-flow demo`."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ss_flow.engine import Report, run_flow
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.flows import settings
from ss_flow.flows.capture import Capture, capture
from ss_flow.flows.cli.context import StoreOptions, choose_model, console, file_digests
from ss_flow.flows.deliver import STATUS_EXIT, deliver, run_document
from ss_flow.flows.params import Params
from ss_flow.flows.split_splat import Networks, split_splat
from ss_flow.scheduler import Failure
from ss_flow.task import FileRef
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.deliver.output import check_place

Assignments = Annotated[
    tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]],
    tyro.conf.arg(name="set", metavar="STEP.PARAM=VALUE", help_behavior_hint="may be given several times"),
]


@dataclass(frozen=True)
class RunOptions:
    """How to run, whatever the scene."""

    preset: str = "default"
    """default, paper (the paper's values), reference (those of its authors' code), fast (for a quick look) or thorough
    (for a machine with time)."""
    assignments: Assignments = ()
    """Set a parameter, as in --set split.tau_label=0.8."""
    until: str | None = None
    """Stop when this step's result is there."""
    jobs: int = 0
    """How many tasks may run at once; 0 = one a core."""
    executor: str = "threads"
    """threads or processes."""
    dry_run: bool = False
    """Tell what would run and why, and run nothing."""
    verify: bool = False
    """Read all input files again, instead of trusting their size and time of change."""
    json: bool = False
    """Print one JSON document on stdout, and nothing else there."""
    store: tyro.conf.OmitArgPrefixes[StoreOptions] = StoreOptions()
    """Where results are kept."""


@dataclass(frozen=True)
class Run:
    """Turn a capture into instance-labelled Gaussians."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A folder of photos, a video, a COLMAP workspace, a nerfstudio transforms.json, a ScanNet export or .sens file, or
    a TUM RGB-D folder."""
    out: Path | None = None
    """The folder to write; by default ss-flow-out/NAME of the scene."""
    masks: Path | None = None
    """A folder of ready-made instance masks (uint16 PNG files named like the photos), in the place of a segmenter."""
    execution: tyro.conf.OmitArgPrefixes[RunOptions] = RunOptions()
    """How to run."""

    def run(self) -> int:
        params = settings.preset(Params(), self.execution.preset)
        out = self.out or Path("ss-flow-out") / self.scene.resolve().stem
        return run_scene(self.scene, self.masks, out, params, self.execution)


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
        from ss_flow.flows.demo import demo_scene

        check_place(self.out / "result")
        scene = demo_scene(self.out, self.masks, self.objects, self.views, self.seed)
        params = settings.preset(Params(), self.execution.preset)
        params = dataclasses.replace(params, evaluate=dataclasses.replace(params.evaluate, zero_is_void=False))
        return run_scene(scene, None, self.out / "result", params, self.execution)


def run_scene(scene_path: Path, masks: Path | None, out: Path, params: Params, options: RunOptions) -> int:
    """Run the DAG on a scene, write the output folder, print what came out. Returns the exit code."""
    params = settings.apply(params, [text for group in options.assignments for text in group])
    if options.jobs < 0:
        raise InputError(f"--jobs {options.jobs} is out of range; it must be 0 (one a core) or more.")
    scene = open_scene(scene_path, masks).every(params.capture.stride)
    until = options.until.rpartition(".")[2] if options.until else None  # "split.propagate" is "propagate"
    whole = until is None and not options.dry_run
    if whole:
        check_place(out)
    store = options.store.open_store()
    digests = file_digests(store, verify=options.verify)
    networks = Networks(
        segmenter=choose_model("segmenter", params.split.segmenter, digests, wanted=not scene.ready_masks),
        encoder=choose_model("text-image", params.semantics.encoder, digests),
        monodepth=choose_model("monodepth", params.capture.monodepth, digests, wanted=params.capture.depth == "mono"),
    )

    def reference(path: Path) -> FileRef:
        return FileRef(path, digests(path))

    def build() -> dict[str, Any]:
        held_out = scene.root / "held_out"
        extra: Capture | None = None
        if held_out.is_dir():
            extra = capture(open_scene(held_out), reference, params.capture, networks.monodepth)
        results = split_splat(capture(scene, reference, params.capture, networks.monodepth), extra, networks, params)
        if until is not None and until not in results:
            raise InputError(f"--until {options.until!r} names no step; there are {', '.join(results)}.")
        return results

    out_console = console(json=options.json)
    try:
        report = run_flow(
            build,
            store,
            scene=str(scene.root.resolve()),
            header={"preset": options.preset, "params": settings.flat(params)},
            until=until,
            jobs=options.jobs,
            executor=options.executor,
            reporter=_display(out_console),
            dry=options.dry_run,
        )
    finally:
        digests.save()
    if options.dry_run:
        return _tell_plan(report, out_console, json_wanted=options.json)
    failed_input = next((f.error for f in report.failures if isinstance(f.error, InputError)), None)
    if failed_input is not None and any(isinstance(v, Failure) for v in report.values.values()):
        raise failed_input
    document = run_document(store, scene, params, networks, report)
    if whole and document["status"] != "failed":
        deliver(out, store, document, report)
    if options.json:
        print(json.dumps(document))
    else:
        _tell(document, out if whole else None, out_console)
    return STATUS_EXIT[document["status"]]


def _display(out: Console) -> Reporter:
    """A live display on a terminal, plain lines elsewhere."""
    from ss_flow.terminal import Terminal

    return Terminal(out)


def _tell_plan(report: Report, out: Console, *, json_wanted: bool) -> int:
    would = [n for n in report.nodes if n["event"] == "would run"]
    follow = [n for n in report.nodes if n["event"] == "skipped"]
    if json_wanted:
        print(json.dumps({"would_run": [{k: n[k] for k in ("label", "why")} for n in would]}))
        return 0
    for node in would:
        out.print(escape(f"would run {node['label']}: {node['why']}"))
    for label in dict.fromkeys(n["step"] for n in follow):
        out.print(f"would follow {label}")
    hits = sum(n["event"] == "hit" for n in report.nodes)
    out.print(f"{hits} results are there, {len(would)} would be computed first, {len(follow)} or more would follow")
    return 0


def _tell(document: dict[str, Any], out_folder: Path | None, out: Console) -> None:
    for failure in document["failures"]:
        out.print(f"[red]failed[/] {escape(failure['label'])}: {escape(failure['error'])}")
    if document["metrics"]:
        table = Table("measured against the ground truth", "mIoU", "mAcc(25)", "mAcc(50)", "PQ", box=None)
        for stage in ("split", "splat"):
            if row := document["metrics"].get(stage):
                table.add_row(
                    f"after {stage.title()}", *(f"{100 * row[k]:.1f}" for k in ("miou", "macc25", "macc50", "pq"))
                )
        out.print(table)
        if views := document["metrics"].get("novel_view"):
            out.print(f"views that were kept back: PSNR {views['psnr']:.2f} dB, SSIM {views['ssim']:.3f}")
    hits = sum(node["hit"] for node in document["nodes"])
    made = len(document["nodes"]) - hits
    place = f"; see {out_folder}" if out_folder else ""
    out.print(escape(f"{document['status']}: {made} results computed, {hits} reused{place}"))
