"""Long recordings with poses: the views that show what all others do. The poses alone tell; nothing is decoded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.geometry.cameras import centers_of

_DISTANCE = 1.5
"""Metres to what a camera is held towards: at this distance a step moves the picture as much as a turn by its angle."""
_FEWEST = 20
"""Views that are taken in any case, be it without motion."""
_STRAIGHT = 0.01
"""A way is at least so wide, for its length: along a line nothing tells how far off is what the camera sees."""
_DIGITS = 6
"""Of motion; what differs by the rounding of a processor is equal, and the first view is taken."""


def thinned(scene: SceneFiles, most: int, motion: float, parameter: str) -> SceneFiles:
    """Of a capture with poses that has more than `most` views, those to which all others are near.

    Farthest-point sampling: each next view is the one that is farthest from all taken ones, until no view is farther
    than `motion`, or `most` are taken; first among the views with ground truth. In its place comes the steadiest view
    near by, before and after which the camera moved least: it is the sharpest. Views with clicks come on top, so that
    the choice of the others is what it was when their user saw them.
    most: 0 = all views are used, as they are where there are no poses.
    motion: how far a picture moves from one view to the other (`_moves`), as a share of its diagonal.
    parameter: what `most` is called, for the remark that tells what was left out.
    """
    poses = scene.world_to_camera
    if poses is None or not 0 < most < len(poses):
        return scene
    distance = _looked_at(scene, poses)
    moves = _moves(scene, poses, distance)
    reach, nearest = np.full(len(poses), np.inf), np.zeros(len(poses), int)

    def take(view: int) -> None:
        apart = moves(view)
        nearest[apart < reach] = view
        np.minimum(reach, apart, out=reach)
        reach[view], nearest[view] = -1, view
        taken.append(view)

    taken: list[int] = []
    annotated = np.array([truth is not None for truth in scene.ground_truth or [None] * len(poses)])
    for among in (annotated, np.ones(len(poses), bool)):
        while len(taken) < most:
            farthest = int(np.argmax(np.where(among, reach, -1)))
            if reach[farthest] < 0 or (reach[farthest] <= motion and len(taken) >= _FEWEST):
                break
            take(farthest)
    stir, near = _stir(poses, distance), reach <= reach.max() / 2
    clicked = {hint.view for clicks in (scene.hints, scene.corrections) if clicks is not None for hint in clicks.hints}
    chosen = {view for view, name in enumerate(scene.names) if name in clicked}
    for view in taken:
        around = np.flatnonzero(near & (nearest == view) & (annotated | ~annotated[view]))
        chosen.add(int(around[np.argmin(stir[around])]))
    return _only(scene, sorted(chosen), np.min([moves(view) for view in chosen], axis=0).max(), parameter)


def _only(scene: SceneFiles, chosen: list[int], reach: float, parameter: str) -> SceneFiles:
    """These views of a capture; a remark tells that others are at most `reach` away."""
    left = set(scene.names) - {scene.names[view] for view in chosen}
    told = (
        f"{len(chosen)} of {len(scene.names)} views are used: the picture of each other one is that of one of these, "
        f"moved by at most {100 * reach:.2g} % of its diagonal. --set {parameter}={len(scene.names)} uses all of them."
    )
    return replace(
        scene.pick(chosen),
        all_names=tuple(name for name in scene.all_names or scene.names if name not in left),
        remarks=(*scene.remarks, told),
    )


def _looked_at(scene: SceneFiles, poses: Float64) -> float:
    """How far off is what the cameras look at, world units.

    That is `_DISTANCE` where lengths are metres. Elsewhere the cameras tell: where they go round a thing, or about a
    room, it is about as far away as they are from their middle. Of a way that is longer than wide, the width counts;
    if that is too little, more views are taken than would be needed.
    """
    if scene.metric:
        return _DISTANCE
    centers = centers_of(poses)
    spread = np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False) / np.sqrt(len(centers) / 2)
    return float(max(spread[1], _STRAIGHT * spread[0])) or 1.0


def _moves(scene: SceneFiles, poses: Float64, distance: float) -> Callable[[int], Float64]:
    """How far the pictures of all views [K] are moved from that of a view, as a share of their diagonals: by the angle
    between the two cameras, and by the step between them over the distance of what they see."""
    assert scene.lenses is not None
    centers = centers_of(poses)
    # A lens without a size has its principal point near the middle.
    sizes = [(lens.width or 2 * lens.cx, lens.height or 2 * lens.cy) for lens in scene.lenses]
    focal = np.array([lens.fx for lens in scene.lenses]) / np.maximum(np.hypot(*np.transpose(sizes)), 1)

    def moves(view: int) -> Float64:
        steps = np.linalg.norm(centers - centers[view], axis=1) / distance
        return np.round(focal * (steps + _angles(poses, poses[view])), _DIGITS)

    return moves


def _stir(poses: Float64, distance: float) -> Float64:
    """[K] how far what a camera sees, at a distance, moves across the picture, from the view before or to the view
    after: radians."""
    steps = np.linalg.norm(np.diff(centers_of(poses), axis=0), axis=1) / distance + _angles(poses[1:], poses[:-1])
    padded = np.concatenate([steps[:1], steps, steps[-1:]])
    return np.round(np.maximum(padded[:-1], padded[1:]), _DIGITS)


def _angles(poses: Float64, others: Float64) -> Float64:
    """[K] between the cameras of poses [K, 4, 4] and others, one or as many: radians."""
    traces = (poses[:, :3, :3] * others[..., :3, :3]).sum(axis=(1, 2))
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
