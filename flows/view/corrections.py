"""What a person picks where Split joined things or broke one, as a file of hints for `ss-flow run --correct`."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ss_flow.cache.files import write_atomically
from ss_flow.errors import InputError
from ss_flow.flows.deliver import photo_lenses
from ss_flow.flows.edit_objects import unused_name
from ss_flow.flows.results import BACKGROUND, FinishedRun
from ss_flow.tasks.artifacts import Float32, Float64, Frame, PointCloud, PointLabels, Visibility
from ss_flow.tasks.capture.hints import clicks, read_hints
from ss_flow.tasks.capture.lens import distorted
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.split.correct import clicked_points

_NEEDED = ("ingest", "cameras", "dense", "visibility", "cut")
_VIEWS = 3
"""A point is clicked in so many views, those that see it nearest to their middle; each tells the segmenter of it."""


@dataclass(frozen=True)
class Pick:
    """A point that was picked on a thing."""

    thing: int
    """From 1 on."""
    row: int
    """Of the dense points."""


class Corrections:
    """Points picked on things of a run: those of one thing belong together, those of two do not."""

    def __init__(self, run: FinishedRun, file: Path) -> None:
        """file: what they are saved to; what it holds is gone on with.

        Raises InputError when results of the run or its capture are gone, and for a file that holds no such points.
        """
        run.require(_NEEDED)
        self._run, self.file = run, file
        try:
            self._capture = open_scene(Path(run.document["scene"]))
        except InputError:
            raise InputError("the run's photos are not where they were, so that it cannot be run again.") from None
        if self._capture.kind == "video":
            raise InputError("corrections need photos with names; extract the video's frames first.")
        results = run.results
        self._cloud: PointCloud = results.one("dense")
        self._instance: PointLabels = results.one("cut")
        self._views: list[Visibility] = results.all("visibility")
        self._frames: list[Frame] = results.all("ingest")
        self._lenses = photo_lenses(self._frames, results.one("cameras"), self._capture)
        self._seen = np.zeros(len(self._cloud.points), bool)
        for view in self._views:
            self._seen[view.point_index] = True
        self.thing = 1
        """The thing that points are picked on now."""
        self.picks: list[Pick] = []
        self._saved: list[Pick] = []
        self._names: dict[int, str] = {}
        if file.is_file():
            self._read()

    @property
    def unsaved(self) -> bool:
        """Whether the file holds other points."""
        return self.picks != self._saved

    def pick(self, instance: int, place: Float64) -> None:
        """Pick the dense point of an instance that is nearest to a place [3] in the world.

        Raises InputError where no instance is, or no photo shows a point of it.
        """
        rows = np.flatnonzero(self._seen & (self._instance.label == instance))
        if instance == BACKGROUND or not len(rows):
            raise InputError("pick a point on an object; nothing else can be corrected.")
        away = np.linalg.norm(self._cloud.points[rows] - place, axis=1)
        if self.thing not in self._names:
            self._names[self.thing] = unused_name(self._run.names[str(instance)], self._names.values())
        self.picks.append(Pick(self.thing, int(rows[away.argmin()])))

    def next_thing(self) -> None:
        """What is picked from now on belongs to another thing."""
        self.thing = max((pick.thing for pick in self.picks), default=0) + 1

    def undo(self) -> None:
        """Take the last point back, and go on with its thing."""
        if self.picks:
            self.thing = self.picks.pop().thing

    def place_of(self, pick: Pick) -> Float32:
        """[3] the point in the world."""
        return self._cloud.points[pick.row]

    @property
    def spacing(self) -> float:
        """Median distance of the dense points, world units."""
        return self._cloud.spacing_of()

    def told(self) -> list[str]:
        """What the points say that the run does not know yet, a sentence each."""
        pairs = {(pick.thing, int(self._instance.label[pick.row])) for pick in self.picks}
        things, instances = defaultdict[int, list[int]](list), defaultdict[int, list[int]](list)
        for thing, instance in sorted(pairs):
            things[thing].append(instance)
            instances[instance].append(thing)
        name = self._run.names
        return [
            *(" and ".join(name[str(i)] for i in held) + " become one" for held in things.values() if len(held) > 1),
            *(f"{name[str(i)]} falls into {len(held)}" for i, held in instances.items() if len(held) > 1),
        ]

    def document(self) -> dict[str, dict[str, list[list[float]]]]:
        """The points as hints: by view and thing, the pixels of the photo that show them."""
        document: dict[str, dict[str, list[list[float]]]] = {}
        for pick in self.picks:
            for view, pixel in self._shown(pick.row):
                of_view = document.setdefault(self._views[view].name, {})
                of_view.setdefault(self._names[pick.thing], []).append(self._on_photo(view, pixel))
        return document

    def _shown(self, row: int) -> list[tuple[int, int]]:
        """The views that show a dense point best, and on which pixel of the frame."""
        found = []
        for number, view in enumerate(self._views):
            at = int(np.searchsorted(view.point_index, row))
            if at < len(view.point_index) and view.point_index[at] == row:
                v, u = divmod(int(view.pixel[at]), view.width)
                off = math.hypot((u + 0.5) / view.width - 0.5, (v + 0.5) / view.height - 0.5)
                found.append((off, number, int(view.pixel[at])))
        return [(number, pixel) for _, number, pixel in sorted(found)[:_VIEWS]]

    def _on_photo(self, view: int, pixel: int) -> list[float]:
        """The middle of a frame's pixel in the photo as it was taken, x and y."""
        frame, lens = self._frames[view], self._lenses[view]
        row, column = divmod(pixel, frame.width)
        scale = frame.source_width / frame.width, frame.source_height / frame.height
        place = (np.array([[column, row]]) + 0.5) * scale
        return [round(float(x), 2) for x in (place if lens is None else distorted(place, lens))[0]]

    def _read(self) -> None:
        """Go on with what the file holds."""
        try:
            hints = read_hints(self.file, self._capture.names)
            of_views = clicks(
                tuple(self._frames),
                self._run.results.one("cameras"),
                names=self._capture.names,
                hints=hints,
                lenses=self._capture.lenses,
            )
        except InputError as error:
            raise InputError(str(error).replace(str(self.file), self.file.name)) from None
        rows, things = clicked_points(self._views, of_views)
        self._names = dict(enumerate(hints.objects, start=1))
        self.picks = [
            Pick(thing, row) for thing, row in dict.fromkeys(zip(things.tolist(), rows.tolist(), strict=True))
        ]
        self._saved = list(self.picks)
        self.next_thing()

    def save(self) -> None:
        """Write the file, whole or not at all. Raises InputError when it cannot be written."""
        text = json.dumps(self.document(), indent=1, ensure_ascii=False)
        try:
            write_atomically(self.file, text + "\n")
        except OSError as error:
            raise InputError(f"{self.file.name} cannot be written: {error.strerror}.") from None
        self._saved = list(self.picks)
