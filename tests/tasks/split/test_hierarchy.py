import numpy as np
import pytest
from clouds import even_cloud
from hypothesis import given, settings
from hypothesis import strategies as st
from labelled_points import labels_of, one_camera

from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import Hierarchy, Tally
from ss_flow.tasks.split import hierarchy as module
from ss_flow.tasks.split.contact import Contact
from ss_flow.tasks.split.cut import instances_of
from ss_flow.tasks.split.hierarchy import HierarchyParams, hierarchy
from ss_flow.tasks.split.inlays import Inlays
from ss_flow.tasks.split.mounds import Mounds
from ss_flow.tasks.split.stuff import StuffParams
from ss_flow.tasks.split.unions import Pieces

NO_BORDERS = np.zeros((9, 9), np.int32)
SEES = 100
"""Points that a view sees of each label."""


def tally(masks: list[tuple[set[int], float]], sees: set[int], points: int = SEES) -> Tally:
    """A view that sees so many points of some labels, and masks that hold all those of theirs: (labels, quality)."""
    label = np.array(sorted(sees), np.int32)
    held = np.array([[points * (i in of) for i in label] for of, _ in masks], np.int32).reshape(len(masks), len(label))
    quality = np.array([q for _, q in masks], np.float32)
    return Tally(
        "a", label, np.full(len(label), points, np.int32), held, NO_BORDERS[: len(label), : len(label)], quality
    )


def tree(tallies: list[Tally], labels: int, unused: int = 0, **changes) -> Hierarchy:
    """Labels 1.., each a ball of 20 points far from the others, so that none is flat; higher ones are unused.
    What touches what does not count, if not asked for."""
    rng = np.random.default_rng(0)
    label = np.repeat(np.arange(1, labels + 1, dtype=np.int32), 20)
    places = rng.normal(size=(len(label), 3)).astype(np.float32)
    places[:, 0] += 9 * (label - 1)
    cloud = even_cloud(places, np.zeros((len(places), 3), np.uint8), 1.0, 0.1)
    given = labels_of(label, labels + unused)
    params = HierarchyParams(**{"prior": 0.0, "contact": 0.0, "apart": 0.0, **changes})
    return hierarchy(cloud, one_camera(np.eye(4)), [], given, tallies, params=params)


def unions(found: Hierarchy) -> dict[frozenset[int], float]:
    """The leaves of each union, and its agreement."""
    children: dict[int, list[int]] = {}
    for node, parent in zip(found.node.tolist(), found.parent.tolist(), strict=True):
        children.setdefault(parent, []).append(node)

    def leaves(node: int) -> set[int]:
        return set().union(*map(leaves, children[node])) if node in children else {node}

    agreement = dict(zip(found.node.tolist(), found.agreement.tolist(), strict=True))
    return {frozenset(leaves(n)): pytest.approx(agreement[n], abs=1e-4) for n in children if n}


def test_what_most_views_show_under_one_mask_is_one():
    faces = [({1, 2}, 0.9), ({1}, 0.9), ({2}, 0.9)]
    apart = [({1}, 0.9), ({2}, 0.9)]
    found = tree([tally(faces, {1, 2, 3}), tally(faces, {1, 2, 3}, 90), tally(apart, {1, 2})], 3)
    assert unions(found) == {frozenset({1, 2}): 2 / 3}
    assert found.node.tolist() == [1, 2, 3, 4] and found.parent.tolist() == [4, 4, 0, 0]


def test_views_that_see_one_piece_alone_have_no_say():
    alone = [tally([({1}, 0.9)], {1}, points) for points in range(90, 95)]
    assert unions(tree([tally([({1, 2}, 0.9)], {1, 2}), *alone], 2)) == {frozenset({1, 2}): 1.0}


def test_a_box_is_whole_though_no_view_sees_all_its_faces():
    views = [tally([(set(pair), 0.9), ({pair[0]}, 0.9)], set(pair)) for pair in ((1, 2), (2, 3), (3, 4), (4, 1))]
    assert frozenset({1, 2, 3, 4}) in unions(tree(views, 4))


def test_a_mask_of_two_things_of_which_the_segmenter_is_less_sure_is_a_group_at_most():
    # Sure of each thing (0.95) and in doubt of both together (0.8): with a doubt of 0.2, a quarter remains.
    views = [tally([({1, 2}, 0.8), ({1}, 0.95), ({2}, 0.95)], {1, 2}, points) for points in (80, 90, 100)]
    assert unions(tree(views, 2, doubt=0.2)) == {frozenset({1, 2}): 0.25}
    assert unions(tree(views, 2, doubt=0.2, min_agreement=0.3)) == {}


