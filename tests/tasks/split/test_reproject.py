import tracemalloc
from dataclasses import replace

import box_scene
import numpy as np
import pytest
from box_scene import mask_set
from clouds import even_cloud
from labelled_points import labels_of

from ss_flow.tasks.artifacts import (
    DRAWN,
    FOUND,
    PROMPTED,
    Hierarchy,
    PointLabels,
    PointParts,
    PromptedMasks,
    Visibility,
)
from ss_flow.tasks.capture.views import unit
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.masks.painting import PaintedView, by_area, nearest_labels, paint_labels, stack_exclusive
from ss_flow.tasks.masks.pool import smoothed
from ss_flow.tasks.masks.selection import SelectionParams, paint_for_selection, select_masks
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.split.dense import DenseParams, dense
from ss_flow.tasks.split.observe import ObserveParams, observe
from ss_flow.tasks.split.propagate import PropagateParams, propagate
from ss_flow.tasks.split.reproject import ReprojectParams, instances_in_view
from ss_flow.tasks.split.reproject import reproject as gather
from ss_flow.tasks.split.visibility import visibility

ALL = ReprojectParams(SelectionParams(masks="all"), draw_missing=False)
FOUND_ONLY = ReprojectParams(draw_missing=False)
H, W = 4, 10
WHOLE = PointParts(np.zeros(H * W, np.int32))
NO_TREE = Hierarchy(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros(0, bool))


def view(name="a"):
    """A view of 4 x 10 pixels that sees point p at pixel p."""
    every = np.arange(H * W, dtype=np.int32)
    return Visibility(name, every, every, np.ones(H * W, np.float32), H, W)


def labelled(image, confidence=1.0):
    """Points labelled by an image of labels [4, 10], and their cloud."""
    flat = np.asarray(image, np.int32).ravel()
    none = np.zeros(0, np.int32)
    labels = PointLabels(flat, np.full(H * W, confidence, np.float32), int(flat.max()), none, none, none)
    places = np.random.default_rng(0).random((H * W, 3)).astype(np.float32)
    return even_cloud(places, np.zeros((H * W, 3), np.uint8), 1.0, 0.1), labels


def reproject(cloud, views, masks, labels, parts, prompted, *, params):
    """The instances of all views; prompted: of any of them, by name."""
    in_views = [
        instances_in_view(view, pool, labels, [p for p in prompted if p.name == view.name], params=params)
        for view, pool in zip(views, masks, strict=True)
    ]
    return gather(cloud, labels, parts, NO_TREE, in_views, min_views=params.min_views)


def columns(low, high):
    mask = np.zeros((H, W), bool)
    mask[:, low:high] = True
    return mask


def halves(left=1, right=2):
    """Label `left` on columns 0 to 4, `right` on columns 5 to 7, none on the rest."""
    image = np.zeros((H, W), int)
    image[:, :5] = left
    image[:, 5:8] = right
    return image


def wall_behind_a_table():
    """A view of 300 x 400 pixels whose upper third has a point (label 1) a pixel, the rest one (label 2) of 25."""
    image = np.zeros((300, 400), np.int32)
    image[2::5, 2::5] = 2
    image[:100] = 1
    pixel = np.flatnonzero(image).astype(np.int32)
    points = np.arange(len(pixel), dtype=np.int32)
    return Visibility("a", points, pixel, np.ones(len(pixel), np.float32), 300, 400), image.ravel()[pixel]


def run(masks, image, params=None, prompted=()):
    cloud, labels = labelled(image)
    found = reproject(
        cloud, (view(),), (mask_set(np.stack(masks), "a"),), labels, WHOLE, prompted, params=params or FOUND_ONLY
    )
    return {i.instance_id: i for i in found}


def test_each_label_takes_the_mask_that_agrees_best():
    # IoU with label 1 (columns 0-4): 5/5 and 4/5; label 2 (columns 5-7): columns 5-9 give 3/5.
    found = run([columns(0, 4), columns(0, 5), columns(5, 10)], halves())
    assert (found[1].dense()[0] == columns(0, 5)).all()
    assert (found[2].dense()[0] == columns(5, 10)).all()


