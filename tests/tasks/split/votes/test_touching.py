from dataclasses import replace

import numpy as np
import pytest
from clouds import even_cloud
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ss_flow.tasks.split.votes.touching import TouchingParams, merge_touching

BEIGE, BLUE = (200, 180, 150), (40, 60, 160)
X, Y, Z = np.eye(3)


def patch(corner, right, up, size, color, seed=0):
    """A square of `size` points a side, 1 apart, roughly; from `corner` along two directions."""
    random = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    places = np.asarray(corner) + u.reshape(-1, 1) * right + v.reshape(-1, 1) * up
    places = places + random.uniform(-0.1, 0.1, places.shape)
    return places, np.clip(np.array(color) + random.integers(-6, 7, places.shape), 0, 255)


def scene(*patches, labels=None):
    """The cloud of some patches, and labels 1, 2, ... of their points."""
    places, colors = (np.concatenate(part) for part in zip(*patches, strict=True))
    cloud = even_cloud(places.astype(np.float32), colors.astype(np.uint8), 1.0, 1.0)
    names = np.arange(1, len(patches) + 1) if labels is None else np.array(labels)
    return cloud, np.repeat(names, [len(p) for p, _ in patches]).astype(np.int32)


def merged(cloud, labels, **values):
    """The labels that are left, in the order of the points."""
    return merge_touching(labels, cloud, TouchingParams(**values))


def left(cloud, labels, **values):
    return sorted(set(merged(cloud, labels, **values).tolist()))


def two_halves(color=BEIGE):
    return patch((0, 0, 0), X, Y, 20, BEIGE), patch((20, 0, 0), X, Y, 20, color, seed=1)


def box_on_plane(color=BEIGE):
    """The top and two sides of a box, label 2, on a plane, label 1."""
    (ground, shade), *sides = (
        patch((-20, -20, 0), X, Y, 60, BEIGE),
        patch((0, 0, 1), X, Z, 12, color),
        patch((0, 0, 1), Y, Z, 12, color),
        patch((0, 0, 12), X, Y, 12, color),
    )
    free = ~((ground > -0.5) & (ground < 11.5))[:, :2].all(axis=1)
    box = tuple(np.concatenate(part) for part in zip(*sides, strict=True))
    return scene((ground[free], shade[free]), box)


def test_two_halves_of_a_plane_of_one_colour_become_one():
    cloud, labels = scene(*two_halves(), labels=(5, 3))
    assert merged(cloud, labels).tolist() == [3] * len(labels)


def test_two_halves_of_a_plane_of_two_colours_do_not():
    cloud, labels = scene(*two_halves(BLUE))
    assert merged(cloud, labels).tolist() == labels.tolist()
    assert left(cloud, labels, similarity=0) == [1]


def test_a_box_on_a_plane_does_not_become_one_with_it():
    assert left(*box_on_plane()) == [1, 2]
    assert left(*box_on_plane(), angle=90.0) == [1]


def test_two_faces_that_meet_in_an_edge_stay_apart():
    assert left(*scene(patch((0, 0, 0), X, Y, 20, BEIGE), patch((20, 0, 0.5), Z, Y, 20, BEIGE))) == [1, 2]


def test_a_step_is_an_edge():
    side, shade = patch((19.5, 0, 0.7), Y, Z, 20, BEIGE)
    low = side[:, 2] < 1.5
    patches = patch((0, 0, 0), X, Y, 20, BEIGE), (side[low], shade[low]), patch((20, 0, 2), X, Y, 20, BEIGE)
    stairs = scene(*patches, labels=(1, 0, 2))
    assert left(*stairs) == [0, 1, 2]
    assert left(*stairs, angle=45.0) == [0, 1]


def test_labels_of_too_few_points_for_a_normal_stay_apart():
    row = even_cloud(np.arange(6)[:, None] * X.astype(np.float32), np.full((6, 3), 99, np.uint8), 1.0, 1.0)
    assert left(row, np.array([1, 1, 1, 2, 2, 2], np.int32)) == [1, 2]


def test_a_bend_is_no_edge():
    bent = patch((20, 0, 0.2), np.cos(0.25) * X + np.sin(0.25) * Z, Y, 20, BEIGE)
    assert left(*scene(patch((0, 0, 0), X, Y, 20, BEIGE), bent)) == [1]


@pytest.mark.parametrize(("shift", "share"), [(0, [1]), (18, [1, 2])])
def test_labels_touch_along_enough_of_the_border(shift, share):
    # Unlabelled ground all around makes the border go all around, too.
    (ground, shade) = patch((-10, -10, 0), X, Y, 70, BEIGE)
    labels = np.zeros(len(ground), np.int32)
    x, y = np.rint(ground[:, 0]), np.rint(ground[:, 1])
    labels[(x >= 0) & (x < 20) & (y >= 0) & (y < 20)] = 1
    labels[(x >= 20) & (x < 40) & (y >= shift) & (y < shift + 20)] = 2
    cloud = even_cloud(ground.astype(np.float32), shade.astype(np.uint8), 1.0, 1.0)
    assert left(cloud, labels) == [0, *share]


