from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Appearances, Gaussians
from ss_flow.tasks.splat.collisions import collision_matrix, group_box, match_pairs
from ss_flow.tasks.splat.merge import collision_box
from ss_flow.tasks.splat.plan import PlanParams, plan

UNTIL_NONE = PlanParams(max_rounds=1_000_000)
EXACT = replace(UNTIL_NONE, bbox_quantile=0.0)
NOWHERE_SHOWN = Appearances(instance_id=np.zeros(0, np.int32), **Appearances.arrays([]))


def group(points, instance_id: int, opacity: float = 0.9) -> Gaussians:
    points = np.asarray(points, np.float32).reshape(-1, 3)
    n = len(points)
    return Gaussians(
        means=points,
        quaternions=np.tile(np.array([[1, 0, 0, 0]], np.float32), (n, 1)),
        log_scales=np.full((n, 3), -3, np.float32),
        opacity_logits=np.full(n, np.log(opacity / (1 - opacity)), np.float32),
        sh=np.zeros((n, 1, 3), np.float32),
        instance_id=np.full(n, instance_id, np.int32),
        instance_conf=np.ones(n, np.float32),
        part_id=np.zeros(n, np.int32),
    )


def union(a: Gaussians, b: Gaussians) -> Gaussians:
    return Gaussians(**{name: np.concatenate([getattr(a, name), getattr(b, name)]) for name in vars(a)})


def spread(count: int, low, high) -> np.ndarray:
    """`count` points that span a box exactly: its two corners, and the rest along its diagonal."""
    share = np.linspace(0, 1, count)[:, None]
    return np.asarray(low) + share * (np.asarray(high, float) - low)


def table_cup_book_floor_lamp() -> dict[str, Gaussians]:
    """Places that give the collision shares of golden example E2."""
    cup = [1.1, -0.1, -0.1], [1.4, 0.1, 0.1]
    book = [-0.1, 1.1, -0.1], [0.1, 1.4, 0.1]
    floor = [-0.5, -0.5, -2.0], [0.5, 0.5, -0.8]
    table = np.concatenate(
        [
            [[-1.2, -1.2, -1.0], [1.2, 1.2, 1.0]],
            spread(2, [1.1, 0, 0], [1.15, 0, 0]),
            spread(5, [0, 1.1, 0], [0, 1.15, 0]),
            spread(30, [0, 0, -0.95], [0, 0, -0.85]),
            spread(61, [-0.9, -0.9, 0.5], [0.9, 0.9, 0.9]),
        ]
    )
    return {
        "A": group(table, 1),
        "B": group([cup[0], *spread(17, [1.11, 0, 0], [1.19, 0, 0]), [1.3, 0, 0], cup[1]], 2),
        "C": group(
            [book[0], *spread(17, [0, 1.11, 0], [0, 1.19, 0]), *spread(11, [0, 1.3, 0], [0, 1.39, 0]), book[1]], 3
        ),
        "D": group(
            [floor[0], *spread(19, [0, 0, -0.99], [0, 0, -0.9]), *spread(179, [0, 0, -1.9], [0, 0, -1.1]), floor[1]], 4
        ),
        "E": group(spread(10, [9, 9, 9], [10, 10, 10]), 5),
    }  # fmt: skip


def test_the_box_of_what_collides_is_that_of_the_solid_centres_widened_by_a_share_of_its_diagonal():
    solid = group(spread(201, [0, 0, 0], [30, 40, 0]), 1)  # of which 1 is trimmed off at each end
    faint = group([[99, 99, 99]], 1, opacity=0.05)
    box = np.array([[0.15, 0.2, 0], [29.85, 39.8, 0]])
    np.testing.assert_allclose(collision_box(union(solid, faint), 0.0), box, atol=1e-6)
    np.testing.assert_allclose(collision_box(union(solid, faint), 0.1), box + 4.95 * np.array([[-1], [1]]), atol=1e-6)


def test_the_golden_scene_has_the_collision_shares_of_the_specification():
    groups = list(table_cup_book_floor_lamp().values())
    boxes = np.array([group_box(g, min_opacity=0.1, quantile=0.0) for g in groups])
    matrix = collision_matrix([g.means for g in groups], boxes)
    expected = np.zeros((5, 5))
    expected[1, 0], expected[0, 1] = 0.9, 0.02
    expected[2, 0], expected[0, 2] = 0.6, 0.05
    expected[0, 3], expected[3, 0] = 0.3, 0.1
    np.testing.assert_allclose(matrix, expected)


