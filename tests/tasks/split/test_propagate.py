from dataclasses import replace

import box_scene
import numpy as np
import pytest
from box_scene import mask_set, permuted, row_of_points, true_masks
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from ss_flow.tasks.artifacts import BORDER, INSIDE, Observation, PointCloud, Visibility
from ss_flow.tasks.capture.views import unit
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.split import propagate as module
from ss_flow.tasks.split.dense import DenseParams, dense
from ss_flow.tasks.split.observe import ClusterParams, ObserveParams, observe
from ss_flow.tasks.split.propagate import PropagateParams, propagate
from ss_flow.tasks.split.visibility import visibility
from ss_flow.tasks.split.votes.at_once import MaskClusteringParams
from ss_flow.tasks.split.votes.in_turn import SequentialParams, _vote
from ss_flow.tasks.split.votes.votes import Votes

BARE = PropagateParams(
    views="in_turn",
    in_turn=SequentialParams(min_overlap=1, min_overlap_share=0, min_new_points=1),
    smoothing=0,
    touching_merge=False,
    label_clusters=ClusterParams(),
    min_label_points=1,
)


def in_turn(**values):
    return replace(BARE, in_turn=replace(BARE.in_turn, **values))


PRESETS = {
    "paper": (in_turn(contested_vote=1.0), ObserveParams(nested=True)),
    "reference": (in_turn(contested_vote=0.75, contested_first_vote=1.0), ObserveParams(nested=True)),
    "default": (BARE, ObserveParams()),
}


def run(points, visible, masks, params, observing=ObserveParams()):
    """The labels that masks give, from the points under each mask on."""
    seen = tuple(observe(points, view, pool, params=observing) for view, pool in zip(visible, masks, strict=True))
    return propagate(points, visible, seen, params=params)


def points(count):
    places = np.stack([np.arange(count), np.zeros(count), np.ones(count)], axis=-1).astype(np.float32)
    return PointCloud(places, np.zeros((count, 3), np.uint8), 1.0, 1.0)


def views_of(*views):
    """Views of one row of points; each view is a list of masks, each mask a list of points."""
    seen, sets = [], []
    for masks in views:
        seen.append(row_of_points(sorted({p for mask in masks for p in mask}))[0])
        sets.append(mask_set(np.stack([row_of_points(mask)[1] for mask in masks])))
    return tuple(seen), tuple(sets)


EXAMPLE = ([[1, 2, 3], [4, 5]], [[2, 3, 4], [5, 6]], [[4, 5, 6]])
"""The worked example E1 of the specification; pixel and point 0 and 7 are seen by no view."""


@pytest.mark.parametrize(
    ("preset", "label_of_4", "share_of_4"),
    [("paper", 0, 2.25 / 3.25), ("reference", 2, 2.25 / 3.0), ("default", 2, 2.25 / (2.25 + 2 / 3))],
)
def test_the_worked_example_of_the_specification(preset, label_of_4, share_of_4):
    visible, masks = views_of(*EXAMPLE)
    result = run(points(8), visible, masks, *PRESETS[preset])
    assert result.label.tolist() == [0, 1, 1, 1, label_of_4, 2, 2, 0]
    np.testing.assert_allclose(result.confidence, [0, 1, 1, 1, share_of_4, 1, 1, 0], rtol=1e-6)
    assert result.num_labels == 2
    assert result.match_view.tolist() == [0, 0, 1, 1, 2]
    assert result.match_mask.tolist() == [0, 1, 0, 1, 0]
    assert result.match_label.tolist() == [1, 2, 1, 2, 2]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("nested", [False, True])
def test_swapping_the_masks_of_the_worked_example_changes_nothing(preset, nested):
    params, _ = PRESETS[preset]
    visible, masks = views_of(*EXAMPLE)
    swapped = tuple(permuted(m, np.arange(len(m))[::-1]) for m in masks)
    a, b = (run(points(8), visible, m, params, ObserveParams(nested=nested)) for m in (masks, swapped))
    assert a.label.tolist() == b.label.tolist()
    assert a.confidence.tolist() == b.confidence.tolist()


