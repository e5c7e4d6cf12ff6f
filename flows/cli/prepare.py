"""What every command that runs the DAG does with a scene: make it ready, run it, finish its result."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape

from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.store import Store
from ss_flow.engine import Report, Request
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.flows import settings
from ss_flow.flows.capture import Capture, capture, turned
from ss_flow.flows.cli.context import InStore, OptionalText, StoreOptions, choose_model, choose_patches, references
from ss_flow.flows.deliver import deliver, remarks, run_document
from ss_flow.flows.params import Params
from ss_flow.flows.results import GIVEN
from ss_flow.flows.split import Networks
from ss_flow.flows.split_splat import LEADS_TO, LEADS_TO_CAMERAS, split_splat
from ss_flow.graph import Call, Flow, Gather, Node, gather, nodes_by_step
from ss_flow.resolution import Failure
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.capture.thinning import thinned
from ss_flow.tasks.device import processes_with_room
from ss_flow.tasks.gaussians.rasterize import device_here
from ss_flow.tasks.models.catalogue import DISTANCES
from ss_flow.tasks.models.onnx import lacks_cuda
from ss_flow.tasks.semantics.query import query
from ss_flow.units import parse_bytes

Assignments = Annotated[
    tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]],
    tyro.conf.arg(name="set", metavar="STEP.PARAM=VALUE", help_behavior_hint="may be given several times"),
]


@dataclass(frozen=True)
class RunOptions:
    """How to run, whatever the scene."""

    preset: str = "default"
    """default, paper (the paper's values), paper_lerf (those for LERF), reference (those of its authors' code), fast
    (for a quick look) or thorough (for a machine with time)."""
    assignments: Assignments = ()
    """Set a parameter, as in --set split.tau_label=0.8."""
    until: OptionalText = None
    """Stop when this step's results are there: a name that `--dry-run` or `status` shows, or a result of run.json."""
    jobs: int = 0
    """How many tasks may run at once; 0 = one a core."""
    memory: OptionalText = None
    """How much memory tasks may declare together, such as 8GB; what is free, when left out."""
    executor: OptionalText = None
    """mixed (one task in this process, those beside it in processes of their own), threads, processes, dask (a cluster
    on this machine) or dask://HOST:PORT; when left out, mixed, with as many processes as a GPU has memory for."""
    dry_run: bool = False
    """Tell what would run and why, and run nothing."""
    verify: bool = False
    """Read all input files again, instead of trusting their size and time of change."""
    json: bool = False
    """Print one JSON document on stdout, and nothing else there."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    @property
    def texts(self) -> list[str]:
        """All that --set was given."""
        return [text for group in self.assignments for text in group]

    @property
    def target(self) -> str | None:
        """The step of --until; "split.propagate" is "propagate", and so is one node of a step, "propagate[3]"."""
        return self.until.partition("[")[0].rpartition(".")[2] if self.until is not None else None

    @property
    def delivers(self) -> bool:
        """Whether a run ends with an output folder."""
        return self.until is None and not self.dry_run

    @property
    def stops_early(self) -> str:
        """What to say of a run that writes no output folder."""
        return f"--until {self.until} stops before the output (`ss-flow cache show {self.target}` shows the result)"

    def engine(self) -> dict[str, Any]:
        """These options as the engine takes them. Raises InputError for one that is out of range."""
        if self.jobs < 0:
            raise InputError(f"--jobs {self.jobs} is out of range; it must be 0 (one a core) or more.")
        try:
            memory_mb = parse_bytes(self.memory) >> 20 if self.memory is not None else 0
        except ValueError as error:
            raise InputError(f"--memory {error}") from None
        if self.memory is not None and memory_mb == 0:
            raise InputError(f"--memory {self.memory} is out of range; it must be 1 MiB or more, such as 8GB.")
        on_gpu = device_here() == "cuda" or lacks_cuda() is None  # whatever the driver shows
        return {
            "jobs": self.jobs,
            "memory_mb": memory_mb,
            "gpus": int(on_gpu),
            "executor": self.executor or "mixed",
            "processes": processes_with_room() - 1 if on_gpu else None,
            "dry": self.dry_run,
        }


@dataclass(frozen=True)
class Prepared:
    """A scene that is ready to run."""

    scene: SceneFiles
    params: Params
    networks: Networks
    asked: Mapping[str, Any]
    """What run.json says of how the run was asked for, besides the parameters."""
    build: Callable[[], dict[str, Any]]
    """Adds the DAG to a flow; returns its results by step. Raises InputError when it cannot be."""

    @property
    def name(self) -> str:
        """What its runs are recorded as."""
        return str(self.scene.place.resolve())

    def request(
        self,
        options: RunOptions,
        reporter: Reporter,
        done: Callable[[Report], None] = lambda report: None,
        recorded: dict[str, Any] | None = None,
    ) -> Request:
        """What to ask the engine for. recorded: what the record of the run says besides how it was asked for."""
        asked = {"preset": options.preset, "params": settings.flat(self.params)}
        return Request(self.build, self.name, asked | (recorded or {}), options.target, reporter, done)

    def steps(self) -> list[str]:
        """The names of the DAG's results. Raises InputError as `build` does."""
        with Flow().building():
            return list(self.build())


