"""How a run came about, stage by stage, from what the store holds of it; also of two runs side by side."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.cache.errors import Gone
from ss_flow.errors import InputError
from ss_flow.flows.results import FinishedRun, again
from ss_flow.flows.view.artifact import around_results
from ss_flow.flows.view.drawing import (
    add_gaussians,
    add_points,
    agreement_colors,
    draw,
    label_colors,
)
from ss_flow.flows.view.looking import start_view
from ss_flow.flows.view.thinning import thinned
from ss_flow.tasks.artifacts import Gaussians, PointLabels, UInt8
from ss_flow.tasks.deliver.palette import instance_color

if TYPE_CHECKING:
    from viser import SceneApi, ViserServer

_ROOT = "/timeline"
_APART = 1.15
"""Distance between two runs, as a share of the first one's width."""
_UNTOUCHED = (200, 200, 200)


@dataclass(frozen=True)
class Stage:
    """One thing that a run came to on its way."""

    name: str
    told: str
    """What one sees, in a sentence."""
    draw: Callable[[SceneApi, str], None]
    """Draws it from a node's name on."""


@dataclass(frozen=True)
class Round:
    """One round of merging."""

    number: int
    merged: tuple[str, ...]
    """Digests of the groups that were made of two in this round."""
    untouched: tuple[str, ...]
    """Of those that stayed as they were."""


def stages(run: FinishedRun, share: float = 1.0) -> list[Stage]:
    """The stages of a run, in order; those of which the run has no result, or the store no longer, are left out.

    share: of the Gaussians, how many are drawn (`thinned`).
    """
    results = run.results
    around = functools.cache(lambda: replace(around_results(results), share=share))

    def of_result(name: str, said: str, told: str, needed: Sequence[str] = ()) -> Iterator[Stage]:
        def drawn(scene: SceneApi, node: str) -> None:
            value = results.one(name) if isinstance(results.digests[name], str) else results.all(name)
            draw(scene, node, value, around())

        if not results.missing([name, *needed]):
            yield Stage(said, told, drawn)

    def of_labels(name: str, said: str, told: str, colors: Callable[[PointLabels], UInt8]) -> Iterator[Stage]:
        def drawn(scene: SceneApi, node: str) -> None:
            dense = results.one("dense")
            add_points(scene, node, dense.points, colors(results.one(name)), dense.spacing_of())

        if not results.missing([name, "dense"]):
            yield Stage(said, told, drawn)

    def all_stages() -> Iterator[Stage]:
        yield from of_result("cameras", "Sparse points", "The cameras with their photos, and the triangulated points.")
        yield from of_result("dense", "Dense points", "The points that the depth of several views agrees on.")
        yield from of_result("segment", "Masks before", "What the segmenter found in each photo.", ["cameras"])
        yield from of_labels(
            "propagate",
            "Votes",
            "Where the views agree (blue) and where they contradict each other (yellow to red); grey: no mask.",
            lambda labels: agreement_colors(labels.confidence),
        )
        yield from of_labels("cut", "Labels", "The points by their object.", lambda labels: label_colors(labels.label))
        yield from of_result(
            "masks_split", "Masks after", "The objects that all views agree on, in each photo.", ["cameras"]
        )
        yield from of_result("reconstruct", "Instances as trained", "The Gaussians of each object, trained alone.")
        for one in rounds(run):
            yield Stage(
                f"Merge round {one.number + 1}",
                f"{len(one.merged)} pairs that overlapped were joined, each in a colour of its own.",
                functools.partial(_draw_round, run, one, share),
            )
        yield from of_result("scene", "Scene", "All Gaussians, trained together once more.")
        yield from of_result("masks", "Final masks", "The objects of the scene, seen from each photo.", ["cameras"])

    return list(all_stages())


def rounds(run: FinishedRun) -> list[Round]:
    """The rounds of merging that joined something, as the run's record and the store tell them."""
    made = {(n["step"], n["item"]): n["outputs"] for n in run.document["nodes"]}
    groups = [
        outputs[0]
        for _, outputs in sorted((int(item), o) for (step, item), o in made.items() if step == "splat.retrain")
    ]
    found = []
    number = 0
    while (planned := made.get(("splat.plan", str(number)))) is not None:
        try:
            plan = run.store.get(planned[0])
        except Gone:
            break
        if not len(plan.pairs):
            break
        items = [f"{number}.{a}+{b}" for a, b in plan.pairs.tolist()]
        # A pair that could not be trained together was joined as it was.
        joined = [made.get(("splat.merge_pair", item)) or made.get(("splat.assemble", item)) for item in items]
        if not all(joined) or plan.singles.max(initial=-1) >= len(groups):
            break
        merged = tuple(outputs[0] for outputs in joined if outputs)
        untouched = tuple(groups[i] for i in plan.singles.tolist())
        if all(digest in run.store for digest in (*merged, *untouched)):
            found.append(Round(number, merged, untouched))
        groups = [*merged, *untouched]
        number += 1
    return found


