"""Holes behind boxes on a floor: counted, and closed."""

from __future__ import annotations

from dataclasses import replace

import box_scene
import numpy as np
import pytest

from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.edit import operations
from ss_flow.tasks.edit.fill import fill
from ss_flow.tasks.edit.holes import Measured, holes
from ss_flow.tasks.gaussians.initialise import concatenate, select
from ss_flow.tasks.geometry.cameras import backproject, camera_of

SPACING = 0.03
BOX = 2


@pytest.fixture(scope="module")
def seen():
    return box_scene.measured(SPACING)


@pytest.fixture(scope="module")
def removed(seen):
    return operations.remove(seen[1], instances=(BOX,))


def test_the_floor_under_a_box_was_measured_by_no_view(seen, removed):
    measured, scene = seen
    found = holes(scene, removed, measured, instances=(BOX,), gone=(BOX,))
    assert set(found.names) == set(measured.cameras.names)
    low, high = box_scene.BOXES[BOX - 1, :, :2]
    pixels_under = 0
    for view in range(len(found.names)):
        depth, ids = box_scene.cast(view)
        camera = camera_of(measured.cameras, view)
        rays = backproject(np.ones_like(depth, dtype=np.float32), camera) - camera.center
        on_floor = camera.center - rays * (camera.center[2] / rays[:, 2])[:, None]
        under = ((on_floor[:, :2] > low) & (on_floor[:, :2] < high)).all(axis=1) & (ids.ravel() == BOX)
        # Gaussians that were not trained reach beyond the borders of the box.
        assert (ids == BOX).sum() < found.left[view] < 1.5 * (ids == BOX).sum()
        pixels_under += under.sum()
    assert 0.6 * pixels_under < found.unmeasured.sum() < 1.1 * pixels_under  # a spacing at each side counts as seen


@pytest.mark.parametrize("how", ["moved", "replaced"])
def test_what_shows_a_box_that_has_hardly_moved_or_its_like_is_no_hole(seen, removed, how):
    measured, scene = seen
    nudge = operations.Motion(move=(0.001, 0.0, 0.0))
    after = operations.transform(scene, instances=(BOX,), motion=nudge)
    if how == "replaced":
        after = replace(after, instance_id=np.where(after.instance_id == BOX, 9, after.instance_id).astype(np.int32))
    found = holes(scene, after, measured, instances=(BOX,), gone=(BOX,))
    without = holes(scene, removed, measured, instances=(BOX,), gone=(BOX,))
    assert np.array_equal(found.left, without.left)
    assert found.unmeasured.sum() < 0.02 * without.unmeasured.sum()


def test_the_area_is_that_of_the_pixels_at_the_depth_of_what_was_there(seen, removed):
    measured, scene = seen
    found = holes(scene, removed, measured, instances=(BOX,), gone=(BOX,))
    a_pixel = found.area / np.maximum(found.unmeasured, 1)
    assert (a_pixel > (1.4 / 90) ** 2).all() and (a_pixel < (3.2 / 90) ** 2).all()


def test_filling_continues_the_floor_under_the_box_and_says_so(seen, removed):
    measured, scene = seen
    after = fill(scene, removed, measured, instances=(BOX,), gone=(BOX,))
    new = after.means[after.filled > 0]
    low, high = box_scene.BOXES[BOX - 1, :, :2]
    assert len(new) > 0.5 * np.prod(high - low) / SPACING**2
    assert np.abs(new[:, 2]).max() < SPACING
    under = ((new[:, :2] > low - SPACING) & (new[:, :2] < high + SPACING)).all(axis=1)
    assert under.mean() > 0.98  # the rest lies where another box hides the floor from all views
    assert (after.instance_id[after.filled > 0] == 0).all()
    widths = np.exp(after.log_scales[after.filled > 0])
    np.testing.assert_allclose(widths, np.tile([SPACING, SPACING, SPACING / 5], (len(new), 1)), rtol=1e-5)
    colors = 0.5 + 0.28209479 * after.sh[after.filled > 0, 0]
    np.testing.assert_allclose(colors, np.tile(box_scene.COLORS[0] / 255, (len(new), 1)), atol=0.01)
    before = holes(scene, removed, measured, instances=(BOX,), gone=(BOX,)).unmeasured.sum()
    left = holes(scene, after, measured, instances=(BOX,), gone=(BOX,)).unmeasured.sum()
    assert left < 0.1 * before


