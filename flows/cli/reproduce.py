"""`ss-flow reproduce`: the paper's tables on data at hand, beside what it prints."""

from __future__ import annotations

import json
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.store import Store
from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.flows import paper, settings
from ss_flow.flows.cli.context import console, file_digests
from ss_flow.flows.cli.prepare import Prefixed, Prepared, RunOptions, display, header, prepare, tell_remarks
from ss_flow.flows.cli.telling import print_table
from ss_flow.flows.deliver import FALLBACKS
from ss_flow.flows.demo import generated_scenes
from ss_flow.flows.evaluate import LabelledScene
from ss_flow.flows.generated import RoomParams
from ss_flow.flows.params import Params
from ss_flow.flows.reproduce import PLANS, Plan, Section, Variant, labels_folder, measured, opened, scenes_of
from ss_flow.resolution import Failure
from ss_flow.sweep import recorded_as
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Metrics
from ss_flow.tasks.evaluate.points import InstanceIoUs

GENERATED = "generated"
MEAN = "mean"
_OF_ONE_SCENE = ("ablation", "tau_depth", "instances")
_COLUMNS = {"miou": "mIoU", "macc25": "mAcc(25)", "macc50": "mAcc(50)", "share": "avg % lab. l", "iou": "IoU"}
_SEEDS = ("splat.reconstruct.seed", "splat.merge.seed")


@dataclass(frozen=True)
class Run:
    """One run that a table needs."""

    section: Section
    variant: Variant
    scene: Path
    seed: int