def test_points_count_by_the_area_that_they_cover():
    seen, label = wall_behind_a_table()
    painted = by_area(paint_labels(seen, label), 300, 400)
    assert painted.area[label == 1].sum() == pytest.approx(100 * 400, rel=0.05)
    assert painted.area[label == 2].sum() == pytest.approx(200 * 400, rel=0.05)


def test_a_mask_of_both_shows_the_table_that_fills_it_not_the_wall_that_has_more_points():
    seen, label = wall_behind_a_table()
    pool = mask_set(np.ones((1, 300, 400), bool))
    by_number = select_masks(paint_labels(seen, label), pool, SelectionParams())
    params = SelectionParams()
    assert list(by_number) == [1]
    assert list(select_masks(paint_for_selection(seen, label, params), pool, params)) == [2]


def test_a_point_stands_for_no_more_than_what_is_near_it():
    alone = PaintedView.of(np.array([150 * 400 + 200], np.int32), np.array([1], np.int32))
    assert 0 < by_area(alone, 300, 400).area[0] < 0.01 * 300 * 400


def test_two_masks_of_an_object_cut_in_two_are_united():
    found = run([columns(0, 3), columns(3, 5)], halves())
    assert (found[1].dense()[0] == columns(0, 5)).all()
    assert not found[2].views


@pytest.mark.parametrize(("every", "end"), [(2, 10), (10, 5)])
def test_a_mask_joins_another_one_only_with_points_about_as_dense(every, end):
    pixels = np.concatenate([np.flatnonzero(columns(0, 5)), np.flatnonzero(columns(5, 10))[::every]])
    painted = PaintedView.of(np.sort(pixels).astype(np.int32), np.ones(len(pixels), np.int32))
    shown = select_masks(painted, mask_set(np.stack([columns(0, 5), columns(5, 10)])), SelectionParams())
    assert (shown[1] == columns(0, end)).all()


def test_a_mask_that_agrees_too_little_shows_nothing():
    found = run([columns(4, 10)], halves(right=1))
    assert not found[1].views or (found[1].dense()[0] == columns(4, 10)).all()
    # Four of the eight columns of label 1, and two without label: IoU 4 / 10.
    assert len(found[1].views) == 1
    strict = replace(FOUND_ONLY, selection=SelectionParams(min_iou=0.5))
    assert not len(run([columns(4, 10)], halves(right=1), strict)[1].views)


def test_the_paper_unites_all_masks_whose_majority_a_label_has():
    # Columns 4-9 hold one column of label 1 and three of label 2.
    masks = [columns(0, 3), columns(2, 5), columns(4, 10)]
    found = run(masks, halves(), ALL)
    assert (found[2].dense()[0] == columns(4, 10) & ~columns(0, 5)).all()
    assert (found[1].dense()[0] == columns(0, 5)).all()


def test_masks_of_one_view_do_not_overlap_and_smaller_ones_are_on_top():
    ids = stack_exclusive({3: columns(0, 9), 5: columns(4, 7), 6: columns(5, 8)}, H, W)
    assert ids[0].tolist() == [3, 3, 3, 3, 5, 5, 5, 6, 3, 0]


def test_the_background_is_what_is_left():
    found = run([columns(0, 5), columns(5, 8)], halves())
    assert (found[0].dense()[0] == columns(8, 10)).all()
    assert len(found[0].points) == 2 * H
    assert not found[0].weak
    assert list(found) == [0, 1, 2]


def test_an_instance_knows_the_parts_of_its_points():
    cloud, labels = labelled(halves())
    parts = PointParts(np.arange(H * W, dtype=np.int32))
    found = reproject(cloud, (view(),), (mask_set(columns(0, 5)[None], "a"),), labels, parts, (), params=FOUND_ONLY)
    for instance in found:
        assert instance.point_part.tolist() == np.flatnonzero(labels.label == instance.instance_id).tolist()


def test_an_instance_seen_in_one_view_is_weak():
    cloud, labels = labelled(halves())
    masks = (mask_set(columns(0, 5)[None], "a"), mask_set(np.stack([columns(0, 5), columns(5, 8)]), "b"))
    _, one, two = reproject(cloud, (view("a"), view("b")), masks, labels, WHOLE, (), params=FOUND_ONLY)
    assert (one.views, one.weak) == (("a", "b"), False)
    assert (two.views, two.weak) == (("b",), True)