@pytest.mark.parametrize(("first", "leader", "share"), [(0.0, 3, 1 / 1.9375), (1.0, 2, 0.5)])
def test_the_first_vote_of_a_point_from_a_contested_mask_has_a_weight_of_its_own(first, leader, share):
    votes, params = Votes(2), SequentialParams(contested_vote=0.75, contested_first_vote=first)
    for rows, label, purity in (([0], 1, 1.0), ([0, 1], 2, 0.5), ([1], 3, 1.0)):
        _vote(votes, np.array(rows, np.int32), label, purity, params)
    labels, shares = votes.leaders()
    assert labels.tolist() == [1, leader]
    np.testing.assert_allclose(shares, [1.25 / 2.0, share])


def test_a_mask_without_enough_points_founds_no_object():
    visible, masks = views_of([[1, 2, 3], [4, 5]])
    result = run(points(8), visible, masks, in_turn(min_new_points=3))
    assert result.label.tolist() == [0, 1, 1, 1, 0, 0, 0, 0]
    assert result.match_mask.tolist() == [0]


def test_labels_of_few_points_are_dropped_in_the_end():
    visible, masks = views_of([[1, 2, 3], [4, 5]])
    result = run(points(8), visible, masks, replace(BARE, min_label_points=3))
    assert set(result.label) == {0, 1}
    assert result.num_labels == 2


@pytest.mark.parametrize(("most", "ids"), [(2, (0, 1, 2)), (3, (0, 2, 3))])
def test_ids_move_up_over_those_that_were_dropped_only_where_the_highest_would_not_fit(monkeypatch, most, ids):
    monkeypatch.setattr(module, "MOST_LABELS", most)
    visible, masks = views_of([[1]], [[2, 3], [4, 5]])
    result = run(points(7), visible, masks, replace(BARE, min_label_points=2))
    assert result.label.tolist() == np.array(ids)[[0, 0, 1, 1, 2, 2, 0]].tolist()
    assert result.num_labels == ids[-1]
    assert result.match_label.tolist() == np.array(ids)[[0, 1, 2]].tolist()


def test_a_mask_that_hardly_touches_a_label_is_a_new_object():
    visible, masks = views_of([[0, 1]], [[1, 2, 3, 4, 5, 6]])
    joined = run(points(8), visible, masks, BARE)
    assert joined.label[6] == joined.label[0] == 1
    for least in ({"min_overlap_share": 0.5}, {"min_overlap": 2}):
        assert run(points(8), visible, masks, in_turn(**least)).label[6] == 2


def test_a_second_pass_matches_early_views_against_late_labels():
    # View 1 sees two halves of an object, view 2 all of it: only then is it known that the halves are one.
    visible, masks = views_of([[1, 2, 3], [4, 5, 6, 7]], [[1, 2, 3, 4, 5, 6, 7]], [[1, 2, 3, 4, 5, 6, 7]])
    once, twice = (
        run(points(8), visible, masks, replace(in_turn(contested_vote=1.0, passes=passes), tau_label=0.6))
        for passes in (1, 2)
    )
    assert once.label[1:].tolist() == [1] * 7
    assert once.confidence[1] == pytest.approx(2 / 3.25)
    assert twice.confidence[1:].tolist() == [1.0] * 7


def test_views_at_once_outvote_one_mask_that_holds_two_objects():
    good = [[0, 1, 2, 3], [4, 5, 6, 7]]
    visible, masks = views_of([[0, 1, 2, 3, 4, 5, 6, 7]], good, good, good, good)
    clustering = MaskClusteringParams(min_points=1)
    result = run(points(8), visible, masks, replace(BARE, views="at_once", at_once=clustering))
    left, right = result.label[:4], result.label[4:]
    assert len(set(left)) == len(set(right)) == 1
    assert left[0] != right[0]
    sequential = run(points(8), visible, masks, BARE)
    assert len(set(sequential.label)) == 1


AT_ONCE = replace(BARE, views="at_once", at_once=MaskClusteringParams(min_points=1))


