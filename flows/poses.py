"""Photos without poses -> cameras: features a photo, matches with its partners, mapping, and once more for what is left
out; or, where a sensor measured depth, by that. Photos with poses that do not fit them -> better ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from ss_flow.flows.params import CaptureParams
from ss_flow.graph import INDEX, each, expand, gather, pick
from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame
from ss_flow.tasks.capture.depth_poses import placed_by_depth
from ss_flow.tasks.capture.features import Features, features
from ss_flow.tasks.capture.localize import localized
from ss_flow.tasks.capture.matches import Matches, match
from ss_flow.tasks.capture.pairs import Look, look, partners
from ss_flow.tasks.capture.pose_fit import FreeLens, PoseFit, PosePairs, better_poses, pose_fit, pose_pairs, with_lens
from ss_flow.tasks.capture.refine_poses import refined_cameras
from ss_flow.tasks.capture.registration import straightened
from ss_flow.tasks.capture.sfm import SfmParams, Unregistered, accepted, registered, sfm, unregistered


def poses(frames: tuple[Frame, ...], params: SfmParams, names: tuple[str, ...] | None) -> Cameras:
    """Add the nodes of structure from motion; names: of the frames, where they are known beforehand."""
    found, looks, matches = compared(frames, params, names)
    first = sfm(found, matches, gather([]), params=params.mapping)
    missing = unregistered(looks, first)

    def complete(left: Unregistered) -> Cameras:
        tries = [first]
        if len(left.row) and params.guided_matching == "missing":
            again = gather([rematched(found, looks, row, left.total, params) for row in left.row.tolist()])
            tries.append(sfm(found, matches, again, params=params.mapping))
        return accepted(gather(tries), missing, found, matches, min_registered=params.min_registered)

    return expand(missing, complete)


def poses_by_depth(
    frames: tuple[Frame, ...],
    unposed: Cameras,
    depths: tuple[DepthMap, ...],
    params: CaptureParams,
    names: tuple[str, ...],
) -> Cameras:
    """Add the nodes that find poses from what a sensor measured; unposed: the lenses of the frames."""
    found, _, matches = compared(frames, params.sfm, names)
    return placed_by_depth(
        found,
        unposed,
        depths,
        matches,
        min_matches=params.sfm.mapping.min_pose_matches,
        min_registered=params.sfm.min_registered,
        params=params.refine,
    )


def refined_poses(
    frames: tuple[Frame, ...], cameras: Cameras, depths: tuple[DepthMap, ...] | None, params: CaptureParams
) -> Cameras:
    """Add the nodes that refine the poses of the frames, which came with the capture; depths: what a sensor measured,
    if one did."""
    found, _, matches = compared(frames, params.sfm, None)
    return refined_cameras(
        found,
        cameras,
        matches,
        gather([]) if depths is None else depths,
        params=params.refine,
        insist=params.refine_poses == "always",
    )


@dataclass(frozen=True)
class Placed:
    """Nodes of the frames that have a camera."""

    frames: tuple[Frame, ...]
    cameras: Cameras
    sensed: tuple[DepthMap, ...] | None
    """What a sensor measured in them."""
    given: Cameras | None = None
    """The cameras that came with the capture, where other poses may stand in their place."""
    fit: PoseFit | None = None
    """How they fit its photos, where that is asked."""


def fitting_cameras(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    depths: tuple[DepthMap, ...] | None,
    params: CaptureParams,
    lens: FreeLens,
) -> Placed:
    """Add the nodes that look at a few pairs of photos, at more where these leave a doubt, and where the given cameras
    do not fit them, find another lens, or else refine the poses.

    depths: what a sensor measured, if one did; it has a say in which poses are better. lens: what of the lens may be
    wrong. A distortion that is found is taken out of frames and depths.
    """
    looks = pose_pairs(cameras)

    def seen_in(chosen: PosePairs) -> tuple[tuple[Features, ...], tuple[Matches, ...], tuple[DepthMap, ...]]:
        rows = chosen.view.tolist()
        photos = each(pick(frames, rows), build=lambda frame: features(frame, params=params.sfm.features))
        matches = gather([match(photos[a], pick(photos, [b])) for a, b in chosen.pair.tolist()])
        return photos, matches, gather([]) if depths is None else pick(depths, rows)

    def look(place: int, count: int) -> PoseFit:
        fit = expand(
            looks[place], lambda c: pose_fit(cameras, looks[place], *seen_in(c), lens=lens, params=params.pose_fit)
        )

        def decide(found: PoseFit) -> PoseFit:
            return fit if params.pose_fit.certain(found) or place + 1 == count else look(place + 1, count)

        return expand(fit, decide)

    def better(found: PoseFit) -> Cameras:
        if found.other_lens:
            return with_lens(cameras, fit)
        if not found.distance > params.pose_fit.least_distance:
            return cameras
        refined = refined_poses(frames, cameras, depths, params)
        last = expand(cast(Any, looks), lambda count: looks[count - 1])
        after = expand(last, lambda chosen: pose_fit(refined, last, *seen_in(chosen)))
        return better_poses(cameras, refined, fit, after, params=params.pose_fit)

    fit = expand(cast(Any, looks), lambda count: look(0, count))
    found = expand(fit, better)
    straight = _straight(frames, found, fit)
    if depths is None:
        return Placed(straight, found, None, cameras, fit)
    as_photos = params.registration.in_use(advise=False)
    sensed = expand(fit, lambda one: straightened(straight, found, depths, params=as_photos) if one.radial else depths)
    return Placed(straight, found, sensed, cameras, fit)


def kept_back(placed: Placed, trained: Placed, params: CaptureParams) -> Placed:
    """Photos that are kept back from those that are trained on: seen through the lens that was found for these, where
    they have its fit, and placed anew among them, where their poses were refined."""
    if trained.fit is not None:
        placed = _seen_through(trained.fit, placed)
    return placed if trained.given is None else _localized(placed, trained, trained.given, params)


def _seen_through(fit: PoseFit, placed: Placed) -> Placed:
    """The same with the lens that other photos of the same camera need, as `fitting_cameras` found; depth stays."""
    given = placed.cameras
    found = expand(fit, lambda one: with_lens(given, fit) if one.other_lens else given)
    return replace(placed, frames=_straight(placed.frames, found, fit), cameras=found)


def _localized(kept: Placed, trained: Placed, given: Cameras, params: CaptureParams) -> Placed:
    """given: the cameras with which the photos came that are trained on."""

    def found() -> Cameras:
        photos, looks, matches = compared(trained.frames, params.sfm, None)
        own = each(kept.frames, build=lambda frame: features(frame, params=params.sfm.features))

        def with_all(photo: Features) -> Matches:
            seen = look(photo, count=params.sfm.pairs.look_features)
            return expand(cast(Any, looks), lambda count: _with_first(count, photo, seen, photos, looks, params.sfm))

        beside = each(own, build=with_all)
        return localized(kept.cameras, own, beside, trained.cameras, photos, matches, params=params.refine)

    def moved(before: Cameras, after: Cameras) -> bool:
        return not np.array_equal(before.world_to_camera, after.world_to_camera)

    cameras = expand(
        given,
        lambda before: expand(trained.cameras, lambda after: found() if moved(before, after) else kept.cameras),
    )
    return replace(kept, cameras=cameras)


def _straight(frames: tuple[Frame, ...], cameras: Cameras, fit: PoseFit) -> tuple[Frame, ...]:
    """The frames without the distortion that these cameras have by `fit`, if any."""
    return expand(fit, lambda found: registered(frames, cameras) if found.radial else frames)


def compared(
    frames: tuple[Frame, ...], params: SfmParams, names: tuple[str, ...] | None
) -> tuple[tuple[Features, ...], tuple[Look, ...], tuple[Matches, ...]]:
    """Features, first looks and matches of photos."""
    found = each(frames, names=names, build=lambda frame: features(frame, params=params.features))
    looks = each(found, names=names, build=lambda photo: look(photo, count=params.pairs.look_features))
    return found, looks, matched(found, looks, params, names)


def matched(
    found: tuple[Features, ...], looks: tuple[Look, ...], params: SfmParams, names: tuple[str, ...] | None
) -> tuple[Matches, ...]:
    """Every photo matched with its partners among those before it."""

    def of_photo(photo: Features, row: int) -> Matches:
        return _with_first(row, photo, looks[row], found, looks, params)

    return each(found, INDEX, names=names, build=of_photo)


def _with_first(
    count: int, photo: Features, seen: Look, found: tuple[Features, ...], looks: tuple[Look, ...], params: SfmParams
) -> Matches:
    """A photo matched with its partners among the first `count`; seen: its first look."""
    chosen = partners(seen, pick(looks, range(count)), place=count, params=params.pairs)
    return expand(chosen, lambda plan: match(photo, pick(found, plan.row.tolist())))


def rematched(found: tuple[Features, ...], looks: tuple[Look, ...], row: int, total: int, params: SfmParams) -> Matches:
    """A photo that has no pose matched along epipolar lines, with twice the partners, before it or after."""
    others = [other for other in range(total) if other != row]
    wider = replace(params.pairs, partners=2 * params.pairs.partners)
    chosen = partners(looks[row], pick(looks, others), place=row, params=wider)
    return expand(chosen, lambda plan: match(found[row], pick(found, [others[i] for i in plan.row]), guided=True))