def test_the_best_union_comes_first_and_becomes_a_piece_of_the_next():
    masks = [({1, 2}, 0.9), ({1, 2, 3}, 0.9)]
    views = [tally(masks, {1, 2, 3}), tally(masks[:1], {1, 2, 3})]
    found = tree(views, 3)
    assert unions(found) == {frozenset({1, 2}): 1.0, frozenset({1, 2, 3}): 0.5}
    assert found.parent.tolist() == [4, 4, 5, 5, 0]


def beside(points: int, held: int) -> Tally:
    """A view of label 1, all under its one mask, and of some points of label 2, of which so many are under it too."""
    seen, under = np.array([SEES, points], np.int32), np.array([[SEES, held]], np.int32)
    return Tally("a", np.array([1, 2], np.int32), seen, under, NO_BORDERS[:2, :2], np.array([0.9], np.float32))


@pytest.mark.parametrize(
    ("most", "sees", "agreement"), [(100, 3, 1.0), (100, 19, 1.0), (100, 20, 0.5), (30, 9, 1.0), (30, 12, 0.5)]
)
def test_a_view_speaks_of_what_it_sees_ten_points_of_and_a_fifth_of_what_another_one_does(most, sees, agreement):
    assert unions(tree([beside(most, most), beside(sees, 0)], 2)) == {frozenset({1, 2}): agreement}


def test_of_sets_that_agree_equally_the_smaller_comes_first():
    masks = [({1, 2, 3}, 0.9), ({2, 3}, 0.9)]
    assert unions(tree([tally(masks, {1, 2, 3})], 3)) == {frozenset({2, 3}): 1.0, frozenset({1, 2, 3}): 1.0}


def test_a_set_waits_for_a_better_one_that_it_shares_a_piece_with_though_that_one_waits_too():
    masks = [({1, 2}, 0.9), ({2, 3}, 0.9), ({3, 4}, 0.9)]  # that three views show, two, and one
    found = unions(tree([tally(masks[: 3 - k], {1, 2, 3, 4}, SEES - k) for k in range(3)], 4, silent=1.0))
    assert frozenset({1, 2}) in found and frozenset({3, 4}) not in found


def test_what_no_view_shows_as_one_stays_apart_though_no_agreement_is_asked_for():
    masks = [({1, 2}, 0.5), ({1}, 0.95), ({2}, 0.95)]
    assert unions(tree([tally(masks, {1, 2})], 2, min_agreement=0.0)) == {}


def test_nodes_are_numbered_after_all_labels_whether_points_carry_them_or_not():
    assert tree([tally([({1, 2}, 0.9)], {1, 2})], 2, unused=5).node.tolist() == [1, 2, 8]


def half_agree(views: int) -> list[tuple[list[tuple[set[int], float]], int]]:
    """Views, all different, of which every second shows two pieces as one."""
    both, apart = [({1, 2}, 0.9), ({1}, 0.9), ({2}, 0.9)], [({1}, 0.9), ({2}, 0.9)]
    return [(apart if k % 2 else both, SEES - k) for k in range(views)]


@pytest.mark.parametrize("views", [8, 10, 24, 60])
def test_half_of_few_views_says_the_same_as_half_of_many(views):
    found = tree([tally(of, {1, 2}, points) for of, points in half_agree(views)], 2, prior=1.0)
    assert 0.45 < unions(found)[frozenset({1, 2})].expected < 0.5  # a union at the default granularity


def test_one_of_two_views_does_not_decide():
    found = tree([tally(of, {1, 2}, points) for of, points in half_agree(2)], 2, prior=1.0)
    assert unions(found) == {frozenset({1, 2}): 1.2 / 3}


def test_views_that_are_presumed_may_all_speak_against():
    views = [tally(of, {1, 2}, points) for of, points in half_agree(8)]
    assert unions(tree(views, 2, prior=1.0, prior_agreement=0.0)) == {frozenset({1, 2}): 4 / 9}


def test_without_views_or_labels_there_is_no_union():
    assert unions(tree([], 3)) == {}
    assert len(tree([tally([], set())], 0).node) == 0


subsets = st.sets(st.integers(1, 5), min_size=1)
masks = st.lists(st.tuples(subsets, st.sampled_from([0.7, 0.8, 0.9])), max_size=5)