def test_a_point_that_no_view_sees_takes_no_label_from_its_neighbours():
    visible, masks = views_of(*[[[0, 1, 2], [4, 5, 6, 7]]] * 2)
    assert run(points(8), visible, masks, replace(AT_ONCE, smoothing=3)).label[3] == 0


@pytest.mark.parametrize(("background_vote", "label"), [(0.2, 2), (0.3, 0)])
def test_a_point_that_many_views_see_under_no_mask_gets_no_label(background_vote, label):
    # One view has a mask over points 1 to 3; four see them under none: a vote of 1 against 0.8 and 1.2.
    visible, masks = views_of([[1, 2, 3], [4, 5, 6]], *[[[4, 5, 6]]] * 4)
    seen = visible[0], *[row_of_points([1, 2, 3, 4, 5, 6])[0]] * 4
    voting = MaskClusteringParams(min_points=1, background_vote=background_vote)
    found = run(points(8), seen, masks, replace(AT_ONCE, at_once=voting, min_label_views=1))
    assert found.label[1:7].tolist() == [label] * 3 + [1] * 3


def test_a_second_copy_of_a_view_confirms_no_label():
    twice = [[1, 2, 3], [4, 5, 6]]
    visible, masks = views_of(twice, twice, *[[[4, 5, 6]]] * 3)
    others = (row_of_points([1, 2, 3, 4, 5, 6, *more])[0] for more in ([], [0], [7]))
    voting = MaskClusteringParams(min_points=1, background_vote=0.0)
    found = run(points(8), (*visible[:2], *others), masks, replace(AT_ONCE, at_once=voting))
    assert found.label[4:7].all() and not found.label[1:4].any()


def test_the_background_is_no_label_that_views_fail_to_confirm(recwarn):
    _, masks = views_of(*[[[4, 5, 6]]] * 2)
    seen = tuple(row_of_points([*more, 1, 2, 3, 4, 5, 6])[0] for more in ([], [0]))
    assert run(points(8), seen, masks, AT_ONCE).label.tolist() == [0] * 4 + [1] * 3 + [0]
    assert not recwarn.list


@pytest.mark.parametrize(("touching_merge", "labels"), [(True, 1), (False, 2)])
def test_halves_of_a_sheet_that_masks_part_are_united_only_where_asked(touching_merge, labels):
    v, u = np.divmod(np.arange(400), 20)
    places = np.stack([u, v, 0 * u], axis=1).astype(np.float32)
    cloud = PointCloud(places, np.full((400, 3), 128, np.uint8), 1.0, 1.0)
    every = np.arange(400, dtype=np.int32)
    view = Visibility("0", every, every, np.ones(400, np.float32), 20, 20)
    left = (u < 10).reshape(20, 20)
    found = run(cloud, (view,), (mask_set(np.stack([left, ~left])),), PropagateParams(touching_merge=touching_merge))
    assert len(np.unique(found.label[found.label > 0])) == labels


def test_a_mask_that_overlaps_no_label_is_a_new_object_however_little_is_asked_for():
    visible, masks = views_of([[0, 1]], [[2, 3]])
    assert run(points(8), visible, masks, in_turn(min_overlap=0)).match_label.tolist() == [1, 2]


def lying(*masks) -> Observation:
    """A view of points 0, 1, ..., all of them under each of its masks, and how they lie there."""
    every = np.arange(len(masks[0]), dtype=np.int32)
    first = (len(every) * np.arange(len(masks) + 1)).astype(np.int32)
    standing = np.concatenate(masks).astype(np.uint8)
    return Observation("0", every, np.arange(len(masks), dtype=np.int32), first, np.tile(every, len(masks)), standing)


@pytest.mark.parametrize(("standing", "label"), [([INSIDE] * 4, 1), ([BORDER, BORDER, INSIDE, INSIDE], 2)])
def test_points_at_the_border_of_a_mask_are_no_overlap(standing, label):
    view, _ = row_of_points([0, 1, 2, 3])
    both = lying([INSIDE, INSIDE, BORDER, BORDER]), lying(standing)
    assert propagate(points(8), (view, view), both, params=BARE).match_label.tolist() == [1, label]