def test_table_cup_book_and_floor_merge_in_the_golden_order_and_the_lamp_never():
    a, b, c, d, e = table_cup_book_floor_lamp().values()

    first = plan((a, b, c, d, e), NOWHERE_SHOWN, params=EXACT, round=0)
    assert first.pairs.tolist() == [[0, 1]] and first.singles.tolist() == [2, 3, 4]
    np.testing.assert_allclose(first.scores, [0.9])
    assert first.mask_weight == 0.05

    ab = union(a, b)
    second = plan((ab, c, d, e), NOWHERE_SHOWN, params=EXACT, round=1)
    assert second.pairs.tolist() == [[0, 1]] and second.singles.tolist() == [2, 3]
    np.testing.assert_allclose(second.scores, [0.6])
    np.testing.assert_allclose(second.collisions[0, 2], 30 / 120)
    assert second.mask_weight == 0.15

    abc = union(ab, c)
    third = plan((abc, d, e), NOWHERE_SHOWN, params=EXACT, round=2)
    assert third.pairs.tolist() == [[0, 1]]
    np.testing.assert_allclose(third.scores, [0.2])
    assert third.mask_weight == 0.25

    last = plan((union(abc, d), e), NOWHERE_SHOWN, params=EXACT, round=3)
    assert last.pairs.shape == (0, 2) and last.singles.tolist() == [0, 1]
    assert last.mask_weight == 0.25


def test_a_group_is_in_one_pair_only_and_the_rest_pair_up_among_themselves():
    collisions = np.zeros((4, 4))
    collisions[0, 1], collisions[1, 2], collisions[2, 3] = 0.8, 0.9, 0.1
    pairs, scores = match_pairs(collisions, np.full(4, 10), np.arange(4))
    assert pairs.tolist() == [[1, 2]] and scores.tolist() == [0.9]
    collisions[3, 0] = 0.05
    assert match_pairs(collisions, np.full(4, 10), np.arange(4))[0].tolist() == [[1, 2], [0, 3]]


def test_equal_overlap_prefers_fewer_gaussians_then_lower_ids():
    collisions = np.full((4, 4), 0.5)
    np.fill_diagonal(collisions, 0)
    assert match_pairs(collisions, np.array([90, 10, 20, 90]), np.arange(4))[0].tolist() == [[1, 2], [0, 3]]
    assert match_pairs(collisions, np.full(4, 5), np.array([7, 3, 5, 4]))[0].tolist() == [[1, 3], [2, 0]]


@given(st.integers(0, 2**32 - 1), st.integers(1, 7))
def test_the_order_of_the_groups_does_not_change_who_merges(seed, count):
    rng = np.random.default_rng(seed)
    collisions = np.round(rng.random((count, count)) * 4) / 4
    np.fill_diagonal(collisions, 0)
    sizes, ids = rng.integers(1, 4, count), rng.permutation(count)
    order = rng.permutation(count)
    pairs, _ = match_pairs(collisions, sizes, ids)
    shuffled, _ = match_pairs(collisions[np.ix_(order, order)], sizes[order], ids[order])
    assert ids[pairs].tolist() == ids[order][shuffled].tolist()
    assert len(np.unique(pairs)) == pairs.size
    free = np.setdiff1d(np.arange(count), pairs)
    assert not np.maximum(collisions, collisions.T)[np.ix_(free, free)].any()


def test_the_box_ignores_faint_and_outlying_centres():
    points = np.concatenate([spread(1000, [0, 0, 0], [1, 1, 1]), [[50, 50, 50]]])
    solid, faint = group(points, 1), group([[-9, -9, -9]], 1, opacity=0.05)
    box = group_box(union(solid, faint), min_opacity=0.1, quantile=0.005)
    assert (box[0] >= 0).all() and (box[1] <= 1).all() and (box[1] - box[0] > 0.98).all()


def test_a_group_without_gaussians_collides_with_nothing():
    empty = group(np.zeros((0, 3)), 1)
    result = plan((empty, empty, group(spread(9, [0, 0, 0], [1, 1, 1]), 2)), NOWHERE_SHOWN, params=EXACT, round=0)
    assert not len(result.pairs) and result.singles.tolist() == [0, 1, 2]


def pairs(*groups: Gaussians, **changes) -> list[list[int]]:
    return plan(groups, NOWHERE_SHOWN, params=replace(EXACT, **changes), round=0).pairs.tolist()


def test_the_background_is_in_no_pair_whichever_lies_in_the_other():
    room = group(spread(20, [0, 0, 0], [9, 9, 9]), 0)
    cup, book = group(spread(20, [4, 4, 4], [5, 5, 5]), 2), group(spread(20, [4.5, 4.5, 4.5], [6, 6, 6]), 3)
    assert pairs(room, cup) == pairs(cup, room) == []
    assert pairs(room, cup, book) == [[1, 2]]


def test_a_plan_pairs_by_boxes_without_the_faint_and_outlying_centres_that_it_is_told_of():
    lamp, far = spread(400, [0, 0, 0], [1, 1, 1]), [[9, 9, 9]]
    cup = group(spread(10, [4, 4, 4], [5, 5, 5]), 2)  # between the lamp and what is far from it
    stray = group(np.concatenate([lamp, far]), 1)
    assert pairs(stray, cup) == [[0, 1]] and pairs(stray, cup, bbox_quantile=0.005) == []
    faint = union(group(lamp, 1), group(far, 1, opacity=0.05))
    assert pairs(faint, cup) == [] and pairs(faint, cup, min_opacity=0.01) == [[0, 1]]