def test_the_masks_of_a_scene_take_the_room_of_the_things():
    side = 320
    image = np.kron(np.arange(1, 26).reshape(5, 5), np.ones((side // 5,) * 2, int))
    pixel = np.arange(0, side * side, 7, dtype=np.int32)
    points = np.arange(len(pixel), dtype=np.int32)
    labels = labels_of(image.ravel()[pixel])
    cloud = even_cloud(np.zeros((len(pixel), 3), np.float32), np.zeros((len(pixel), 3), np.uint8), 1.0, 0.1)
    parts = PointParts(np.zeros(len(pixel), np.int32))

    def peak(count: int) -> int:
        seen = [Visibility(str(k), points, pixel, np.ones(len(pixel), np.float32), side, side) for k in range(count)]
        masks = [mask_set(image == np.arange(1, 26)[:, None, None], one.name) for one in seen]
        tracemalloc.start()
        found = reproject(cloud, seen, masks, labels, parts, (), params=ALL)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert sum(instance.packed.nbytes for instance in found) == count * side * side // 8
        return most

    pictures = 25 * 30 * side * side // 8  # were each mask as large as its photo
    assert peak(35) - peak(5) < pictures / 4


def test_instances_that_are_all_weak_are_warned_of(recwarn):
    run([columns(0, 5), columns(5, 8)], halves())
    (told,) = recwarn.list
    assert "as many views as split.reproject.min_views (2), so none is reconstructed" in str(told.message)


def test_a_scene_without_any_instance_is_warned_of(recwarn):
    run([columns(0, 5)], np.zeros((H, W)))
    (told,) = recwarn.list
    assert str(told.message).startswith("No instance was found")


def test_where_one_instance_is_not_weak_nothing_is_warned_of(recwarn):
    run([columns(0, 5), columns(5, 8)], halves(), replace(FOUND_ONLY, min_views=1))
    cloud, labels = labelled(halves())
    masks = (mask_set(columns(0, 5)[None], "a"), mask_set(np.stack([columns(0, 5), columns(5, 8)]), "b"))
    reproject(cloud, (view("a"), view("b")), masks, labels, WHOLE, (), params=FOUND_ONLY)
    assert not recwarn.list


def test_an_instance_without_a_mask_has_no_confidence():
    cloud, labels = labelled(halves())
    masks = (mask_set(columns(0, 5)[None], "a"),)
    _, one, two = reproject(cloud, (view(),), masks, labels, WHOLE, (), params=FOUND_ONLY)
    assert len(two.packed) == 0 and two.sizes.shape == (0, 2)
    assert two.confidence == 0 < one.confidence


def test_a_piece_of_something_larger_is_less_likely_to_be_a_whole_thing():
    cloud, labels = labelled(halves())
    shown = [instances_in_view(view(), mask_set(np.stack([columns(0, 5), columns(5, 8)])), labels, params=ALL)]
    tree = Hierarchy(np.int32([1, 2, 3]), np.int32([3, 3, 0]), np.ones(3, np.float32), np.zeros(3, bool))
    alone = gather(cloud, labels, WHOLE, NO_TREE, shown, min_views=1)[1:]
    of_a_group = gather(cloud, labels, WHOLE, tree, shown, min_views=1)[1:]
    assert all(piece.confidence < one.confidence for piece, one in zip(of_a_group, alone, strict=True))


def prompt(label, mask):
    return (
        PromptedMasks(
            **vars(Masks.of([mask])),
            name="a",
            height=H,
            width=W,
            label=np.array([label], np.int32),
            predicted_iou=np.ones(1, np.float32),
        ),
    )


def test_a_prompted_mask_stands_in_where_no_mask_shows_a_label():
    found = run([columns(0, 5)], halves(), prompted=prompt(2, columns(5, 9)))
    assert (found[2].dense()[0] == columns(5, 9)).all()
    assert (found[2].origin.tolist(), found[1].origin.tolist()) == ([1], [0])


def test_a_prompted_mask_that_misses_its_label_is_refused():
    assert not len(run([columns(0, 5)], halves(), prompted=prompt(2, columns(0, 6)))[2].views)


def test_a_prompted_mask_replaces_the_views_own_only_where_it_agrees_better():
    found = run([columns(0, 5)], halves(), prompted=prompt(1, columns(0, 4)))
    assert (found[1].dense()[0] == columns(0, 5)).all()
    assert found[1].origin.tolist() == [FOUND]
    found = run([columns(0, 3)], halves(), prompted=prompt(1, columns(0, 4)))
    assert (found[1].dense()[0] == columns(0, 4)).all()
    assert found[1].origin.tolist() == [PROMPTED]


def test_the_point_in_front_gives_a_pixel_its_label():
    behind = Visibility(
        "a", np.array([0, 1], np.int32), np.array([3, 3], np.int32), np.array([2.0, 1.0], np.float32), H, W
    )
    painted = paint_labels(behind, np.array([7, 0], np.int32))
    assert (painted.pixel.tolist(), painted.label.tolist()) == ([3], [0])


@pytest.mark.parametrize("masks", ["best", "all"])
def test_the_order_of_masks_does_not_matter(masks):
    random = np.random.default_rng(4)
    pool = random.random((12, H, W)) < random.random((12, 1, 1))
    painted = paint_labels(view(), random.integers(0, 4, H * W).astype(np.int32))
    params = SelectionParams(masks=masks, min_iou=0.05)
    a = select_masks(painted, mask_set(pool), params)
    b = select_masks(painted, mask_set(pool[::-1]), params)
    assert a.keys() == b.keys()
    assert len(a) >= 2
    assert all((a[label] == b[label]).all() for label in a)


@pytest.mark.parametrize("params", [ReprojectParams(), ALL])
def test_true_masks_come_back_with_one_id_in_every_view(params):
    cameras, depths, masks = box_scene.cameras(), box_scene.depths(), box_scene.true_masks()
    cloud = dense(box_scene.frames(), cameras, depths, unit(cameras, depths), params=DenseParams())
    seen = tuple(visibility(cloud, camera_of(cameras, k), d, params=VisibilityParams()) for k, d in enumerate(depths))
    observed = tuple(observe(cloud, view, pool, params=ObserveParams()) for view, pool in zip(seen, masks, strict=True))
    labels = propagate(cloud, seen, observed, params=PropagateParams())
    whole = PointParts(np.zeros(len(cloud.points), np.int32))
    found = reproject(cloud, seen, masks, labels, whole, (), params=params)
    assert len(found) == 4
    truth = np.stack([box_scene.cast(k)[1] for k in range(box_scene.VIEWS)])
    boxes = set()
    for instance in found[1:]:
        dense_masks = instance.dense()
        box = int(np.bincount(truth[list(map(int, instance.views))][dense_masks]).argmax())
        boxes.add(box)
        for k, mask in zip(map(int, instance.views), dense_masks, strict=True):
            assert (mask == (truth[k] == box)).all()
        assert list(map(int, instance.views)) == [k for k in range(box_scene.VIEWS) if (truth[k] == box).any()]
        assert instance.confidence > 0.8
    assert boxes == {1, 2, 3}
    assert (found[0].dense() == (truth == 0)).all()


def test_views_may_differ_in_size():
    cloud, labels = labelled(halves())
    lower = np.vstack([columns(0, 5), np.ones((1, W), bool)])
    views = (view("a"), replace(view("b"), height=H + 1))
    masks = (mask_set(columns(0, 5)[None], "a"), mask_set(lower[None], "b"))
    _, one, _ = reproject(cloud, views, masks, labels, WHOLE, (), params=FOUND_ONLY)
    assert one.sizes.tolist() == [[W, H], [W, H + 1]]
    for mask, truth in zip(one.dense(), (columns(0, 5), lower), strict=True):
        np.testing.assert_array_equal(mask, truth)
    assert one.areas().tolist() == [5 * H, 5 * H + W]


def test_a_label_without_a_mask_is_drawn_from_its_points():
    params = ReprojectParams(min_points=10, reach=0.0)
    instances = run([columns(0, 5)], halves(), params)
    np.testing.assert_array_equal(instances[2].dense()[0], columns(5, 8))
    assert instances[1].origin.tolist() == [FOUND]
    assert instances[2].origin.tolist() == [DRAWN]
    assert not len(run([columns(0, 5)], halves(), replace(params, min_points=13))[2].views)


def test_a_mask_that_its_points_contradict_keeps_only_what_no_other_label_tells_of():
    # The whole view shows label 1 by half: 20 pixels of 40; label 2 has 12 points, too few to be drawn here.
    params = ReprojectParams(min_points=13, reach=0.0)
    one = run([columns(0, 10)], halves(), params)[1]
    np.testing.assert_array_equal(one.dense()[0], columns(0, 5) | columns(8, 10))
    assert one.origin.tolist() == [DRAWN]
    kept = run([columns(0, 10)], halves(), replace(params, min_agreement=0.0))[1]
    assert kept.dense()[0].all() and kept.origin.tolist() == [FOUND]


def test_a_mask_keeps_what_lies_far_from_all_points():
    cloud, labels = labelled(halves())
    seen = np.flatnonzero(columns(0, 8).ravel()).astype(np.int32)
    known = replace(view(), point_index=seen, pixel=seen, depth=np.ones(len(seen), np.float32))
    masks = (mask_set(columns(0, 10)[None], "a"),)
    params = ReprojectParams(min_points=13, reach=0.0)
    _, one, _ = reproject(cloud, (known,), masks, labels, WHOLE, (), params=params)
    np.testing.assert_array_equal(one.dense()[0], columns(0, 5) | columns(8, 10))


def test_a_mask_that_smaller_ones_leave_right_stays():
    # Alone the mask of both halves agrees with label 1 by .6; without the columns of label 2's it agrees fully.
    found = run([columns(0, 8), columns(5, 8)], halves(), ReprojectParams(reach=0.0))
    np.testing.assert_array_equal(found[1].dense()[0], columns(0, 5))
    assert found[1].origin.tolist() == found[2].origin.tolist() == [FOUND]


def test_a_drawn_mask_reaches_a_little_round_its_points():
    painted = PaintedView.of(np.array([0, 5, 33], np.int32), np.array([4, 0, 7], np.int32))
    near = nearest_labels(painted, H, W, 1.5)
    assert near[0, :2].tolist() == [4, 4] and near[1, 0] == 4
    assert near[3, 2:5].tolist() == [7, 7, 7] and near[2, 3] == 7
    assert near[0, 4:7].tolist() == [0, 0, 0]  # nearest to an unlabelled point
    assert near[1, 8] == 0


@pytest.mark.parametrize("apart", [2, 8, 15])
def test_a_drawn_mask_has_no_gaps_in_a_close_view_whose_points_lie_far_apart(apart):
    side = 240
    v, u = np.mgrid[apart // 2 : side : apart, apart // 2 : side : apart]
    pixel = (v * side + u).ravel().astype(np.int32)
    square = (slice(60, 180), slice(60, 180))
    truth = np.zeros((side, side), bool)
    truth[square] = True
    # Around it lies what has no label: the mask must not grow into that, however far it reaches.
    label = truth.ravel()[pixel].astype(np.int32)
    labels = labels_of(label)
    places = np.stack([u.ravel(), v.ravel(), np.zeros(pixel.size)], axis=-1).astype(np.float32)
    cloud = even_cloud(places, np.zeros((pixel.size, 3), np.uint8), 1.0, float(apart))
    seen = Visibility("a", np.arange(pixel.size, dtype=np.int32), pixel, np.ones(pixel.size, np.float32), side, side)
    nothing = mask_set(np.zeros((0, side, side), bool), "a")
    parts = PointParts(np.zeros(pixel.size, np.int32))
    instances = reproject(cloud, (seen,), (nothing,), labels, parts, (), params=ReprojectParams())
    drawn = instances[1].dense()[0]
    assert (drawn & truth).sum() / (drawn | truth).sum() > 0.85


def test_a_smoothed_mask_has_neither_crumbs_nor_holes():
    mask = np.zeros((30, 30), bool)
    mask[5:20, 5:20] = True
    ragged = mask.copy()
    ragged[10, 10] = ragged[5, 12] = False
    ragged[25, 25] = ragged[2, 2] = True
    clean = smoothed(ragged, 1)
    assert (clean ^ mask).sum() <= 8 and clean[10, 10] and not clean[20:].any()
    two = mask.copy()
    two[22:26, 22:26] = True  # 16 of 225 pixels: a crumb
    assert not smoothed(two, 1)[21:, 21:].any()
    two[22:28, 22:28] = True
    assert smoothed(two, 1)[24, 24]
    assert not smoothed(np.zeros((4, 4), bool), 2).any()