def _draw_round(run: FinishedRun, one: Round, share: float, scene: SceneApi, node: str) -> None:
    for index, digest in enumerate((*one.merged, *one.untouched)):
        group: Gaussians = thinned(run.store.get(digest), share)
        if len(group):
            color = instance_color(index + 1) if index < len(one.merged) else _UNTOUCHED
            add_gaussians(scene, f"{node}/{index}", group, np.tile(np.array(color, np.uint8), (len(group), 1)))


class Timeline:
    """The stages of one run, or of two of the same capture side by side, in one scene; one stage is shown at a time."""

    def __init__(
        self, scene: SceneApi, run: FinishedRun, beside: FinishedRun | None = None, share: float = 1.0
    ) -> None:
        """beside: a run to show to the right of the other, at the stages of the same name. share: as for `stages`.

        Raises InputError when nothing of the run is left in the store.
        """
        self._scene = scene
        self.stages = stages(run, share)
        if not self.stages:
            what = f"the store {run.store.location} holds no stage of {run.folder} any more"
            raise InputError(f"{what}; {again(run.folder, run.document)}.")
        self._sides = [{stage.name: stage for stage in self.stages}]
        scene.add_frame(f"{_ROOT}/0", show_axes=False)
        if beside is not None:
            self._sides.append({stage.name: stage for stage in stages(beside, share)})
            scene.add_frame(f"{_ROOT}/1", show_axes=False, position=_to_the_right(run))
        self._drawn: dict[tuple[int, int], bool] = {}
        self._lock = threading.Lock()

    @property
    def names(self) -> list[str]:
        """Of the stages, in order."""
        return [stage.name for stage in self.stages]

    def show(self, index: int | None) -> None:
        """Show one stage, by its place; None: none of them. What was drawn once is only hidden.

        May be called from several threads, as viser does.
        """
        with self._lock:
            self._show(index)

    def _show(self, index: int | None) -> None:
        for (number, side), shown in self._drawn.items():
            if shown != (number == index):
                self._set(number, side, number == index)
        if index is None:
            return
        name = self.stages[index].name
        for side, known in enumerate(self._sides):
            if (index, side) not in self._drawn and name in known:
                node = f"{_ROOT}/{side}/{index}"
                self._scene.add_frame(node, show_axes=False)
                known[name].draw(self._scene, f"{node}/it")
                self._drawn[index, side] = True

    def _set(self, index: int, side: int, visible: bool) -> None:
        handle = self._scene.get_handle_by_name(f"{_ROOT}/{side}/{index}")
        if handle is not None:
            handle.visible = visible
        self._drawn[index, side] = visible


def add_timeline(
    server: ViserServer,
    run: FinishedRun,
    shown: Callable[[bool], None],
    beside: FinishedRun | None = None,
    share: float = 1.0,
) -> Timeline:
    """A slider over the stages of a run in a viewer's panel; at its left end stands what the viewer itself shows.

    shown: told whether the viewer is to show its own scene. beside: a run to show to the right of this one.
    share: as for `stages`. Raises InputError when nothing of the run is left in the store.
    """
    timeline = Timeline(server.scene, run, beside, share)
    ends = ((0, "now"), (len(timeline.names), timeline.names[-1]))
    with server.gui.add_folder("How it came about", expand_by_default=False):
        slider = server.gui.add_slider("Stage", 0, len(timeline.names), 1, 0, marks=ends)
        told = server.gui.add_html("")

    @slider.on_update
    def _(_: object) -> None:
        place = int(slider.value)
        stage = timeline.stages[place - 1] if place else None
        told.content = f"<b>{escape(stage.name)}</b><br>{escape(stage.told)}" if stage else ""
        shown(stage is None)
        try:
            timeline.show(place - 1 if place else None)
        except (Gone, InputError) as error:
            told.content = escape(str(error))

    return timeline


def _to_the_right(run: FinishedRun) -> np.ndarray:
    """[3] where a second run stands, as seen from the first view of this one; world units."""
    cameras, points = run.results.one("cameras"), run.results.one("dense").points
    first = start_view(cameras, points)
    right = np.cross(first.look_at - first.position, first.up)
    right /= np.linalg.norm(right)
    low, high = np.percentile(points @ right, (2, 98))
    return _APART * (high - low) * right
