"""Holes closed with the surfaces around them: a guess, and flagged as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    Bool,
    EditedScene,
    Float32,
    Float64,
    Int32,
    PointCloud,
    UInt8,
)
from ss_flow.tasks.edit.flat_surfaces import FlatSurface, flat_surfaces
from ss_flow.tasks.edit.holes import HIDES, Measured, Remains, Uncovered, stays, uncovered
from ss_flow.tasks.edit.operations import edited
from ss_flow.tasks.gaussians.initialise import concatenate, initialise, select
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of, pixels_in_view

_NEARBY = 0.5
"""How far around the box of what has left the surfaces are looked for, as a share of its diagonal."""
_TOUCHING = 4.0
"""How far apart the boxes of what has left one place are at most, in spacings."""
_THICK = 1.5
"""Half the thickness of a plane at least, in spacings of the dense points."""
_NOISE = 2.0
"""The same, in standard deviations of the points from the surfaces that they lie on: depth from photos is rough."""
_PATCH = 8.0
"""How far around a point its surface is taken for flat, in spacings."""
_PATCHES = 500
"""Points at which the roughness is looked up."""
_UNSEEN = 1.5
"""How far from all points of a plane it was not seen, in spacings."""
_DEPTH_ERROR = 0.02
"""Of a depth map, as a share of the depth."""
_FAINT = 0.05
"""Share of a pixel below which it does not show what has left."""
_LENDERS = 2000
"""At least so many points of a plane, and less than twice as many, lend filled places their colours."""
_LIES = 0.2
"""Share of an instance's points near the place that lie in a plane at least, or it only touches this."""
_AT_ONCE = 1000
"""Places whose colours are found together."""
_OPACITY = 0.95
_SOLID = 0.1
"""Opacity below which a Gaussian is faint, and lends no ids."""


@task(name="edit.fill", resources=Resources(cores=1, memory_mb=1500, gpus=0.1), environment=backend_identity)
def fill(
    before: EditedScene,
    after: EditedScene,
    measured: Measured,
    *,
    instances: tuple[int, ...],
    gone: tuple[int, ...],
) -> EditedScene:
    """Close the holes that instances leave with the surfaces around them, flagged as filled.

    The dense points that are still there near each place that instances left are cut into planes (at most four a place,
    by RANSAC; as thick as the points are rough; connected). The ray of every pixel that showed the instances is
    followed to the first plane behind them. It counts where it meets the plane inside the convex hull of its points, so
    that nothing is continued beyond what was seen; further than 1.5 spacings from any of them; where nothing that is
    still there hides it; and where no view looked through it, by its depth map or, where this knows nothing, by what
    the scene showed. One such place in each cube of the points' spacing becomes a Gaussian. The plane's points,
    but for those of what only touches the plane, weigh by the inverse cube of their distance (Shepard 1968). The place
    is of the instance with the most weight; its colour is their mean, each weighed once more by the share of its
    instance, so that carpet beside boards stays a carpet's, and yet no border is seen inside. What was filled before
    stays, and no place within a spacing of it is filled a second time.

    after: without what only came to light (`clear`), as that would hide the surfaces behind.
    gone: labels of the dense points that are no longer there, those of the instances among them.
    """
    points, cameras = measured.points, measured.cameras
    views = list(uncovered(before, after, cameras, instances))
    if not views:
        return after
    remains = Remains.of(measured, gone)
    arounds = [_around(remains, box) for box in _places_left(before, instances, _TOUCHING * remains.spacing)]
    rows = np.concatenate(arounds)
    near, spacing = points.points[rows].astype(np.float64), points.spacing_of(rows)
    thickness = max(_THICK * spacing, _NOISE * _roughness(near, _PATCH * spacing))
    found = [(plane, around) for around in arounds for plane in flat_surfaces(points, around, thickness)]
    planes = [plane for plane, _ in found]
    places, plane_of = _behind(views, planes, spacing, thickness)
    hidden = ~_seen_through(places, before, instances, measured, thickness)
    places, plane_of = places[hidden], plane_of[hidden]
    chosen = _one_a_cube(places, spacing)
    chosen = chosen[~_within(places[chosen], after.means[after.filled > 0], spacing)]
    places, plane_of = places[chosen], plane_of[chosen]
    if not len(places):
        return after
    # What has moved, or come instead, may lie nearer to the floor that it left than the rest of the floor does.
    solid = select(after, stays(after, before, instances) & (after.opacities >= _SOLID))
    fillings = [
        _continued(
            places[plane_of == number],
            plane,
            points,
            _lying(plane.rows, around, measured.labels.label),
            solid,
            spacing,
        )
        for number, (plane, around) in enumerate(found)
        if (plane_of == number).any()
    ]
    return concatenate([after, *fillings])