@given(st.lists(st.tuples(masks, subsets), min_size=1, max_size=5), st.randoms())
@settings(deadline=None, max_examples=60)
def test_neither_the_order_of_views_nor_that_of_masks_matters(views, random):
    def of(views):
        made = [tally([(m & sees, q) for m, q in of if m & sees], sees) for of, sees in views]
        return tree(made, 5)

    before = of(views)
    mixed = [(random.sample(of, len(of)), sees) for of, sees in random.sample(views, len(views))]
    after = of(mixed)
    assert before.node.tolist() == after.node.tolist() and before.parent.tolist() == after.parent.tolist()
    assert np.allclose(before.agreement, after.agreement)


@given(st.lists(st.tuples(masks, subsets), min_size=1, max_size=4))
@settings(deadline=None, max_examples=30)
def test_a_second_copy_of_all_views_changes_nothing(views):
    once = [tally([(m & sees, q) for m, q in of if m & sees], sees) for of, sees in views]
    before, after = tree(once, 5), tree([*once, *once], 5)
    assert before.parent.tolist() == after.parent.tolist() and np.array_equal(before.agreement, after.agreement)


def agreement_beside(neighbour: float, alone: float = 0.3) -> float:
    """How sure the union of two halves of a seat is that one view of two shows, with something else (3) at a distance
    from the first."""
    half = np.stack(np.meshgrid(np.arange(0, 1, 0.02), np.arange(0, 0.5, 0.02)), axis=-1).reshape(-1, 2)
    half = np.concatenate([half, np.zeros((len(half), 1))], axis=1)
    places = np.concatenate([half, half + np.array([0, 0.5, 0]), half - np.array([0, 0.5 + neighbour, 0])]).astype(
        np.float32
    )
    label = np.repeat(np.arange(1, 4, dtype=np.int32), len(half))
    cloud = even_cloud(places, np.zeros((len(places), 3), np.uint8), 1.0, 0.02)
    views = [tally([({1, 2}, 0.9)], {1, 2, 3}), tally([({1}, 0.9), ({2}, 0.9)], {1, 2, 3})]
    stuff = StuffParams(extent=1.0)  # nothing is
    params = HierarchyParams(prior=0.0, alone=alone, contact=0.0, stuff=stuff)
    found = hierarchy(cloud, one_camera(np.eye(4)), [], labels_of(label), views, params=params)
    return dict(zip(found.node.tolist(), found.agreement.tolist(), strict=True))[4]


def test_what_touches_nothing_else_is_one_thing_rather():
    assert agreement_beside(1.0, alone=0.0) == pytest.approx(0.5)
    assert 0.6 < agreement_beside(1.0) < 0.65
    assert agreement_beside(0.0) == pytest.approx(0.5)


def known(monkeypatch, *, stuff=(), touching=(), convex=(), inlaid=(), on_top=(), size=40) -> None:
    """What their places tell of three labels: which are stuff, which touch at 50 points of each, meet in a convex edge
    or lie in the other, and whether 3, which has `size` points beside 100 and 100, stands on the other two, which
    surround it."""

    def pairs(of, value):
        table = np.zeros((3, 3), np.float32)
        for a, b in of:
            table[a - 1, b - 1] = table[b - 1, a - 1] = value
        return table

    share = np.array([[0, 0, 0], [0, 0, 0], [0.5, 0.5, 0]])
    mounds = Mounds(share, np.array([100, 100, size], np.int32), np.isin([1, 2, 3], on_top), 0.8)
    told = {
        "find_stuff": np.isin([1, 2, 3], stuff),
        "find_contact": Contact(pairs(touching, 50), np.array([100, 100, size], np.float32)),
        "convex_edges": pairs(convex, 1) > 0,
        "find_inlays": Inlays(np.full(3, 100.0), np.full(3, 20.0), *(n * pairs(inlaid, 1.0) for n in (20, 50, 50))),
        "find_mounds": mounds,
    }
    for name, value in told.items():
        monkeypatch.setattr(module, name, lambda *_, value=value, **__: value)


def test_a_thing_and_stuff_are_never_united_and_a_union_of_stuff_is_stuff(monkeypatch):
    known(monkeypatch, stuff=[1, 2])
    found = tree([tally([({1, 2}, 0.9), ({1, 2, 3}, 0.9)], {1, 2, 3})], 3)
    assert unions(found) == {frozenset({1, 2}): 1.0}
    assert found.stuff.tolist() == [True, True, False, True]


