"""The holes that edits leave: where the views of the capture show what no view has measured."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.running import progress
from ss_flow.task import Bundle, Resources, task
from ss_flow.tasks.artifacts import (
    Bool,
    Cameras,
    DepthMap,
    EditedScene,
    Float32,
    Float64,
    Int32,
    PointCloud,
    PointLabels,
)
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, camera_of, pixels_in_view, project

SHOWS = 0.5
"""Accumulated alpha from which on a pixel shows something."""
_MARGIN = 16
"""Pixels around a picture from which points still reach into it."""
HIDES = 0.9
"""Accumulated alpha from which on nothing can be seen through a pixel."""
_NEIGHBOURS = 8


@dataclass(frozen=True)
class Holes:
    """What an edit uncovered in the views of the capture."""

    names: tuple[str, ...]
    """[V] the views that showed what has left its place."""
    left: Int32
    """[V] pixels that showed it."""
    unmeasured: Int32
    """[V] those of them that show nothing that was put there, and behind which no dense point lies: whatever they show
    now was measured by no view."""
    empty: Int32
    """[V] pixels that showed something before and show nothing now (accumulated alpha below 0.5)."""
    area: Float64
    """[V] the area of the unmeasured pixels, in squared world units, at the depth of what was there."""


@dataclass(frozen=True)
class Measured(Bundle):
    """What the capture tells of the scene before any edit."""

    cameras: Cameras
    depths: Sequence[DepthMap]
    """Of all views, in their order."""
    points: PointCloud
    labels: PointLabels
    """Instances of the points."""


@dataclass(frozen=True)
class Remains:
    """What an edit leaves of the dense points."""

    points: PointCloud
    rows: Int32
    """Those that are still there, ascending."""

    @functools.cached_property
    def spacing(self) -> float:
        """That of most of them, world units."""
        return self.points.spacing_of(self.rows)

    @classmethod
    def of(cls, measured: Measured, gone: tuple[int, ...]) -> Remains:
        """All but those with the labels `gone`."""
        return cls(measured.points, np.flatnonzero(~np.isin(measured.labels.label, gone)).astype(np.int32))

    def cover(self, view: Uncovered, more: Float32) -> Bool:
        """[h, w] the pixels within a spacing, or a pixel, of the picture of a point; more: [M, 3] points besides."""
        from scipy.spatial import cKDTree

        camera = view.camera
        wide = camera.cropped(-_MARGIN, -_MARGIN, camera.width + _MARGIN, camera.height + _MARGIN)
        places = np.concatenate([self.points.points[self.rows], more]).astype(np.float64)
        spacing = np.append(self.points.spacing[self.rows], np.full(len(more), self.spacing))
        seen = pixels_in_view(places, wide)[0]
        covered = np.zeros(view.left.shape, bool)
        if not len(seen):
            return covered
        uv, z = project(places[seen], camera)
        asked = np.argwhere(view.left)
        distance, near = cKDTree(uv).query(asked[:, ::-1] + 0.5, k=min(_NEIGHBOURS, len(uv)), workers=1)
        reach = np.maximum(1.0, spacing[seen] * camera.fx / z)
        within = distance.reshape(len(asked), -1) <= reach[near.reshape(len(asked), -1)]
        covered[tuple(asked.T)] = within.any(axis=1)
        return covered


@dataclass(frozen=True)
class Uncovered:
    """The part of one view that showed what has left its place."""

    name: str
    camera: Camera
    """Cropped to that part."""
    left: Bool
    """[h, w] pixels that showed it."""
    put: Bool
    """[h, w] pixels that show what has moved, or come instead."""
    empty: Bool
    """[h, w] pixels that showed something and show nothing now."""
    depth: Float64
    """[h, w] of what was there."""
    depth_now: Float64
    """[h, w] of what is there now; infinite where one can see through it."""


@task(name="edit.holes", resources=Resources(cores=1, memory_mb=1000, gpus=0.1), environment=backend_identity)
def holes(
    before: EditedScene,
    after: EditedScene,
    measured: Measured,
    *,
    instances: tuple[int, ...],
    gone: tuple[int, ...],
) -> Holes:
    """Count, in all views, the pixels behind which nothing was measured, after some instances have left their place.

    before: the scene with them. gone: labels of the dense points that are no longer there, those of the instances
    among them. Filled Gaussians count as points, so that holes after filling are those that stayed open.
    """
    remains = Remains.of(measured, gone)
    filled = after.means[after.filled > 0]
    found = list(uncovered(before, after, measured.cameras, instances))
    open_ = [view.left & ~view.put & ~remains.cover(view, filled) for view in found]
    return Holes(
        names=tuple(view.name for view in found),
        left=np.array([view.left.sum() for view in found], np.int32),
        unmeasured=np.array([pixels.sum() for pixels in open_], np.int32),
        empty=np.array([view.empty.sum() for view in found], np.int32),
        area=np.array([_area(view, pixels) for view, pixels in zip(found, open_, strict=True)], np.float64),
    )


def stays(scene: EditedScene, other: EditedScene, instances: tuple[int, ...]) -> Bool:
    """[N] which rows of a scene, before or after an edit, are of what the other one has, too, and that has not left its
    place as these instances have."""
    return np.isin(scene.instance_id, other.instance_id) & ~np.isin(scene.instance_id, instances)


def uncovered(
    before: EditedScene, after: EditedScene, cameras: Cameras, instances: tuple[int, ...]
) -> Iterator[Uncovered]:
    """The views that show the instances, each cropped to them."""
    own = select(before, np.isin(before.instance_id, instances))
    put = np.unique(after.instance_id[~stays(after, before, instances)]).tolist()
    for view, name in enumerate(cameras.names):
        progress(view + 1, len(cameras), name)
        camera = camera_of(cameras, view)
        reach = np.argwhere(render(own, camera).alpha > 0) if len(own) else np.zeros((0, 2), np.intp)
        if not len(reach):
            continue
        (y0, x0), (y1, x1) = reach.min(axis=0), reach.max(axis=0) + 1
        camera = camera.cropped(int(x0), int(y0), int(x1), int(y1))
        old, new = render(before, camera, label_ids=instances), render(after, camera, label_ids=put)
        left, shows_put = (shown.label_masks.sum(axis=0) >= SHOWS for shown in (old, new))
        if not left.any():
            continue
        empty = (old.alpha >= SHOWS) & (new.alpha < SHOWS)
        there = old.depth.astype(np.float64) / np.maximum(old.alpha, SHOWS)
        now = np.where(new.alpha >= HIDES, new.depth.astype(np.float64) / np.maximum(new.alpha, HIDES), np.inf)
        yield Uncovered(name, camera, left, shows_put, empty, there, now)


def _area(view: Uncovered, pixels: Bool) -> float:
    """A pixel covers z / fx times z / fy."""
    return float((view.depth[pixels] ** 2).sum() / (view.camera.fx * view.camera.fy))
