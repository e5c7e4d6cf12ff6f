"""What all views say together about the borders of masks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_and_box import BALL as CENTRE
from ball_and_box import HEIGHT, RADIUS, WIDTH, SmallScene
from native_builds import skip_without
from view_masks import as_fields

from ss_flow.tasks.artifacts import InstanceMasks
from ss_flow.tasks.gaussians import library
from ss_flow.tasks.gaussians.views import IGNORED, NONE_OF_MINE
from ss_flow.tasks.geometry.cameras import backproject
from ss_flow.tasks.geometry.clustering import nearest_spacing
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.splat.consensus import Voter, agreed, completed

BALL = 2


def with_mask(instance: InstanceMasks, row: int, mask: np.ndarray) -> InstanceMasks:
    masks = instance.dense()
    masks[row] = mask
    return replace(instance, **as_fields(masks))


def channels_of(small: SmallScene, instance: InstanceMasks, share: float = 0.5) -> list[np.ndarray]:
    return list(agreed(small.views.compared(VisibilityParams()), instance, share))


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1,) * 2, np.uint8)) > 0


@pytest.mark.parametrize("build", library.BUILDS)
@pytest.mark.parametrize("scale", [1, 2])
def test_a_view_votes_on_the_points_that_it_sees_and_on_those_that_its_mask_holds(small, build, scale, monkeypatch):
    skip_without(build)
    monkeypatch.setattr("ss_flow.tasks.splat.consensus.library", lambda: library.library(build))
    depths = [replace(d, depth=np.repeat(np.repeat(d.depth, scale, 0), scale, 1)) for d in small.depths]
    depths[3].depth[: HEIGHT // 2 * scale] = 0  # unknown there
    scene = replace(small.views, depths=depths).compared(VisibilityParams())
    rng = np.random.default_rng(5)
    points = np.concatenate([small.points[::7], rng.normal(0, 2, (2000, 3)).astype(np.float32)])
    place = rng.integers(0, 6, len(points)).astype(np.int32)
    mask = rng.random((HEIGHT, WIDTH)) < 0.5
    seen, held = np.zeros(len(points), np.int32), np.ones(len(points), np.int32)
    Voter(scene, 3, mask, 2).vote(points, place, seen, held)

    rows, column, row, _ = scene.surface_points(3, points)
    others = place[rows] != 2
    expected = np.zeros_like(seen), np.ones_like(held)
    expected[0][rows] += others
    expected[1][rows] += others & mask[row, column]
    assert 100 < others.sum() < len(rows) < len(points) / 2
    # A point on the border between two pixels may fall on either side of it.
    assert ((seen != expected[0]) | (held != expected[1])).sum() <= 1


def test_masks_on_which_all_views_agree_stay_as_they_are(small):
    instance = small.instance(BALL)
    for mask, channels in zip(instance.dense(), channels_of(small, instance), strict=True):
        assert (channels == IGNORED).sum() <= 0.03 * mask.sum()
        np.testing.assert_array_equal(channels[channels != IGNORED] == 0, mask[channels != IGNORED])


def test_what_one_mask_holds_beyond_the_object_says_nothing(small):
    instance = small.instance(BALL)
    true = instance.mask(0)
    wide = grown(true, 4)
    channels = channels_of(small, with_mask(instance, 0, wide))[0]
    beyond = wide & ~true & (small.depths[0].depth > 0)
    assert (channels[beyond] == IGNORED).mean() > 0.6  # the rest is seen from hardly anywhere else
    assert (channels[true] == 0).mean() > 0.97
    assert (channels[~wide] == NONE_OF_MINE).all()


def test_what_one_mask_leaves_out_says_nothing(small):
    instance = small.instance(BALL)
    true = instance.mask(0)
    narrow = ~grown(~true, 3)
    channels = channels_of(small, with_mask(instance, 0, narrow))[0]
    left_out = true & ~narrow
    assert (channels[left_out] == IGNORED).mean() > 0.6
    assert (channels[narrow] == 0).all()
    assert (channels[~true] != 0).all()


def test_without_depth_or_with_too_few_views_masks_stay(small):
    instance = small.instance(BALL)
    wide = with_mask(instance, 0, grown(instance.mask(0), 4))
    unknown = tuple(replace(d, depth=np.zeros_like(d.depth)) for d in small.depths)
    blind = replace(small.views, depths=unknown).compared(VisibilityParams())
    assert not any((channels == IGNORED).any() for channels in agreed(blind, wide, 0.5))
    two = small.instance(BALL, views=(0, 1))
    two = with_mask(two, 0, np.ones((HEIGHT, WIDTH), bool))
    for share in (0.5, 0.9):
        assert not any((channels == IGNORED).any() for channels in channels_of(small, two, share))


def test_a_mask_without_pixels_is_no_error(small):
    instance = with_mask(small.instance(BALL), 3, np.zeros((HEIGHT, WIDTH), bool))
    assert (channels_of(small, instance)[3] == NONE_OF_MINE).all()


def test_surface_that_the_masks_hold_gets_the_points_that_it_lacks(small):
    whole = small.instance(BALL)
    low = whole.points[:, 2] < 0.2
    half = replace(
        whole,
        points=whole.points[low],
        colors=whole.colors[low],
        point_confidence=whole.point_confidence[low],
        point_part=whole.point_part[low],
    )
    full = completed(small.views.compared(VisibilityParams()), half, 0.7, max_side=480)
    np.testing.assert_array_equal(full.points[: low.sum()], half.points)
    added = full.points[low.sum() :]
    off = np.abs(np.linalg.norm(added - CENTRE, axis=1) - RADIUS)
    assert len(added) > 50 and off.max() < 0.005 and added[:, 2].max() > 0.4
    assert len(full.colors) == len(full.point_confidence) == len(full.point_part) == len(full.points)
    assert (full.point_confidence >= 0.7).all()


def test_points_far_apart_in_the_photos_get_others_between_them_of_the_same_parts(small, monkeypatch):
    monkeypatch.setattr("ss_flow.tasks.splat.consensus.COARSEST", 1.0)  # the ball is two dozen pixels wide
    whole = small.instance(BALL, every=1)
    pixel = np.median([np.linalg.norm(camera.center - CENTRE) / camera.fx for camera in small.views.cameras])
    rows = [0]
    for row, point in enumerate(whole.points):
        if np.linalg.norm(whole.points[rows] - point, axis=1).min() > 5 * pixel:
            rows.append(row)
    fields = {name: getattr(whole, name)[rows] for name in ("points", "colors", "point_confidence", "point_part")}
    scene, coarse = small.views.compared(VisibilityParams()), replace(whole, **fields)
    assert completed(scene, coarse, 0.7, max_side=20) is coarse  # trained on pictures that show nothing finer
    full = completed(scene, coarse, 0.7, max_side=480)
    added, part = full.points[len(rows) :], full.point_part[len(rows) :]
    assert nearest_spacing(full.points) < 1.5 * pixel < 5 * pixel < nearest_spacing(coarse.points)
    assert np.abs(np.linalg.norm(added - CENTRE, axis=1) - RADIUS).max() < 0.005
    assert len(added) > 2 * len(rows) and (part == (added[:, 2] > 0.25)).mean() > 0.8 and 0 < part.mean() < 1


def test_a_complete_instance_and_what_few_masks_hold_gain_no_points(small):
    scene, instance = small.views.compared(VisibilityParams()), small.instance(BALL)
    assert completed(scene, instance, 0.7, max_side=480) is instance
    wide = instance
    for row in (0, 1, 2):
        wide = with_mask(wide, row, grown(instance.mask(row), 6))
    added = completed(scene, wide, 0.7, max_side=480).points[len(instance.points) :]
    off = np.abs(np.linalg.norm(added - CENTRE, axis=1) - RADIUS)
    assert not (off > 0.01).any()
    lone = replace(instance, points=instance.points[:1])
    assert completed(scene, lone, 0.7, max_side=480) is lone


def test_surface_apart_from_the_labelled_points_is_another_thing(small):
    ball, box = small.instance(BALL), small.instance(1)
    both = replace(ball, **as_fields(np.array(ball.dense()) | np.array(box.dense())))
    apart = np.linalg.norm(ball.points - CENTRE, axis=1) < 0.23
    far = replace(
        both,
        points=ball.points[apart] + np.float32([0, 0, 1]),
        colors=ball.colors[apart],
        point_confidence=ball.point_confidence[apart],
        point_part=ball.point_part[apart],
    )
    assert len(completed(small.views.compared(VisibilityParams()), far, 0.7, max_side=480).points) == len(far.points)
    assert len(completed(small.views.compared(VisibilityParams()), both, 0.7, max_side=480).points) > len(both.points)


PATCH = CENTRE + RADIUS / np.sqrt(3)
"""The middle of a piece of the ball's surface, well inside the box around the ball."""


