"""Which views the depth of each view is found from, so that it depends on no others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import progress
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap, Float64
from ss_flow.tasks.geometry.cameras import Camera, cameras_by_view, pixels_in_view
from ss_flow.tasks.geometry.plane_sweep import typical_depth, view_scores
from ss_flow.tasks.packed import ViewLists
from ss_flow.tasks.ranges import Count

_NEARER_AND_FARTHER = (0.5, 0.7, 1.0, 1.4, 2.0)
"""The scene may lie at these multiples of the depth that the cameras suggest."""
_LEAST_POINTS = 50


@dataclass(frozen=True)
class NeighborParams:
    """Which views are compared at all."""

    count: Count = 8
    """Other views that the depth of one view may come from; those that overlap it best. What one more photo changes
    ends a few neighbours away."""


@dataclass(frozen=True)
class Neighbors(ViewLists):
    """Each view's neighbours, and the depths between which it is swept; a row a view."""

    span: Float64
    """[K, 2] the nearest and the farthest depth, world units; NaN where it must be found by a sweep."""

    def around(self, view: int) -> list[int]:
        """A view, and then its neighbours."""
        return [view, *self.views(view)]

    def span_of(self, view: int) -> tuple[float, float] | None:
        near, far = (float(depth) for depth in self.span[view])
        return None if np.isnan(near) else (near, far)


@task(name="capture.neighbors")
def neighbors(
    cameras: Cameras, measured: tuple[DepthMap, ...] = (), *, params: NeighborParams = NeighborParams()
) -> Neighbors:
    """The views that overlap each view best, and the span of the sparse points that it sees, made somewhat wider.

    Where hardly any are seen, the cameras alone tell how far the scene is. measured: a sensor's depth of all views,
    where there is one; the span is then that of the view and its neighbours, which may see what it is blind to.
    """
    by_view = cameras_by_view(cameras)
    guess = typical_depth(by_view)
    spans = [_widened(pixels_in_view(cameras.sparse_points, camera)[3], 0.98) for camera in by_view]
    chosen = []
    for view, span in enumerate(spans):
        progress(view, len(spans))
        chosen.append(_best(by_view, view, guess if span is None else float(np.sqrt(span[0] * span[1])), params.count))
    if measured:
        depths = [
            np.concatenate([measured[k].depth.ravel() for k in (view, *near)]) for view, near in enumerate(chosen)
        ]
        spans = [_widened(depth[depth > 0], 0.99) for depth in depths]
    known = np.array([(np.nan, np.nan) if span is None else span for span in spans], np.float64)
    return Neighbors(span=known.reshape(-1, 2), **Neighbors.arrays(chosen))


def _best(cameras: tuple[Camera, ...], view: int, depth: float, count: int) -> list[int]:
    """The neighbours of one view, ascending; `depth`: about how far the scene is, world units."""
    others = [k for k in range(len(cameras)) if k != view]
    scores = sum(
        view_scores(cameras[view], [cameras[k] for k in others], factor * depth) for factor in _NEARER_AND_FARTHER
    )
    return sorted(others[i] for i in np.argsort(-scores, kind="stable")[:count])


def _widened(depth: NDArray[np.floating], high: float) -> tuple[float, float] | None:
    """The span of known depths, from the lowest hundredth up to a quantile, made somewhat wider; None where there are
    hardly any."""
    if len(depth) < _LEAST_POINTS:
        return None
    near, far = np.quantile(depth, (0.01, high))
    return float(near) * 0.8, float(far) * 1.25