def test_points_that_a_pass_left_contested_are_painted_with_no_label_in_the_next():
    # Points 6 and 7 are of one mask in the last view; two labels share the votes on 6.
    visible, masks = views_of([[0, 1], [2, 3, 6], [4, 5]], [[0, 1], [2, 3], [4, 5, 6]], [[6, 7]])
    found = run(points(8), visible, masks, in_turn(passes=2, lambda_init=0.001))
    assert found.match_view.tolist()[-1] == 2 and found.match_label.tolist()[-1] == 4


@pytest.fixture(scope="module")
def boxes():
    cameras, depths = box_scene.cameras(), box_scene.depths()
    cloud = dense(box_scene.frames(), cameras, depths, unit(cameras, depths), params=DenseParams())
    seen = tuple(visibility(cloud, camera_of(cameras, k), d, params=VisibilityParams()) for k, d in enumerate(depths))
    return cloud, seen


def degraded(seed):
    """True masks of the boxes with ragged borders, halves in some views, and one that covers two boxes."""
    random = np.random.default_rng(seed)
    sets = []
    for pool in true_masks():
        masks = list(pool.dense())
        if random.random() < 0.5:
            i = int(random.integers(len(masks)))
            _, u = np.nonzero(masks[i])
            left = masks[i].copy()
            left[:, int(np.median(u)) :] = False
            masks.append(left)
        noise = random.random((len(masks), *masks[0].shape)) < 0.02
        sets.append(mask_set(np.stack(masks) ^ (noise & np.stack(masks)), pool.name))
    first = sets[0].dense()
    sets[0] = mask_set(np.concatenate([first, (first[0] | first[1])[None]]), "0")
    return tuple(sets)


DEFAULTS = (
    (PropagateParams(), ObserveParams()),
    (PropagateParams(views="in_turn", in_turn=SequentialParams(passes=2)), ObserveParams()),
    (PropagateParams(views="in_turn"), ObserveParams(nested=True)),
)


@pytest.mark.parametrize("params", DEFAULTS)
def test_true_masks_give_each_box_one_label_in_all_views(boxes, params):
    cloud, seen = boxes
    result = run(cloud, seen, true_masks(), *params)
    for number, (low, high) in enumerate(box_scene.BOXES, start=1):
        inner = ((cloud.points > low + 0.03 * (low > 0)) & (cloud.points < high + 0.01)).all(axis=1)
        inner &= (cloud.points[:, 2] > 0.05) & (cloud.points[:, 0] > low[0] - 0.01)
        labels, counts = np.unique(result.label[inner], return_counts=True)
        assert counts.max() / counts.sum() > 0.9, number
        assert labels[counts.argmax()] > 0
    assert len(np.unique(result.label)) == 4


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 1000))
@pytest.mark.parametrize("params", DEFAULTS)
def test_permuting_the_masks_of_every_view_changes_no_label(boxes, params, seed):
    cloud, seen = boxes
    masks = degraded(seed)
    random = np.random.default_rng(seed)
    shuffled = tuple(permuted(m, random.permutation(len(m))) for m in masks)
    a, b = (run(cloud, seen, m, *params) for m in (masks, shuffled))
    assert a.label.tobytes() == b.label.tobytes()
    assert a.confidence.tobytes() == b.confidence.tobytes()


@settings(deadline=None, max_examples=8)
@given(scale=st.floats(0.01, 100), seed=st.integers(0, 1000))
def test_scaling_the_world_changes_no_label(boxes, scale, seed):
    cloud, seen = boxes
    clusters = ClusterParams(eps=5.0)
    params = (
        PropagateParams(label_clusters=replace(clusters, eps=2.5, keep_share=0.05)),
        ObserveParams(clusters=clusters),
    )
    scaled = replace(cloud, points=cloud.points * np.float32(scale), unit=scale, spacing=cloud.spacing * scale)
    far = tuple(replace(v, depth=v.depth * np.float32(scale)) for v in seen)
    masks = degraded(seed)
    a, b = run(cloud, seen, masks, *params), run(scaled, far, masks, *params)
    assert (a.label == b.label).mean() > 0.999