@pytest.mark.parametrize("how", ["moved", "replaced"])
def test_the_floor_that_a_box_leaves_is_not_the_boxs_that_stands_beside_its_hole(seen, how):
    measured, scene = seen
    if how == "moved":
        after = operations.transform(scene, instances=(BOX,), motion=operations.Motion(move=(0.3, 0.0, 0.0)))
    else:  # by half of it
        half = select(scene, (scene.instance_id == BOX) & (scene.means[:, 0] > 0.45))
        after = concatenate(
            [operations.remove(scene, instances=(BOX,)), replace(half, instance_id=half.instance_id + 7)]
        )
    full = fill(scene, after, measured, instances=(BOX,), gone=(BOX,))
    new = full.instance_id[full.filled > 0]
    assert len(new) > 100 and (new == 0).all()


def test_what_is_not_filled_is_the_scene_as_it_was(seen, removed):
    measured, scene = seen
    after = fill(scene, removed, measured, instances=(BOX,), gone=(BOX,))
    assert np.array_equal(after.means[after.filled == 0], removed.means)


def test_what_was_filled_stays_when_what_stood_on_it_since_leaves_and_is_not_filled_twice(seen, removed):
    measured, scene = seen
    floor = fill(scene, removed, measured, instances=(BOX,), gone=(BOX,))
    box = select(scene, scene.instance_id == BOX)
    again = concatenate([floor, replace(box, instance_id=np.full(len(box), 9, np.int32))])
    after = fill(again, floor, measured, instances=(9,), gone=(BOX,))
    first, second = ({tuple(row) for row in one.means[one.filled > 0].tolist()} for one in (floor, after))
    assert len(first) > 100 and first <= second and len(second) < 1.05 * len(first)


def test_a_place_that_a_view_looked_through_is_not_filled(seen, removed):
    measured, scene = seen
    far = [DepthMap(d.name, np.full_like(d.depth, 9.0), d.source) for d in measured.depths]
    through = Measured(measured.cameras, far, measured.points, measured.labels)
    after = fill(scene, removed, through, instances=(BOX,), gone=(BOX,))
    assert not after.filled.any() and len(after) == len(removed)


@pytest.mark.parametrize("recess", [False, True])
def test_what_the_scene_shows_behind_a_place_tells_where_no_depth_was_measured(seen, recess):
    measured, scene = seen
    low, high = box_scene.BOXES[BOX - 1, :, :2]

    def around(places):
        """What of the floor is less than 30 cm from the box: no point was measured there."""
        inside = [((places[:, :2] > low - d) & (places[:, :2] < high + d)).all(axis=1) for d in (0.05, 0.3)]
        return inside[1] & ~inside[0] & (places[:, 2] < SPACING)

    points = measured.points
    known = ~around(points.points)
    blind = Measured(
        measured.cameras,
        [replace(depth, depth=np.zeros_like(depth.depth)) for depth in measured.depths],
        replace(points, points=points.points[known], colors=points.colors[known]),
        replace(measured.labels, label=measured.labels.label[known], confidence=measured.labels.confidence[known]),
    )
    lower = np.where(around(scene.means)[:, None], np.float32([0, 0, -0.2]), np.float32(0))
    scene = replace(scene, means=scene.means + lower) if recess else select(scene, ~around(scene.means))
    after = fill(scene, operations.remove(scene, instances=(BOX,)), blind, instances=(BOX,), gone=(BOX,))
    filled = around(after.means[after.filled > 0]).sum() * SPACING**2
    assert filled < 0.3 if recess else filled > 0.45  # square metres; that no view shows the recess, some are left


def test_of_things_far_apart_each_is_filled_with_the_surface_that_it_stood_on(monkeypatch):
    table = [[-0.9, -0.7, 0.0], [-0.5, -0.3, 0.3]]
    on_the_table, on_the_floor = [[-0.8, -0.6, 0.3], [-0.6, -0.4, 0.5]], [[0.5, 0.4, 0.0], [0.9, 0.8, 0.4]]
    monkeypatch.setattr(box_scene, "BOXES", np.array([table, on_the_table, on_the_floor]))
    measured, scene = box_scene.measured(SPACING)
    after = fill(scene, operations.remove(scene, instances=(2, 3)), measured, instances=(2, 3), gone=(2, 3))
    new = after.means[after.filled > 0]
    for low, high in (on_the_table, on_the_floor):
        under = ((new[:, :2] > low[:2]) & (new[:, :2] < high[:2])).all(axis=1) & (np.abs(new[:, 2] - low[2]) < SPACING)
        assert under.sum() > 0.5 * (high[0] - low[0]) * (high[1] - low[1]) / SPACING**2