def test_a_plan_by_cubes_makes_none_for_fainter_gaussians_than_it_is_told():
    pane, mirror = (group([[x, y, z] for x in range(10) for y in range(10)], 1 + z, opacity=0.05) for z in range(2))
    assert pairs(pane, mirror, overlap="voxel") == []
    assert pairs(pane, mirror, overlap="voxel", min_opacity=0.01) == [[0, 1]]


def test_a_plan_lets_pairs_wait_that_collide_with_another_only_where_it_is_told():
    # Ten points each on a line: 1 and 2 share nine, so do 3 and 4; 2 and 3 share one.
    row = [group([[x, 0, 0] for x in range(start, start + 10)], 1 + k) for k, start in enumerate((0, 1, 10, 11))]
    assert pairs(*row) == [[0, 1], [2, 3]]
    assert pairs(*row, pairing="collision_free") == [[0, 1]]


def test_pairs_below_the_least_score_stay_apart():
    a, b, *_ = table_cup_book_floor_lamp().values()
    assert not len(plan((a, b), NOWHERE_SHOWN, params=replace(EXACT, min_score=0.95), round=0).pairs)


def test_after_the_last_round_nothing_is_left_to_merge():
    groups = tuple(table_cup_book_floor_lamp().values())
    once = replace(EXACT, max_rounds=1)
    assert len(plan(groups, NOWHERE_SHOWN, params=once, round=0).pairs)
    after = plan(groups, NOWHERE_SHOWN, params=once, round=1)
    assert not len(after.pairs) and after.singles.tolist() == list(range(len(groups)))


def test_taken_literally_a_pair_waits_while_it_collides_with_another():
    collisions = np.zeros((5, 5))
    collisions[0, 1], collisions[1, 2], collisions[2, 3] = 0.9, 0.2, 0.8
    sizes, ids = np.full(5, 10), np.arange(5)
    assert match_pairs(collisions, sizes, ids)[0].tolist() == [[0, 1], [2, 3]]
    assert match_pairs(collisions, sizes, ids, collision_free=True)[0].tolist() == [[0, 1]]
    collisions[1, 2] = 0
    assert match_pairs(collisions, sizes, ids, collision_free=True)[0].tolist() == [[0, 1], [2, 3]]


def test_cubes_tell_what_touches_a_floor_from_what_hangs_over_a_step_of_it():
    side = np.arange(0, 2, 0.02)
    plane = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    low, high = plane[plane[:, 0] < 1], plane[plane[:, 0] >= 1]
    steps = np.concatenate([np.c_[low, np.zeros(len(low))], np.c_[high, np.ones(len(high))]])
    standing, hanging = (np.array([[0.5, 0.5, z], [0.52, 0.5, z]]) for z in (0.04, 0.5))
    groups = (group(steps, 1), group(standing, 2), group(hanging, 3))
    boxes = plan(groups, NOWHERE_SHOWN, params=EXACT, round=0).collisions
    assert boxes[1, 0] == boxes[2, 0] == 1
    cubes = plan(groups, NOWHERE_SHOWN, params=replace(UNTIL_NONE, overlap="voxel"), round=0).collisions
    assert cubes[1, 0] == 1 and cubes[0, 1] > 0 and not cubes[2].any() and not cubes[:, 2].any()


def merged_to_the_end(groups: list[Gaussians], params: PlanParams) -> tuple[set[frozenset[int]], int]:
    """Which instances end in one group, and after how many rounds."""
    for rounds in range(len(groups) + 1):
        found = plan(tuple(groups), NOWHERE_SHOWN, params=params, round=rounds)
        if not len(found.pairs):
            return {frozenset(g.instance_id.tolist()) for g in groups}, rounds
        groups = [union(groups[a], groups[b]) for a, b in found.pairs] + [groups[i] for i in found.singles]
    raise AssertionError("merging does not end")


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.sampled_from(["box", "voxel"]), st.booleans())
def test_merging_ends_and_the_order_of_the_instances_does_not_matter(seed, count, overlap, literal):
    rng = np.random.default_rng(seed)
    params = replace(UNTIL_NONE, overlap=overlap, pairing="collision_free" if literal else "disjoint")
    corners = rng.random((count, 3)) * 3
    groups = [
        group(corner + rng.random((rng.integers(1, 12), 3)), i + 1) for i, corner in enumerate(corners)
    ]  # fmt: skip
    ends, rounds = merged_to_the_end(groups, params)
    assert rounds < max(count, 1)
    assert merged_to_the_end([groups[i] for i in rng.permutation(count)], params) == (ends, rounds)