@pytest.mark.parametrize("scale", [1 / 64, 64.0])
def test_scaling_the_world_changes_no_label_from_depth_to_labels(scale):
    labels = []
    for size in (0.5, scale):
        cameras, depths = box_scene.cameras(size), box_scene.depths(size)
        cloud = dense(box_scene.frames(), cameras, depths, unit(cameras, depths), params=DenseParams())
        seen = tuple(
            visibility(cloud, camera_of(cameras, k), d, params=VisibilityParams()) for k, d in enumerate(depths)
        )
        labels.append(run(cloud, seen, degraded(3), PropagateParams()).label)
    assert labels[0].tobytes() == labels[1].tobytes()


def test_clustering_keeps_stray_points_of_a_mask_from_voting(boxes):
    cloud, seen = boxes
    masks = list(true_masks())
    first = masks[0].dense().copy()
    first[0, :6, :6] = True  # a patch of the far floor
    masks[0] = mask_set(first, "0")
    only = (seen[0],), (masks[0],)
    cleaned = ObserveParams(clusters=ClusterParams(eps=5.0, keep_share=1.0))
    stray = (seen[0].pixel % box_scene.WIDTH < 3) & (seen[0].pixel // box_scene.WIDTH < 3)
    assert stray.any()
    rows = seen[0].point_index[stray]
    assert (run(cloud, *only, BARE).label[rows] > 0).all()
    assert (run(cloud, *only, BARE, cleaned).label[rows] == 0).all()


def test_views_without_masks_label_nothing(boxes):
    cloud, seen = boxes
    nothing = tuple(mask_set(np.zeros((0, box_scene.HEIGHT, box_scene.WIDTH), bool), v.name) for v in seen)
    result = run(cloud, seen, nothing, PropagateParams())
    assert not result.label.any()
    assert result.num_labels == 0
    assert len(result.match_mask) == 0


def relabelled(a, b):
    """Share of the points whose label in `b` is not what their label in `a` became."""
    table = np.zeros((a.max() + 1, b.max() + 1), int)
    np.add.at(table, (a, b), 1)
    rows, columns = linear_sum_assignment(-table[1:, 1:])
    return 1 - (table[1:, 1:][rows, columns].sum() + table[0, 0]) / len(a)


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 1000))
def test_permuting_the_views_changes_no_label(boxes, seed):
    cloud, seen = boxes
    masks = degraded(seed)
    order = np.random.default_rng(seed).permutation(len(seen))
    a = run(cloud, seen, masks, PropagateParams())
    b = run(cloud, tuple(seen[k] for k in order), tuple(masks[k] for k in order), PropagateParams())
    assert a.label.tobytes() == b.label.tobytes()


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 1000))
def test_seeing_every_view_twice_changes_no_label(boxes, seed):
    cloud, seen = boxes
    masks = degraded(seed)
    a, b = run(cloud, seen, masks, PropagateParams()), run(cloud, 2 * seen, 2 * masks, PropagateParams())
    assert a.label.tobytes() == b.label.tobytes()


def test_views_clustered_in_lots_give_the_same_labels(boxes):
    cloud, seen = boxes
    few = PropagateParams(at_once=MaskClusteringParams(max_views=3))
    a, b = run(cloud, seen, true_masks(), PropagateParams()), run(cloud, seen, true_masks(), few)
    assert relabelled(a.label, b.label) < 0.01
    assert set(b.match_view.tolist()) == set(range(len(seen)))


def test_contested_points_follow_their_neighbours():
    # Two views disagree about point 3 of a row; its neighbours are sure.
    row = [[0, 1, 2, 3], [4, 5, 6, 7]], [[0, 1, 2], [3, 4, 5, 6, 7]]
    visible, masks = views_of(*row, *row)
    wanted = replace(BARE, views="at_once", at_once=MaskClusteringParams(min_points=1))
    assert run(points(8), visible, masks, wanted).label[3] == 0
    smooth = run(points(8), visible, masks, replace(wanted, smoothing=1))
    assert (smooth.label > 0).all()
    assert len(set(smooth.label.tolist())) == 2