def prepare(
    scene: SceneFiles,
    params: Params,
    options: RunOptions,
    digests: FileDigests,
    *,
    text: str | None = None,
    given: Mapping[str, Path | None] | None = None,
) -> Prepared:
    """Choose the networks of an opened scene and say how its DAG is built.

    text: what to search the result for, as one more step, "query". given: the files beside the capture that were named,
    by the options that named them.
    Raises InputError when a network cannot be used.
    """
    if scene.kind == "stray":
        taken = params.capture.video.every(params.capture.stride)
        scene = scene.every(taken.stride or params.capture.stride)
        scene = thinned(scene, taken.max_frames, taken.motion, "capture.video.max_frames")
    else:
        scene = scene.every(params.capture.stride)
        scene = thinned(scene, params.capture.max_views, params.capture.video.motion, "capture.max_views")
    params = replace(params, capture=turned(scene, params.capture))
    if params.evaluate.zero_is_void is None:
        params = replace(params, evaluate=replace(params.evaluate, zero_is_void=scene.zero_is_void))
    held_out = scene.root / "held_out"
    networks = Networks(
        segmenter=choose_model("segmenter", params.split.segmenter, digests, wanted=not scene.has_masks),
        encoder=choose_model("text-image", params.semantics.encoder, digests),
        monodepth=choose_model("monodepth", params.capture.monodepth, digests, wanted=params.capture.depth == "mono"),
        patches=choose_patches(params.semantics.patches, digests),
        perception=choose_model(DISTANCES, params.evaluate.lpips, digests, wanted=held_out.is_dir()),
    )

    reference = references(digests)

    def build() -> dict[str, Any]:
        own = capture(scene, reference, params.capture, networks.monodepth)
        extra: Capture | None = None
        if held_out.is_dir():
            # Of these views only the photos count.
            plain = replace(params.capture, depth="auto", calibrate="none", refine_poses="never")
            kept = open_scene(held_out)
            same_lens = set(kept.lenses or ()) <= set(scene.lenses or ())
            trained = own.placed if same_lens else replace(own.placed, fit=None)
            extra = capture(kept, reference, plain, networks.monodepth, trained)
        results = split_splat(own, extra, networks, params)
        if text is not None:
            results["query"] = query(
                results["describe"],
                text=text,
                params=params.semantics.query,
                encoder=networks.encoder,
            )
        target = options.target
        if target is None:
            return results
        node = results[target] if target in results else _until(target, results)
        _check_item(str(options.until), node)
        return results | {target: node}

    named = {name: None if path is None else str(path.absolute()) for name, path in (given or {}).items()}
    asked = {"preset": options.preset, "set": options.texts, "given": dict.fromkeys(GIVEN) | named}
    return Prepared(scene, params, networks, asked, build)


def tell_remarks(scenes: Iterable[Prepared], out: Console) -> None:
    """Print what is to be said of runs before they begin, once."""
    for remark in dict.fromkeys(text for one in scenes for text in remarks(one.scene, one.params, one.networks)):
        out.print(f"[yellow]warning[/] {escape(remark)}")


def _until(step: str, results: Mapping[str, Any]) -> Any:
    """The node to stop at that is not a result itself. Raises InputError when there is no step of this name."""
    if LEADS_TO.get(step) in results:
        return results[LEADS_TO[step]]
    known = nodes_by_step(results.values())
    found = [node for name, nodes in known.items() if name.rpartition(".")[2] == step for node in nodes]
    if not found and step in LEADS_TO_CAMERAS:
        return results["cameras"]
    if not found:
        steps = sorted({name.rpartition(".")[2] for name in known} - results.keys())
        raise InputError(f"--until {step!r} names no step; there are {', '.join([*results, *steps])}.")
    return gather(found)


def _check_item(until: str, node: Node) -> None:
    """Raises InputError when --until names an item, as in "propagate[3]", of a step that is known to have no such."""
    item = until.partition("[")[2].removesuffix("]")
    nodes = node.items if isinstance(node, Gather) else [node]
    if item and all(isinstance(one, Call) and one.item != item for one in nodes):
        raise InputError(f"--until {until!r} names an item that is not there; leave out [{item}].")


def finish(
    prepared: Prepared, report: Report, store: Store, out: Path | None, *, undistorted: bool = False
) -> dict[str, Any]:
    """Write the output folder, unless `out` is None; return the document run.json.

    undistorted: whether with the frames, as a capture of their own.

    Raises InputError when the run failed because of what it was given.
    """
    failed_input = next((f.error for f in report.failures if isinstance(f.error, InputError)), None)
    if failed_input is not None and any(isinstance(v, Failure) for v in report.values.values()):
        raise failed_input
    document = run_document(store, prepared.scene, prepared.params, prepared.networks, prepared.asked, report)
    if out is not None and document["status"] != "failed":
        deliver(out, store, document, prepared.scene, undistorted=undistorted)
    return document


def first_failure(document: Mapping[str, Any]) -> str | None:
    """What failed first, by a document run.json."""
    return next((f"{failure['label']}: {failure['error']}" for failure in document["failures"]), None)


class Prefixed(Reporter):
    """Tells another reporter of one of several flows, with the flow's name before every label.

    leading: whether to pass on what concerns all flows at once; one of them should.
    """

    def __init__(self, whole: Reporter, prefix: str, *, leading: bool) -> None:
        self._whole, self._prefix, self._leading = whole, prefix, leading

    def event(self, kind: str, **details: Any) -> None:
        if "label" in details:
            self._whole.event(kind, **{**details, "label": f"{self._prefix} {details['label']}", "flow": self._prefix})
        elif self._leading:
            self._whole.event(kind, **details)

    def progressed(self, label: str, done: int, total: int, note: str) -> None:
        self._whole.progressed(f"{self._prefix} {label}", done, total, note)

    def pause(self) -> None:
        self._whole.pause()


@contextlib.contextmanager
def display(out: Console) -> Iterator[Reporter]:
    """A live display on a terminal, gone at the end; plain lines elsewhere."""
    from ss_flow.terminal import Lines, Terminal

    with contextlib.closing(Terminal(out) if out.is_terminal else Lines(out)) as screen:
        yield screen
