"""`ss-flow reproduce`: the paper's tables on data at hand, beside what it prints."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro
from rich.console import Console

from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.store import Store
from ss_flow.engine import Report, run_flows
from ss_flow.errors import InputError
from ss_flow.flows import paper, settings
from ss_flow.flows.cli.context import console, file_digests, references
from ss_flow.flows.cli.prepare import Prefixed, Prepared, RunOptions, display, prepare, tell_remarks
from ss_flow.flows.cli.reproduce_report import Found, Run, failures, section_of, tell_table
from ss_flow.flows.deliver import FALLBACKS
from ss_flow.flows.demo import generated_scene
from ss_flow.flows.evaluate import LabelledScene, labels_of
from ss_flow.flows.generated import RoomParams
from ss_flow.flows.params import Params
from ss_flow.flows.reproduce import PLANS, Plan, Variant, measured, opened, scenes_of
from ss_flow.resolution import Failure
from ss_flow.sweep import recorded_as

GENERATED = "generated"
_OF_ONE_SCENE = ("ablation", "tau_depth", "instances")
_SEEDS = ("splat.reconstruct.seed", "splat.merge.seed")


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
        # Refuses what is wrong before anything is written.
        settings.apply(settings.preset(Params(), options.preset), options.texts)
        engine = options.engine()
        store = options.store.open_store()
        digests = file_digests(store, verify=options.verify)
        tell = console(json=options.json)
        scenes = self._scenes(plan, store, tell, engine)
        runs = [
            Run(section, variant, scene, seed)
            for section in plan.sections
            for variant in section.variants
            for scene in scenes
            for seed in range(self.seeds)
        ]
        with digests:
            prepared, unmeasured = self._prepared(runs, plan, digests)
            tell_remarks((one.prepared for one in prepared.values()), tell)
            found = self._measured(runs, prepared, store, digests, tell)
        sections = [section_of(section, plan, printed, found.values()) for section in plan.sections]
        document = {
            "table": self.table,
            "source": printed.source,
            "title": printed.title,
            "sections": sections,
            "differs": self._differs(printed, list(prepared.values()), scenes),
            "notes": [*printed.notes, *dict.fromkeys([*unmeasured, *failures(found.values())])],
        }
        if options.json:
            print(json.dumps(document, indent=1))
        else:
            tell_table(document, tell)
        return 0

    def _scenes(self, plan: Plan, store: Store, tell: Console, engine: Mapping[str, Any]) -> list[Path]:
        if self.data == GENERATED:
            room = RoomParams(views=self.views, width=self.width, height=self.width * 3 // 4, held_out=0)
            folders = [self.out / f"room-{seed}" for seed in range(self.rooms)]
            with display(tell) as screen:
                for seed, folder in enumerate(folders):
                    of_seed = replace(room, seed=seed)
                    generated_scene(folder, of_seed, self.masks, store, screen, engine, annotated=True)
            return folders
        return scenes_of(Path(self.data), plan.data, one=self.table in _OF_ONE_SCENE)

    def _params(self, plan: Plan, variant: Variant, seed: int) -> Params:
        usual = (2 if self.table == "ablation" else 1) if self.data == GENERATED else (20 if plan.data == "scan" else 1)
        stride = (self.stride or usual) if variant.subsampled else 1
        params = settings.preset(Params(), self.execution.preset)
        # The paper's authors scale ScanNet's photos to its depth maps, 640 x 480 (spec 2.1).
        small = ["capture.ingest.max_side=640"] if plan.data == "scan" and self.data != GENERATED else []
        texts = [f"capture.stride={stride}", "capture.max_views=0", *small, *(f"{name}={seed}" for name in _SEEDS)]
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
                        labels_of(prepared.scene),
                        prepared.scene,
                        references(digests),
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
    ) -> dict[int, Found]:
        """What the runs came to, all of them one graph."""
        found: dict[int, Found] = {}

        def done(place: int, report: Report) -> None:
            value = report.values["measured"]
            came_to = value if isinstance(value, Failure) else store.get(str(value))
            found[place] = Found(runs[place], came_to, frozenset(node["key"] for node in report.nodes))

        def build(place: int) -> dict[str, Any]:
            run, (prepared, labelled) = runs[place], ready[place]
            nodes = prepared.build()
            reference = references(digests)
            return {"measured": measured(nodes, run.section, run.variant, run.scene, reference, labelled)}

        with display(tell) as screen:
            requests = [
                one.prepared.request(
                    self.execution,
                    Prefixed(screen, " ".join(self._what(runs[place]).values()), leading=place == min(ready)),
                    partial(done, place),
                    recorded_as(one.prepared.name, self._what(runs[place])),
                )
                for place, one in ready.items()
            ]
            measuring = [replace(r, build=partial(build, place)) for place, r in zip(ready, requests, strict=True)]
            run_flows(measuring, store, **self.execution.engine())
        return found

    def _what(self, run: Run) -> dict[str, str]:
        what = {"table": self.table, "scene": run.scene.name, "row": run.variant.row, "by": run.section.protocol}
        return {**what, "seed": str(run.seed)}

    def _differs(self, printed: paper.Table, ready: Sequence[_Ready], scenes: Sequence[Path]) -> list[str]:
        """What makes our figures others than the paper's."""
        names = ", ".join(scene.name for scene in scenes)
        rooms = f"{len(scenes)} generated rooms of {self.views} views" if self.data == GENERATED else names
        networks = ready[0].prepared.networks
        masks = dict.fromkeys(self._masks_of(one.prepared) for one in ready)
        encoder = networks.encoder.name if networks.encoder else FALLBACKS["encoder"]
        strides = sorted({one.prepared.params.capture.stride for one in ready})
        side = ready[0].prepared.params.capture.ingest.max_side
        photos = f"photos: 640 x 480 in the code of the paper's authors, at most {side} pixels wide or high here"
        return [
            f"data: {printed.data.partition(';')[0]} in the paper, {rooms} here",
            f"masks: SAM 2 in the paper, {' and '.join(masks)} here",
            *([photos] if self.data != GENERATED and not ready[0].labelled else []),
            *([f"encoder: CLIP in the paper, {encoder} here"] if ready[0].labelled else []),
            f"preset: {' '.join((self.execution.preset, *self.execution.texts))}; every n-th frame: "
            f"{', '.join(map(str, strides))}",
        ]

    def _masks_of(self, prepared: Prepared) -> str:
        """Where the masks of a run come from."""
        if prepared.scene.has_masks:
            return f"the {self.masks} masks of the rooms" if self.data == GENERATED else "ready-made masks"
        return prepared.networks.segmenter.name if prepared.networks.segmenter else str(FALLBACKS["segmenter"])


class _Ready(NamedTuple):
    """A run that can be made."""

    prepared: Prepared
    labelled: LabelledScene | None
    """The scene's label files, in the tables that are measured by them."""
