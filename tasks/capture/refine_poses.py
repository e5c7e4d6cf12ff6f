"""Poses that are given but not exact -> better ones: bundle adjustment (Triggs et al. 2000) that starts from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.running import warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap, Float64
from ss_flow.tasks.capture.colmap import load_pycolmap
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.mapping import opened, triangulate
from ss_flow.tasks.capture.matches import Matches
from ss_flow.tasks.capture.placing import places
from ss_flow.tasks.geometry.cameras import centers_of
from ss_flow.tasks.ranges import Count, Positive
from ss_flow.tasks.words import first_of

_LEAST_POINTS = 100
"""Fewer common points say nothing about the poses of a whole capture."""
_LEAST_SCALE = 1e-6
"""Refinement starts from the given poses and hardly leaves their scale; a smaller one means that they do not differ."""
_LEAST_MATCHES = 10
"""So many points that the sensor measured place a photo, whose own depth has a say."""
_LEAST_PHOTOS = 3
"""Fewer refined photos do not tell how their world lies in the given one."""


@dataclass(frozen=True)
class RefinePosesParams:
    """How given poses are refined."""

    first_error: Positive = 24.0
    """How far off its place, in pixels, a point may be seen while the given poses hold; every round halves it."""
    last_error: Positive = 3.0
    """The same in the last round."""
    min_points: Count = 30
    """A photo that sees fewer points is not adjusted by them."""
    intrinsics: bool = False
    """Whether focal lengths are refined too."""


@task(name="capture.refined_cameras", isolate=True)
def refined_cameras(
    photos: Sequence[Features],
    cameras: Cameras,
    matches: tuple[Matches, ...],
    depths: Sequence[DepthMap] = (),
    *,
    params: RefinePosesParams = RefinePosesParams(),
    insist: bool = True,
) -> Cameras:
    """The cameras with poses under which the photos' common points agree best (`adjusted`).

    A photo that sees too few of them would keep a pose that is as wrong as the others were. It is placed by what a
    depth sensor measured in them, where one did (`places`), and all are adjusted once more. How far the poses moved,
    and the median reprojection error of the same points before and after, is told as a warning.
    depths: none, or of each photo. insist: whether it is an error when the photos have too little in common; else the
    given cameras are returned. Raises InputError then.
    """
    light = [photo.light() for photo in photos]
    try:
        found = adjusted(light, cameras, matches, params)
        if len(depths) and len(found.rows) < len(light):
            known = {row: found.cameras.world_to_camera[row] for row in found.rows}
            poses = places(light, depths, cameras, matches, min_matches=_LEAST_MATCHES, known=known)
            if len(poses) > len(known):
                start = cameras.world_to_camera.copy()
                start[list(poses)] = list(poses.values())
                found = adjusted(light, cameras, matches, params, start)
    except Unrefinable as error:
        if insist:
            raise InputError(
                f"the poses cannot be refined: {error}; leave --refine-poses out, or give the photos without poses."
            ) from None
        warn(f"The given poses were not refined: {error}.")
        return cameras
    _tell(cameras, found)
    return found.cameras


class Unrefinable(Exception):
    """Photos do not tell better poses; its words say why."""


@dataclass(frozen=True)
class Adjusted:
    """What an adjustment made of cameras."""

    cameras: Cameras
    rows: list[int]
    """Those that see points enough."""
    error_before: float
    """Median distance of the points of the adjustment from where they are seen, under the cameras as they were ..."""
    error_after: float
    """... and as they are, pixels."""


def adjusted(
    photos: Sequence[Features],
    cameras: Cameras,
    matches: Sequence[Matches],
    params: RefinePosesParams,
    start: Float64 | None = None,
) -> Adjusted:
    """Cameras with poses under which the common points of their photos agree best.

    Points are triangulated with the poses to start from; then poses and points are adjusted together, in rounds that
    let ever smaller errors count. Photos tell neither the scale nor the place of the world: the result is brought back
    onto where it started by the best similarity. Sparse points are those of the last round.
    photos: of the cameras, in their order. matches: those with other photos do not count. start: [K, 4, 4]
    world-to-camera to start from, which a photo keeps that sees too few points; the cameras' own if not given.
    Raises Unrefinable when the photos have too little in common.
    """
    start = cameras.world_to_camera if start is None else start
    mapper, model = opened(photos, cameras.intrinsics, matches, start)
    error = max(params.first_error, params.last_error)
    focal = float(np.median(cameras.intrinsics[:, 0]))
    while True:
        filtering = triangulate(mapper, model, error, focal)
        if model.num_points3D() < _LEAST_POINTS:
            raise Unrefinable(f"only {model.num_points3D()} points are seen in common as the given poses would have it")
        _adjust(model, poses=True, intrinsics=params.intrinsics)
        mapper.filter_points(filtering)
        if error <= params.last_error:
            break
        error = max(error / 2, params.last_error)
    mapper.end_reconstruction(False)
    rows = [number - 1 for number in sorted(model.reg_image_ids()) if _points(model, number) >= params.min_points]
    if len(rows) < _LEAST_PHOTOS:
        raise Unrefinable(f"fewer than {_LEAST_PHOTOS} photos see {params.min_points} points in common with others")
    poses = np.stack([np.vstack([model.image(row + 1).cam_from_world().matrix(), (0, 0, 0, 1)]) for row in rows])
    back = _similarity(poses, start[rows])
    if back is None:
        raise Unrefinable("the cameras stand in one place, which tells no scale")
    return _result(model, cameras, rows, start, back)


def _adjust(model: Any, *, poses: bool, intrinsics: bool) -> None:
    pycolmap = load_pycolmap()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_rig_from_world = poses
    options.refine_sensor_from_rig = options.refine_extra_params = False
    options.refine_focal_length = intrinsics
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    scope = pycolmap.BundleAdjustmentConfig()
    for number in sorted(model.reg_image_ids()):
        scope.add_image(number)
    if poses:
        scope.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, scope, model).solve()


def _result(model: Any, given: Cameras, rows: list[int], start: Float64, back: Float64) -> Adjusted:
    pycolmap = load_pycolmap()
    after = _median_error(model)
    model.transform(pycolmap.Sim3d(back))
    world_to_camera, intrinsics = start.copy(), given.intrinsics.copy()
    for row in rows:
        world_to_camera[row, :3] = model.image(row + 1).cam_from_world().matrix()
        intrinsics[row] = model.image(row + 1).camera.params
    points = [point.xyz for _, point in sorted(model.points3D.items()) if point.track.length() >= 3]
    for number in model.reg_image_ids():
        model.frame(number).rig_from_world = pycolmap.Rigid3d(given.world_to_camera[number - 1][:3])
    _adjust(model, poses=False, intrinsics=False)
    sparse = np.array(points, np.float32).reshape(-1, 3)
    cameras = replace(given, world_to_camera=world_to_camera, intrinsics=intrinsics, sparse_points=sparse)
    return Adjusted(cameras, rows, error_before=_median_error(model), error_after=after)


def _similarity(poses: Float64, given: Float64) -> Float64 | None:
    """[3, 4] the similarity that brings cameras onto the given ones: its rotation from how they look, which also holds
    where they stand in a line; its scale and place from where they stand. None where they stand in one place.
    """
    u, _, vt = np.linalg.svd(np.einsum("kji,kjl->il", given[:, :3, :3], poses[:, :3, :3]))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    source, target = centers_of(poses) @ rotation.T, centers_of(given)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    scale = (a * b).sum() / max((a * a).sum(), 1e-12)
    if scale < _LEAST_SCALE:
        return None
    return np.column_stack([scale * rotation, target.mean(axis=0) - scale * source.mean(axis=0)])


def _tell(given: Cameras, found: Adjusted) -> None:
    refined = found.cameras.world_to_camera
    differs = (refined != given.world_to_camera).any(axis=(1, 2))
    rows = np.flatnonzero(differs)
    moved = np.linalg.norm(centers_of(refined) - centers_of(given.world_to_camera), axis=1)[rows]
    turn = refined[rows, :3, :3] @ given.world_to_camera[rows, :3, :3].transpose(0, 2, 1)
    turned = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    warn(
        f"Bundle adjustment moves the given poses of {len(rows)} of {len(given)} views by {np.median(moved):.3g} "
        f"{'m' if given.metric else 'units'} (at most {moved.max():.3g}) and turns them by {np.median(turned):.2f} "
        f"degrees (at most {turned.max():.2f}); points are seen {found.error_after:.2f} pixels off their place instead "
        f"of {found.error_before:.2f} (medians).{_kept(given, np.flatnonzero(~differs))}"
    )


def _kept(given: Cameras, rows: NDArray[np.intp]) -> str:
    """A sentence on photos that keep their poses."""
    if not len(rows):
        return ""
    names = first_of([given.names[row] for row in rows.tolist()])
    return f" Photos with too little in common with others keep theirs: {names}."


def _points(model: Any, number: int) -> int:
    return int(model.image(number).num_points3D)


def _median_error(model: Any) -> float:
    """Median distance of points from where they are seen, in pixels."""
    errors = []
    for number in model.reg_image_ids():
        image = model.image(number)
        seen = image.get_observation_points2D()
        if seen:
            places = np.array([model.point3D(point.point3D_id).xyz for point in seen])
            pose = image.cam_from_world().matrix()
            local = places @ pose[:, :3].T + pose[:, 3]
            focal, centre = image.camera.params[:2], image.camera.params[2:]
            projected = local[:, :2] / local[:, 2:] * focal + centre
            errors.append(np.linalg.norm(projected - np.array([point.xy for point in seen]), axis=1))
    return float(np.median(np.concatenate(errors)))