@pytest.mark.parametrize(("others", "stays"), [(1, True), (2, True), (3, False)])
def test_a_label_that_one_view_shows_goes_to_the_background_where_many_others_look(others, stays):
    visible, masks = views_of([[1, 2, 3], [4, 5, 6]], *[[[4, 5, 6]]] * others)
    besides = [], [0], [7]  # as a second copy of a view confirms nothing
    seen_by_all = visible[0], *(row_of_points([1, 2, 3, 4, 5, 6, *more])[0] for more in besides[:others])
    params = replace(BARE, views="at_once", at_once=MaskClusteringParams(min_points=1, background_vote=0.0))
    settled = run(points(8), seen_by_all, masks, params)
    assert settled.label[4:7].all() and settled.label[1:4].any() == stays
    assert settled.match_label.tolist().count(0) == (not stays)
    # Where no other view looks, it stays; so it does with min_label_views=1, and with a share of 0.
    for views, kept in (
        (visible, params),
        (seen_by_all, replace(params, min_label_views=1)),
        (seen_by_all, replace(params, min_label_share=0.0)),
    ):
        assert run(points(8), views, masks, kept).label[1:7].all()


SEAT = [INSIDE] * 100
SEAT_AND_LEG = replace(
    points(104),
    points=np.array([*np.ndindex(10, 10, 1), (40, 0, 0), (41, 0, 0), (42, 0, 0), (43, 0, 0)], np.float32),
)
"""A seat of 100 points and, well apart, a leg of 4."""


@pytest.mark.parametrize(
    ("inside_in", "tau_piece", "stays"),
    [(2, 0.55, True), (1, 0.55, True), (0, 0.55, False), (1, 0.75, False), (2, 1, False)],
)
def test_a_small_piece_of_a_label_stays_where_views_see_it_inside_of_masks(inside_in, tau_piece, stays):
    views = [lying(SEAT + [INSIDE if view < inside_in else BORDER] * 4) for view in range(2)]
    found = propagate(SEAT_AND_LEG, (), views, params=PropagateParams(tau_piece=tau_piece))
    assert found.label[:100].all()
    assert found.label[100:].all() == found.label[100:].any() == stays


@pytest.mark.parametrize("legs", [([INSIDE] * 4, [BORDER] * 4), ([BORDER] * 4, [INSIDE] * 4)])
def test_a_small_piece_under_two_masks_of_its_label_is_where_the_better_one_says(legs):
    view = lying(*(SEAT + leg for leg in legs))
    assert propagate(SEAT_AND_LEG, (), [view], params=PropagateParams()).label.all()


@pytest.mark.parametrize(
    ("changes", "keep_share", "floor"),
    [({}, 0.05, 2), ({"apart": False}, 0.05, 1), ({"min_label_points": 3}, 0.05, 1), ({}, 0.5, 1)],
)
def test_masks_show_the_piece_of_a_parted_label_that_they_hold_most_of(changes, keep_share, floor):
    table, below = [0, 1, 2, 3], [6, 7]  # two points, a third of all
    visible, masks = views_of([table + below], [table, below], [table, below])
    kept = ClusterParams(eps=1.5, min_samples=1, keep_share=keep_share)
    found = run(points(8), visible, masks, replace(BARE, label_clusters=kept, **changes))
    assert set(found.label[table].tolist()) == {1}
    assert set(found.label[below].tolist()) == {floor}
    assert found.num_labels == floor
    shown = np.stack([found.match_view, found.match_mask, found.match_label], axis=1).tolist()
    assert sorted(shown) == [[0, 0, 1], [1, 0, 1], [1, 1, floor], [2, 0, 1], [2, 1, floor]]


def test_a_label_that_is_parted_takes_no_number_of_one_that_was_dropped():
    table, below, dropped = [0, 1, 2, 3], [6, 7], [5]
    visible, masks = views_of([table + below, dropped], [table, below], [table, below])
    kept = ClusterParams(eps=1.5, min_samples=1, keep_share=0.05)
    found = run(points(8), visible, masks, replace(BARE, label_clusters=kept, min_label_points=2))
    assert found.label.tolist() == [1, 1, 1, 1, 0, 0, 3, 3] and found.num_labels == 3