@dataclass(frozen=True)
class Reproduce:
    """Measure one of the paper's tables on data at hand, and lay it beside what the paper prints.

    Every cell is a run like any other: what runs share is computed once, and an interrupted table goes on where it was.
    A cell that was not measured stays empty.
    """

    table: Annotated[
        Literal["scannet", "lerf", "ablation", "tau_depth", "background", "tau_corr", "instances"],
        tyro.conf.Positional,
    ]
    """Which table."""
    data: Annotated[str, tyro.conf.arg(metavar="DIR")]
    """The folder of the data set, with a folder for each scene: ScanNetv2's scans, or LERF-OVS; or "generated", rooms
    that are built here."""
    out: Path = Path("ss-flow-out/generated")
    """Where generated rooms are written."""
    masks: Literal["auto", "truth", "degraded"] = "auto"
    """Where the masks of generated rooms come from: "auto" is a segmenter, as for photos; "truth" and "degraded" are
    the room's."""
    rooms: int = 2
    """How many rooms are generated."""
    views: int = 24
    """How many photos are taken of each."""
    width: int = 320
    """Of these photos, pixels; the height is three quarters of it."""
    stride: int = 0
    """Every n-th frame is taken; 0 = 20 for ScanNet, 2 for generated rooms in the ablation, else 1."""
    seeds: int = 1
    """How often what is random is repeated; mean and standard deviation are told."""
    execution: tyro.conf.OmitArgPrefixes[RunOptions] = RunOptions(preset="paper")
    """How to run."""

    def run(self) -> int:
        if self.seeds < 1 or self.rooms < 1 or self.stride < 0:
            raise InputError("--seeds and --rooms must be 1 or more, --stride 0 or more.")
        plan, printed = PLANS[self.table], paper.tables()[self.table]
        options = self.execution
        if options.dry_run or options.until:
            raise InputError("a table is always measured whole; leave out --dry-run and --until.")
        options.engine()  # refuses what is out of range before anything is written
        store = options.store.open_store()
        digests = file_digests(store, verify=options.verify)
        tell = console(json=options.json)
        scenes = self._scenes(plan, store, tell)
        runs = [
            Run(section, variant, scene, seed)
            for section in plan.sections
            for variant in section.variants
            for scene in scenes
            for seed in range(self.seeds)
        ]
        try:
            prepared, unmeasured = self._prepared(runs, plan, digests)
            tell_remarks((one.prepared for one in prepared.values()), tell)
            found = self._measured(runs, prepared, store, digests, tell)
        finally:
            digests.save()
        sections = [_section(section, plan, printed, found.values()) for section in plan.sections]
        document = {
            "table": self.table,
            "source": printed.source,
            "title": printed.title,
            "sections": sections,
            "differs": self._differs(printed, list(prepared.values()), scenes),
            "notes": [*printed.notes, *dict.fromkeys([*unmeasured, *_failures(found.values())])],
        }
        if options.json:
            print(json.dumps(document, indent=1))
        else:
            _tell(document, tell)
        return 0

    def _scenes(self, plan: Plan, store: Store, tell: Console) -> list[Path]:
        data = Path(self.data)
        if self.data == GENERATED:
            room = RoomParams(views=self.views, width=self.width, height=self.width * 3 // 4, held_out=0)
            data = self.out
            rooms = [replace(room, seed=seed) for seed in range(self.rooms)]
            with display(tell) as screen:
                generated_scenes(data, rooms, self.masks, store, screen)
        return scenes_of(data, plan.data, one=self.table in _OF_ONE_SCENE)

    def _params(self, plan: Plan, variant: Variant, seed: int) -> Params:
        usual = (2 if self.table == "ablation" else 1) if self.data == GENERATED else (20 if plan.data == "scan" else 1)
        stride = (self.stride or usual) if variant.subsampled else 1
        params = settings.preset(Params(), self.execution.preset)
        texts = [f"capture.stride={stride}", *(f"{name}={seed}" for name in _SEEDS)]
        return settings.apply(params, [*texts, *self.execution.texts, *variant.settings])

    def _prepared(self, runs: Sequence[Run], plan: Plan, digests: FileDigests) -> tuple[dict[int, _Ready], list[str]]:
        """The runs that can be made, by their place, and why others cannot. Raises InputError when none can."""
        ready: dict[int, _Ready] = {}
        refused: list[InputError] = []
        told = []
        for place, run in enumerate(runs):
            try:
                params = self._params(plan, run.variant, run.seed)
                prepared = prepare(opened(run.scene, run.variant), params, self.execution, digests)
                if run.variant.hints and prepared.networks.segmenter is None:
                    raise InputError("hint-based masks need a segmenter, and there is none on this machine.")
                labelled = None
                if plan.data == "labels":
                    labelled = LabelledScene.of(
                        labels_folder(run.scene),
                        prepared.scene,
                        partial(_reference, digests),
                        encoder=prepared.networks.encoder,
                        query=params.semantics.query,
                    )
                ready[place] = _Ready(prepared, labelled)
            except InputError as error:
                refused.append(error)
                told.append(f"not measured: {run.variant.row or run.scene.name}: {error}")
        if not ready:
            raise refused[0]
        return ready, told

    def _measured(
        self,
        runs: Sequence[Run],
        ready: Mapping[int, _Ready],
        store: Store,
        digests: FileDigests,
        tell: Console,
    ) -> dict[int, _Found]:
        """What the runs came to, all of them one graph."""
        found: dict[int, _Found] = {}

        def done(place: int, report: Report) -> None:
            value = report.values["measured"]
            came_to = value if isinstance(value, Failure) else store.get(str(value))
            found[place] = _Found(runs[place], came_to, frozenset(node["key"] for node in report.nodes))

        def build(place: int) -> dict[str, Any]:
            run, (prepared, labelled) = runs[place], ready[place]
            nodes = prepared.build()
            reference = partial(_reference, digests)
            return {"measured": measured(nodes, run.section, run.variant, run.scene, reference, labelled)}

        with display(tell) as screen:
            requests = [
                Request(
                    partial(build, place),
                    one.prepared.name,
                    header(one.prepared, self.execution) | recorded_as(one.prepared.name, self._what(runs[place])),
                    None,
                    Prefixed(screen, " ".join(self._what(runs[place]).values()), leading=place == min(ready)),
                    partial(done, place),
                )
                for place, one in ready.items()
            ]
            run_flows(requests, store, **self.execution.engine())
        return found

    def _what(self, run: Run) -> dict[str, str]:
        what = {"table": self.table, "scene": run.scene.name, "row": run.variant.row, "by": run.section.protocol}
        return {**what, "seed": str(run.seed)}

    def _differs(self, printed: paper.Table, ready: Sequence[_Ready], scenes: Sequence[Path]) -> list[str]:
        """What makes our figures others than the paper's."""
        names = ", ".join(scene.name for scene in scenes)
        rooms = f"{len(scenes)} generated rooms of {self.views} views" if self.data == GENERATED else names
        networks = ready[0].prepared.networks
        segmenter = networks.segmenter.name if networks.segmenter else FALLBACKS["segmenter"]
        given = ready[0].prepared.scene.has_masks
        encoder = networks.encoder.name if networks.encoder else FALLBACKS["encoder"]
        strides = sorted({one.prepared.params.capture.stride for one in ready})
        return [
            f"data: {printed.data.partition(';')[0]} in the paper, {rooms} here",
            f"masks: SAM 2 in the paper, {'the ' + self.masks + ' masks of the rooms' if given else segmenter} here",
            *([f"encoder: CLIP in the paper, {encoder} here"] if ready[0].labelled else []),
            f"preset: {' '.join((self.execution.preset, *self.execution.texts))}; every n-th frame: "
            f"{', '.join(map(str, strides))}",
        ]


class _Ready(NamedTuple):
    """A run that can be made."""

    prepared: Prepared
    labelled: LabelledScene | None
    """The scene's label files, in the tables that are measured by them."""


@dataclass(frozen=True)
class _Found:
    """What a run came to."""

    run: Run
    value: Metrics | InstanceIoUs | Failure
    keys: frozenset[str]
    """Of all its results."""


def _reference(digests: FileDigests, path: Path) -> FileRef:
    return FileRef(path.absolute(), digests(path))


def _failures(found: Iterable[_Found]) -> list[str]:
    return [
        f"not measured: {one.run.variant.row or one.run.scene.name}: {one.value.error}"
        for one in found
        if isinstance(one.value, Failure)
    ]


Figures = dict[tuple[str, int], dict[str, float]]
"""Figures by column, of each row and repetition."""


def _section(section: Section, plan: Plan, printed: paper.Table, found: Iterable[_Found]) -> dict[str, Any]:
    """One section of the document: for each row the paper's figures, ours, their spread; None where there is none."""
    own = [one for one in found if one.run.section is section]
    figures = _figures(own, plan)
    known = printed.rows if section.of_paper else {}
    variants = [variant.row for variant in section.variants]
    named = variants if plan.rows == "variants" else [*(name for name in known if name != MEAN)]
    rows = list(
        dict.fromkeys([*named, *(row for row, _ in figures if row != MEAN), *([MEAN] * (MEAN in printed.rows))])
    )
    fresh = _fresh(own, variants[0]) if plan.rows == "variants" else {}
    return {
        "title": section.title,
        "protocol": section.protocol,
        "columns": printed.columns,
        "rows": [
            {
                "row": row,
                "paper": dict(zip(printed.columns, known[row], strict=True)) if row in known else None,
                "ours": _over_seeds(figures, row, statistics.fmean),
                "spread": _over_seeds(figures, row, statistics.stdev),
                "recomputed": fresh.get(row),
            }
            for row in rows
        ],
    }


def _figures(found: Sequence[_Found], plan: Plan) -> Figures:
    """In per cent. Of a row with several scenes the mean over them; rows that are scenes or instances have a mean."""
    columns: dict[tuple[str, int], list[dict[str, float]]] = defaultdict(list)
    for one in found:
        seed = one.run.seed
        match one.value:
            case Metrics(values):
                row = one.run.scene.name if plan.rows == "scenes" else one.run.variant.row
                columns[row, seed].append(values)
                if plan.rows == "scenes":
                    columns[MEAN, seed].append(values)
            case InstanceIoUs() as ious:
                alone = len({other.run.scene for other in found}) == 1
                for number, name, iou in zip(ious.instance.tolist(), ious.names, ious.iou.tolist(), strict=True):
                    row = f"{number} {name}" if alone else f"{one.run.scene.name}: {number} {name}"
                    columns[row, seed].append({"iou": iou})
                columns[MEAN, seed].append({"iou": float(ious.iou.mean())})
    return {
        at: {name: 100 * statistics.fmean(values[name] for values in several) for name in several[0]}
        for at, several in columns.items()
    }


def _over_seeds(figures: Figures, row: str, statistic: Callable[[Sequence[float]], float]) -> dict[str, float] | None:
    several = [values for (of_row, _), values in figures.items() if of_row == row]
    if len(several) < (2 if statistic is statistics.stdev else 1):
        return None
    return {name: round(statistic([values[name] for values in several]), 4) for name in several[0]}


def _fresh(found: Sequence[_Found], baseline: str) -> dict[str, float]:
    """Of each row, the share of its results that the first row does not have."""
    first = {(one.run.scene, one.run.seed): one.keys for one in found if one.run.variant.row == baseline}
    shares: dict[str, list[float]] = defaultdict(list)
    for one in found:
        known = first.get((one.run.scene, one.run.seed))
        if known is not None and one.keys:
            shares[one.run.variant.row].append(len(one.keys - known) / len(one.keys))
    return {row: round(statistics.fmean(values), 4) for row, values in shares.items()}


def _tell(document: Mapping[str, Any], out: Console) -> None:
    out.print(escape(f"{document['source']}: {document['title']}, in per cent"))
    for section in document["sections"]:
        names = [_COLUMNS[column] for column in section["columns"]]
        fresh = any(row["recomputed"] for row in section["rows"])
        printed = any(row["paper"] for row in section["rows"])
        heads = [f"{name}\n{whose}" for name in names for whose in (("paper", "ours") if printed else ("ours",))]
        table = Table(section["title"], *heads, *(["recomputed"] if fresh else []), box=None)
        for row in section["rows"]:
            cells = []
            for column in section["columns"]:
                cells += [_cell(row["paper"], None, column)] * printed
                cells.append(_cell(row["ours"], row["spread"], column))
            share = row["recomputed"]
            table.add_row(escape(row["row"]), *cells, *(["" if share is None else f"{share:.0%}"] if fresh else []))
        print_table(table, out)
    for text in document["differs"]:
        out.print(escape(f"differs: {text}"))
    for text in document["notes"]:
        out.print(escape(f"note: {text}"))


def _cell(values: Mapping[str, float] | None, spread: Mapping[str, float] | None, column: str) -> str:
    if values is None or column not in values:
        return ""
    return f"{values[column]:.2f}" + (f" ±{spread[column]:.2f}" if spread else "")