def test_a_mask_that_holds_a_thing_besides_shows_pieces_of_stuff_as_one_but_no_things(monkeypatch):
    # two thirds of the mask are the stuff's: five ninths of the way from an IoU of .5 to .8
    view = tally([({1, 2, 3}, 0.9)], {1, 2, 3})
    known(monkeypatch, stuff=[1, 2])
    assert unions(tree([view], 3)) == {frozenset({1, 2}): 5 / 9}
    known(monkeypatch, stuff=[3])
    assert not unions(tree([view], 3))


@pytest.mark.parametrize(("stuff", "agreement"), [([3], 0.6), ([], 0.5), ([1, 2, 3], 0.5)])
def test_things_that_touch_a_floor_besides_stand_alone_and_walls_do_not(monkeypatch, stuff, agreement):
    # 50 of 60 points, 10 of them presumed, are of the pair: two thirds of the way from a half to all of them.
    known(monkeypatch, stuff=stuff, touching=[(1, 2), (1, 3)])
    views = [tally([({1, 2}, 0.9)], {1, 2, 3}), tally([({1}, 0.9), ({2}, 0.9)], {1, 2, 3})]
    assert unions(tree(views, 3)) == {frozenset({1, 2}): agreement}


def test_where_pieces_of_a_union_touch_each_other_tells_nothing_about_what_it_is_united_with(monkeypatch):
    known(monkeypatch, touching=[(1, 2)])
    views = [tally([({1, 2}, 0.9), ({1, 2, 3}, 0.9)], {1, 2, 3}), tally([({1, 2}, 0.9)], {1, 2, 3})]
    assert unions(tree(views, 3)) == {frozenset({1, 2}): 1.0, frozenset({1, 2, 3}): 0.5}


@pytest.mark.parametrize(("touching", "own"), [([(1, 2)], 100 / 120), ([(1, 2), (1, 3), (2, 3)], 100 / 220), ([], 0)])
def test_an_agreement_rises_with_the_share_of_what_the_pieces_touch_that_is_their_own(monkeypatch, touching, own):
    known(monkeypatch, touching=touching)
    views = [tally([({1, 2}, 0.9)], {1, 2, 3}), tally([({1}, 0.9), ({2}, 0.9)], {1, 2, 3})]
    factor = 0.8 + 0.4 * own
    assert unions(tree(views, 3, alone=0.0, contact=0.2)) == {frozenset({1, 2}): 0.5 * factor}
    assert unions(tree(views[:1], 3, alone=0.0, contact=0.2)) == {frozenset({1, 2}): min(factor, 1)}


@pytest.mark.parametrize(
    ("touching", "size", "agreement"),
    [([(1, 3), (3, 2)], 40, 1.0), ([(1, 2)], 40, 0.7), ([(1, 2)], 10, 1.0), ([(1, 3)], 10, 0.7), ([], 40, 0.7)],
)
def test_pieces_that_do_not_touch_are_a_group_but_for_a_crumb(monkeypatch, touching, size, agreement):
    known(monkeypatch, touching=touching, size=size)
    view = tally([({1, 2, 3}, 0.9)], {1, 2, 3})
    assert unions(tree([view], 3, apart=0.3)) == {frozenset({1, 2, 3}): agreement}


@pytest.mark.parametrize("how", ["convex", "inlaid"])
@pytest.mark.parametrize(("stuff", "are_one"), [([], True), ([1], False), ([2], False), ([1, 2], False)])
def test_faces_and_what_lies_in_another_are_one_but_walls_are_not(monkeypatch, how, stuff, are_one):
    known(monkeypatch, stuff=stuff, **{how: [(1, 2)]})
    view = tally([({1, 2, 3}, 0.5), ({1}, 0.9), ({2}, 0.9), ({3}, 0.9)], {1, 2, 3})
    assert unions(tree([view], 3)) == ({frozenset({1, 2}): 0.42} if are_one else {})
    other = {"convex": "inlaid", "inlaid": "convex"}[how]
    assert unions(tree([view], 3, **{how: 0.4, other: 0.3})) == ({frozenset({1, 2}): 0.4} if are_one else {})


@pytest.mark.parametrize("how", ["convex", "inlaid"])
def test_that_they_are_one_half_of_the_views_must_show_in_some_mask(monkeypatch, how):
    known(monkeypatch, **{how: [(1, 2)]})
    apart = [tally([({1}, 0.9), ({2}, 0.9)], {1, 2}, points) for points in (90, 95)]
    together = [
        tally([({1, 2, 3}, 0.5), ({1}, 0.9), ({2}, 0.9), ({3}, 0.9)], {1, 2, 3}, points) for points in (100, 80)
    ]
    assert unions(tree([*apart, *together], 3)) == {frozenset({1, 2}): 0.42}
    assert unions(tree([*apart, together[0]], 3)) == {}