def test_a_gap_between_labels_is_bridged_within_reach():
    gap = scene(patch((0, 0, 0), X, Y, 20, BEIGE), patch((20, 0, 0), X, Y, 20, BEIGE))
    labels = np.where(np.abs(gap[0].points[:, 0] - 19.5) < 1, 0, gap[1])
    assert left(gap[0], labels) == [0, 1]
    assert left(gap[0], labels, reach=2.0) == [0, 1, 2]


def test_unions_go_on_until_nothing_is_left_to_unite():
    row = [patch((12 * k, 0, 0), X, Y, 12, BEIGE, seed=k) for k in range(5)]
    assert left(*scene(*row, labels=(4, 2, 9, 7, 3))) == [2]


def test_labels_that_touch_along_the_larger_share_of_a_border_are_united_first():
    # A row of three greys on unlabelled ground; the last one is shifted, so that it touches half as much of the second.
    # Each is like the next, but not like two that became one.
    ground, _ = patch((-10, -10, 0), X, Y, 80, BEIGE)
    x, y = np.rint(ground[:, :2].T)
    labels = np.zeros(len(ground), np.int32)
    for number, shift in ((1, 0), (2, 0), (3, 10)):
        labels[(x >= 20 * (number - 1)) & (x < 20 * number) & (y >= shift) & (y < shift + 20)] = number
    grey = np.repeat(np.uint8([0, 104, 120, 136])[labels][:, None], 3, axis=1)
    cloud = even_cloud(ground.astype(np.float32), grey, 1.0, 1.0)
    assert left(cloud, labels, similarity=0.85, contact=0.1) == [0, 1, 3]


def test_the_colours_of_a_union_are_those_of_all_its_pieces():
    def grey(start, width, level):
        places, color = patch((start, 0, 0), X, Y, 20, (level,) * 3, seed=start)
        kept = places[:, 0] < start + width - 0.5
        return places[kept], color[kept]

    assert left(*scene(grey(0, 6, 124), grey(6, 20, 144)), similarity=0.9) == [1, 2]
    assert left(*scene(grey(0, 6, 124), grey(6, 20, 134), grey(26, 20, 144)), similarity=0.9) == [1]


def test_unlabelled_points_stay_so():
    cloud, labels = scene(*two_halves(), labels=(0, 3))
    assert merged(cloud, labels).tolist() == labels.tolist()
    assert not merged(cloud, np.zeros_like(labels)).any()
    nothing = even_cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 1.0, 0.0)
    assert merged(nothing, np.zeros(0, np.int32)).tolist() == []


def pieces(seed):
    """A plane cut into pieces of three colours at random, some of it unlabelled; and a second one upright on it."""
    random = np.random.default_rng(seed)
    patches = [patch((0, 0, 0), X, Y, 40, BEIGE, seed), patch((0, 40, 0.5), X, Z, 40, BEIGE, seed + 1)]
    cloud, plane = scene(*patches)
    centres = cloud.points[random.choice(len(plane), 16, replace=False)]
    nearest = np.linalg.norm(cloud.points[:, None] - centres, axis=2).argmin(axis=1)
    labels = (1 + nearest).astype(np.int32)
    labels[random.random(len(labels)) < 0.05] = 0
    tint = np.array([BEIGE, BLUE, (180, 60, 60)])[random.integers(0, 3, 16)][nearest]
    return replace(cloud, colors=np.clip(tint + random.integers(-6, 7, tint.shape), 0, 255).astype(np.uint8)), labels


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 1000), power=st.integers(-6, 6))
def test_scaling_the_world_changes_nothing(seed, power):
    cloud, labels = pieces(seed)
    scale = 2.0**power
    scaled = replace(cloud, points=cloud.points * np.float32(scale), unit=scale, spacing=cloud.spacing * scale)
    assert merged(cloud, labels).tobytes() == merged(scaled, labels).tobytes()


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 1000))
@example(seed=124)  # here two pairs touch along the same share of a border
def test_other_numbers_for_the_labels_give_the_same_unions(seed):
    cloud, labels = pieces(seed)
    other = np.append(0, 1 + np.random.default_rng(seed).permutation(16)).astype(np.int32)
    a, b = merged(cloud, labels), merged(cloud, other[labels])
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    assert len(pairs) == len(set(a.tolist())) == len(set(b.tolist()))
    assert len(set(a.tolist())) < 17