def test_the_floor_under_a_thing_is_not_what_lies_on_that_thing_and_stays(monkeypatch):
    table, on_the_table = [[-0.9, -0.7, 0.0], [-0.1, 0.1, 0.12]], [[-0.7, -0.5, 0.12], [-0.3, -0.1, 0.5]]
    monkeypatch.setattr(box_scene, "BOXES", np.array([table, on_the_table]))
    measured, scene = box_scene.measured(SPACING)
    after = fill(scene, operations.remove(scene, instances=(1,)), measured, instances=(1,), gone=(1,))
    new = after.filled > 0
    under = ((after.means[:, :2] > [-0.7, -0.5]) & (after.means[:, :2] < [-0.3, -0.1])).all(axis=1)
    assert (new & under).sum() > 0.3 * 0.4 * 0.4 / SPACING**2 and (after.instance_id[new] == 0).all()


def test_a_hole_in_a_carpet_beside_boards_is_filled_with_carpet(seen):
    measured, scene = seen
    carpet, boards, border = np.uint8([40, 80, 180]), np.uint8([220, 150, 60]), box_scene.BOXES[BOX - 1, 0, 0] - 0.1
    on_boards = (measured.labels.label == 0) & (measured.points.points[:, 0] < border)
    two = replace(
        measured,
        points=replace(measured.points, colors=np.where(on_boards[:, None], boards, carpet)),
        labels=replace(measured.labels, label=np.where(on_boards, 7, measured.labels.label).astype(np.int32)),
    )
    ids = np.where((scene.instance_id == 0) & (scene.means[:, 0] < border), 7, scene.instance_id)
    now = replace(scene, instance_id=ids.astype(np.int32))
    after = fill(now, operations.remove(now, instances=(BOX,)), two, instances=(BOX,), gone=(BOX,))
    new = after.filled > 0
    off = 255 * (0.5 + 0.28209479 * after.sh[new, 0]) - carpet
    mixed = off @ (boards - carpet.astype(float)) / np.sum((boards - carpet.astype(float)) ** 2)
    assert (after.instance_id[new] == 0).mean() > 0.98 and np.median(mixed) < 0.05


def test_what_stands_on_a_floor_lends_no_colour_to_it(seen, removed):
    measured, scene = seen
    standing = np.isin(measured.labels.label, (1, 3))
    red = replace(measured.points, colors=np.where(standing[:, None], np.uint8([255, 0, 0]), measured.points.colors))
    plain, beside_red = (
        fill(scene, removed, replace(measured, points=points), instances=(BOX,), gone=(BOX,))
        for points in (measured.points, red)
    )
    assert len(plain.sh) == len(beside_red.sh) > len(removed.sh)
    assert np.array_equal(plain.sh[plain.filled > 0], beside_red.sh[plain.filled > 0])


def test_where_nothing_is_left_nothing_is_filled(seen):
    measured, scene = seen
    nothing = operations.remove(scene, instances=(0, 1, 2, 3))
    after = fill(scene, nothing, measured, instances=(1, 2, 3), gone=(0, 1, 2, 3))
    assert len(after) == 0
    found = holes(scene, nothing, measured, instances=(1, 2, 3), gone=(0, 1, 2, 3))
    assert np.array_equal(found.unmeasured, found.left)


def test_the_background_may_leave_together_with_what_leaves_a_hole(seen):
    measured, scene = seen
    floor, background = 4, 0  # the floor an instance, and a box part of the background
    ids = np.array([floor, 1, BOX, background], np.int32)
    now = replace(scene, instance_id=ids[scene.instance_id])
    known = replace(measured.labels, label=ids[measured.labels.label])
    after = operations.remove(now, instances=(background, BOX))
    full = fill(now, after, replace(measured, labels=known), instances=(BOX,), gone=(background, BOX))
    new = full.instance_id[full.filled > 0]
    assert len(new) > 0.5 * np.prod(np.ptp(box_scene.BOXES[BOX - 1, :, :2], axis=0)) / SPACING**2
    assert (new == floor).all() and set(full.instance_id.tolist()) == {floor, 1}


def test_the_same_edit_gives_the_same_bytes(seen, removed):
    measured, scene = seen
    a, b = (fill(scene, removed, measured, instances=(BOX,), gone=(BOX,)) for _ in range(2))
    assert a.means.tobytes() == b.means.tobytes() and a.sh.tobytes() == b.sh.tobytes()