def test_a_picture_lies_in_its_mount_when_that_is_one(monkeypatch):
    known(monkeypatch)
    around = np.zeros((3, 3))
    around[2, :2] = 10  # half of what is around 3 is 1, and half 2
    inlays = Inlays(np.full(3, 100.0), np.array([0, 0, 20.0]), around, around, around)
    monkeypatch.setattr(module, "find_inlays", lambda *_: inlays)
    view = tally([({1, 2}, 0.9), ({1, 2, 3}, 0.5), ({1}, 0.9), ({2}, 0.9), ({3}, 0.9)], {1, 2, 3})
    assert unions(tree([view], 3)) == {frozenset({1, 2}): 1.0, frozenset({1, 2, 3}): 0.42}


def test_a_mask_of_a_seat_and_the_bag_on_it_shows_the_seat_and_a_group(monkeypatch):
    view = tally([({1, 2, 3}, 0.9)], {1, 2, 3})
    known(monkeypatch, on_top=[3])
    # The mask's IoU with the seat alone is 2/3 only, but what it holds besides stands on the seat.
    assert unions(tree([view], 3)) == {frozenset({1, 2}): 1.0, frozenset({1, 2, 3}): 0.41}
    known(monkeypatch)
    assert unions(tree([view], 3)) == {frozenset({1, 2, 3}): 1.0}


def test_a_stool_and_the_teapot_on_it_are_two_instances_though_every_view_has_both_in_one_mask(monkeypatch):
    known(monkeypatch, on_top=[3], touching=[(1, 2), (2, 3)])
    views = [tally([({1, 2, 3}, 0.9)], {1, 2, 3}, points) for points in range(81, 101)]
    found = tree(views, 3, **vars(HierarchyParams()))
    assert unions(found)[frozenset({1, 2, 3})].expected > 0.4  # nothing else speaks against it
    stool, other, pot = instances_of(found, 3, Params().split.granularity)[1:].tolist()
    assert stool == other != pot


def seat_of(pieces: Pieces, members: tuple[int, ...]) -> tuple[int, ...]:
    """Those of some pieces that are of a seat, 1 and 2, on which the others stand."""
    return tuple(piece for piece in members if set(pieces.labels[piece]) <= {0, 1}) or members


@pytest.mark.parametrize("touch", [True, False])
def test_masks_of_a_seat_and_the_bag_on_it_show_each_as_one_where_its_pieces_touch(touch, monkeypatch):
    both = ({1, 2, 3, 4}, 0.9)
    views = [tally([both], both[0]), tally([both, ({1, 2}, 0.9), ({3, 4}, 0.9)], both[0])]
    assert unions(tree(views, 4)) == {frozenset({1, 2, 3, 4}): 1.0}

    monkeypatch.setattr(Pieces, "_below", seat_of)
    monkeypatch.setattr(Contact, "parted", lambda _, members: [members] if touch else [(one,) for one in members])
    each = {frozenset({1, 2}): 1.0, frozenset({3, 4}): 1.0 if touch else 0.5}  # two bags may stand on it
    assert unions(tree(views, 4)) == {**each, frozenset({1, 2, 3, 4}): 0.41}


@pytest.mark.parametrize(("views", "agree"), [(5, True), (6, False)])
def test_what_is_below_a_group_is_one_only_where_the_views_would_make_it_a_group_at_least(views, agree, monkeypatch):
    monkeypatch.setattr(Pieces, "_below", seat_of)
    both = ({1, 2, 3, 4}, 0.9)
    silent = [tally([both], both[0], SEES - n) for n in range(1, views)]
    found = tree([tally([both, ({1, 2}, 0.9)], both[0]), *silent], 4)  # one view of so many has a mask of the seat
    assert unions(found) == {frozenset({1, 2, 3, 4}): 0.41} | ({frozenset({1, 2}): 1.0} if agree else {})


def test_a_union_stands_on_something_only_where_all_its_pieces_do(monkeypatch):
    known(monkeypatch, on_top=[3])
    views = [tally([({2, 3}, 0.9), ({1, 2, 3}, 0.9)], {1, 2, 3}), tally([({2, 3}, 0.9)], {1, 2, 3})]
    assert unions(tree(views, 3)) == {frozenset({2, 3}): 1.0, frozenset({1, 2, 3}): 0.5}