def with_piece_apart(small: SmallScene, size: float, views: int, below: float = np.inf) -> InstanceMasks:
    """The ball, which looks as if it were in two: no mask holds the ring about the piece of this size round PATCH, and
    the piece has no points. As many views' masks hold it. below: height to which points and masks reach besides."""
    whole = small.instance(BALL, every=4)

    def rest(points: np.ndarray) -> np.ndarray:
        return (np.linalg.norm(points - PATCH, axis=-1) > size + 0.08) & (points[..., 2] < below)

    masks, holding = [], 0
    for row, (camera, depth) in enumerate(zip(small.views.cameras, small.depths, strict=True)):
        surface = backproject(depth.depth, camera).reshape(HEIGHT, WIDTH, 3)
        piece = np.linalg.norm(surface - PATCH, axis=-1) < size
        holding += (whole.mask(row) & piece).any()
        masks.append(whole.mask(row) & (rest(surface) | (piece & (holding <= views))))
    own = rest(whole.points)
    fields = {name: getattr(whole, name)[own] for name in ("points", "colors", "point_confidence", "point_part")}
    return replace(whole, **fields, **as_fields(np.array(masks)))


def test_a_piece_apart_joins_inside_the_box_of_the_rest(small):
    scene = small.views.compared(VisibilityParams())
    for views in (3, 8):
        instance = with_piece_apart(small, 0.1, views)
        full = completed(scene, instance, 0.3, max_side=480)
        added = full.points[len(instance.points) :]
        assert len(added) >= 10
        assert (np.linalg.norm(added - PATCH, axis=1) < 0.1 + 1e-4).all()
        assert (np.abs(np.linalg.norm(added - CENTRE, axis=1) - RADIUS) < 0.005).all()
        assert len(full.colors) == len(full.point_confidence) == len(full.point_part) == len(full.points)


@pytest.mark.parametrize(
    ("size", "views", "below"),
    [(0.1, 2, np.inf), (0.04, 8, np.inf), (0.1, 8, 0.25)],
    ids=["that two masks hold", "of few points", "outside of the box"],
)
def test_a_piece_apart_stays_another_thing(small, size, views, below):
    instance = with_piece_apart(small, size, views, below)
    assert completed(small.views.compared(VisibilityParams()), instance, 0.3, max_side=480) is instance