def _places_left(before: EditedScene, instances: tuple[int, ...], reach: float) -> list[Float64]:
    """The boxes [2, 3] of what has left its place, one for all whose boxes lie within `reach` of each other.

    One box around things far apart would be the whole room: its floor and walls would take the place of the table top
    that one of them stood on.
    """
    from scipy.sparse.csgraph import connected_components

    each = [before.means[before.instance_id == instance].astype(np.float64) for instance in instances]
    boxes = np.array([np.quantile(means, (0.005, 0.995), axis=0) for means in each if len(means)])
    low, high = boxes[:, 0], boxes[:, 1]
    number, place = connected_components(
        (low[:, None] <= high + reach).all(axis=2) & (low <= high[:, None] + reach).all(axis=2)
    )
    return [np.stack([low[place == i].min(axis=0), high[place == i].max(axis=0)]) for i in range(number)]


def _around(remains: Remains, box: Float64) -> Int32:
    """Rows of the dense points near what has left its place."""
    low, high = box
    margin = max(_NEARBY * float(np.linalg.norm(high - low)), 10 * remains.spacing)
    places = remains.points.points[remains.rows]
    return remains.rows[((places >= low - margin) & (places <= high + margin)).all(axis=1)]


def _roughness(places: Float64, reach: float) -> float:
    """How far points [N, 3] lie off the planes through what is near them: the median of standard deviations."""
    from scipy.spatial import cKDTree

    asked = places[:: max(1, len(places) // _PATCHES)]
    patches = cKDTree(places).query_ball_point(asked, reach, workers=1)
    off = [
        float(np.linalg.svd(places[patch] - places[patch].mean(axis=0), compute_uv=False)[2]) / len(patch) ** 0.5
        for patch in patches
        if len(patch) > 3
    ]
    return float(np.median(off)) if off else 0.0


def _behind(
    views: list[Uncovered], planes: list[FlatSurface], spacing: float, thickness: float
) -> tuple[Float64, Int32]:
    """Where the rays of pixels first meet a plane behind what was there, and it was not seen: [M, 3] world, and [M]
    which plane; one of the places of each view in each cube of the spacing."""
    from scipy.spatial import Delaunay, cKDTree

    hulls = [Delaunay(plane.flat) for plane in planes]
    trees = [cKDTree(plane.flat) for plane in planes]
    places, plane_of = [np.zeros((0, 3))], [np.zeros(0, np.int32)]
    for view in views:
        v, u = np.nonzero(view.left)
        camera = view.camera
        local = np.stack([(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(len(u))], 1)
        rays = local @ camera.world_to_camera[:3, :3]
        nearest, which = np.full(len(u), np.inf), np.full(len(u), -1, np.int32)
        for number, (plane, hull) in enumerate(zip(planes, hulls, strict=True)):
            with np.errstate(divide="ignore", invalid="ignore"):
                z = ((plane.centre - camera.center) @ plane.normal) / (rays @ plane.normal)
            fits = np.isfinite(z) & (z > view.depth[v, u] - thickness) & (z < nearest)
            fits[fits] = hull.find_simplex(plane.flattened(camera.center + rays[fits] * z[fits, None])) >= 0
            nearest[fits], which[fits] = z[fits], number
        met = np.flatnonzero((which >= 0) & (nearest < view.depth_now[v, u] + 2 * thickness))
        at = camera.center + rays[met] * nearest[met, None]
        unseen = np.zeros(len(met), bool)
        for number, (plane, tree) in enumerate(zip(planes, trees, strict=True)):
            own = which[met] == number
            unseen[own] = tree.query(plane.flattened(at[own]), workers=1)[0] > _UNSEEN * spacing
        kept = np.flatnonzero(unseen)[_one_a_cube(at[unseen], spacing)]
        places.append(at[kept])
        plane_of.append(which[met[kept]])
    return np.concatenate(places), np.concatenate(plane_of)


def _seen_through(
    places: Float64, before: EditedScene, instances: tuple[int, ...], measured: Measured, tolerance: float
) -> Bool:
    """[M] places that a view of the capture looked through: it measured something further behind, or, where no depth
    was measured, the scene shows something there that is not what has left."""
    free = np.zeros(len(places), bool)
    for view, known in enumerate(measured.depths):
        height, width = known.depth.shape
        camera = camera_of(measured.cameras, view).scaled(width, height)
        rows, column, row, z = pixels_in_view(places, camera)
        depth = known.depth
        if not (depth[row, column] > 0).all():
            shown = render(before, camera, label_ids=instances)
            solid = (shown.alpha >= HIDES) & (shown.label_masks.sum(axis=0) < _FAINT)
            depth = np.where(depth > 0, depth, np.where(solid, shown.depth / np.maximum(shown.alpha, HIDES), 0))
        free[rows[depth[row, column] > z + np.maximum(tolerance, _DEPTH_ERROR * z)]] = True
    return free


def _within(places: Float32 | Float64, others: Float32 | Float64, distance: float) -> Bool:
    """[M] which places [M, 3] are no farther than a distance from another one of these."""
    from scipy.spatial import cKDTree

    near: Bool = cKDTree(others).query(places, distance_upper_bound=2 * distance, workers=1)[0] <= distance
    return near


def _one_a_cube(places: Float64, side: float) -> Int32:
    """Rows of the first place in every cube, ascending."""
    _, first = np.unique(np.floor(places / side).astype(np.int64), axis=0, return_index=True)
    return np.sort(first).astype(np.int32)


def _lying(rows: Int32, around: Int32, labels: Int32) -> Int32:
    """The rows of a plane's points whose instances lie in it, all of them where none does: what stands on a floor or
    leans at a wall has some points in its plane, too, but most of them elsewhere."""
    in_plane, near = (np.bincount(labels[some], minlength=int(labels[around].max()) + 1) for some in (rows, around))
    lie: Int32 = rows[(in_plane >= _LIES * near)[labels[rows]]]
    return lie if len(lie) else rows


def _continued(
    places: Float64, plane: FlatSurface, points: PointCloud, lenders: Int32, solid: EditedScene, spacing: float
) -> EditedScene:
    """Gaussians at places [M, 3] of a plane, of the instance that has most weight there, and in its colours.

    lenders: rows of the points that these come from. solid: what stayed and is not faint; each lender is of the
    instance and the part of what is nearest to it there. (What is nearest to a place may be what lay on the thing that
    has left: it hangs above the floor now.) spacing: of the places.
    """
    from scipy.spatial import cKDTree
    from scipy.spatial.distance import cdist

    lenders = lenders[:: max(1, len(lenders) // _LENDERS)]
    lent, colors_lent = points.points[lenders], points.colors[lenders]
    ids = parts = np.zeros(len(lenders), np.int32)
    if len(solid):
        near = cKDTree(solid.means).query(lent, workers=1)[1]
        ids, parts = solid.instance_id[near], solid.part_id[near]
    known, which = np.unique(ids, return_inverse=True)
    votes = np.eye(len(known))[which]
    colors = np.zeros((len(places), 3))
    heaviest = np.zeros(len(places), np.int32)
    for first in range(0, len(places), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        weights = (cdist(places[some], lent) + spacing) ** -3
        shares = weights @ votes
        heaviest[some] = np.where(which == shares.argmax(axis=1)[:, None], weights, 0).argmax(axis=1)
        weights *= shares[:, which]
        colors[some] = weights @ colors_lent / weights.sum(axis=1, keepdims=True)
    flat = _flat(places, np.rint(colors).astype(np.uint8), plane, spacing)
    return replace(flat, instance_id=ids[heaviest], part_id=parts[heaviest])


def _flat(places: Float64, colors: UInt8, plane: FlatSurface, spacing: float) -> EditedScene:
    """Gaussians that lie in a plane: a spacing wide (one standard deviation), a fifth of it thick."""
    from scipy.spatial.transform import Rotation

    made = initialise(places.astype(np.float32), colors, 0, 0.0, opacity=_OPACITY)
    turn = Rotation.from_matrix(np.stack([*plane.axes, np.cross(*plane.axes)], axis=1)).as_quat(scalar_first=True)
    widths = np.log(spacing * np.array([1, 1, 0.2]))
    quaternions, log_scales = (np.tile(row.astype(np.float32), (len(places), 1)) for row in (turn, widths))
    return edited(replace(made, quaternions=quaternions, log_scales=log_scales), filled=1)
