from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import DepthMap, Frame
from ss_flow.tasks.capture.planes import PlaneParams, fitted_planes, on_plane, planes
from ss_flow.tasks.geometry.images import encode_png, encode_valid

HEIGHT, WIDTH = 60, 80
X, Y = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH, (np.arange(HEIGHT) + 0.5) / HEIGHT)
LEFT = X < 0.5
INNER = np.abs(X - 0.5) > 0.05
"""Apart from the pixels between two colours, which may be a region of their own."""
FLOOR = 1 / (0.3 + 0.1 * X + 0.3 * Y)
WALL = 1 / (0.25 - 0.1 * X)


def photo(*colours_where):
    """A frame of these colours; where masks overlap, the last counts."""
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    for colour, where in colours_where:
        image[where] = colour
    return Frame("view", WIDTH, HEIGHT, encode_png(image), np.zeros(0, np.uint8), WIDTH, HEIGHT)


def known(depth, where):
    return DepthMap("view", np.where(where, depth, 0).astype(np.float32), "mvs")


def test_a_plane_goes_on_through_its_region_and_no_farther():
    frame = photo(((200, 40, 40), LEFT), ((40, 40, 200), ~LEFT))
    given = known(FLOOR, LEFT & (Y < 0.6))
    found = planes(frame, given)
    np.testing.assert_allclose(found.depth[LEFT & INNER], FLOOR[LEFT & INNER], rtol=1e-4)
    assert not found.depth[~LEFT].any()
    assert (found.name, found.source, found.depth.dtype) == ("view", "mvs", np.float32)


def test_each_region_has_its_own_plane():
    frame = photo(((200, 40, 40), LEFT), ((40, 40, 200), ~LEFT))
    found = planes(frame, known(np.where(LEFT, FLOOR, WALL), (Y < 0.5) & INNER))
    np.testing.assert_allclose(found.depth[INNER], np.where(LEFT, FLOOR, WALL)[INNER], rtol=1e-4)


def test_what_is_not_flat_does_not_go_on():
    ball = 2 - np.sqrt(1.2 - (X - 0.5) ** 2 - (Y - 0.5) ** 2)
    given = known(ball, Y < 0.5)
    assert (planes(photo(), given, params=PlaneParams(tolerance=0.01)).depth == given.depth).all()
    assert (planes(photo(), given, params=PlaneParams(tolerance=0.2, certain=1)).depth[Y >= 0.5] > 0).all()


def test_a_plane_goes_on_as_far_as_it_is_certain():
    rng = np.random.default_rng(0)
    given = known(FLOOR * (1 + 0.005 * rng.standard_normal(FLOOR.shape)), (X < 0.25) & (Y < 0.25))
    reached = [planes(photo(), given, params=PlaneParams(certain=c)).depth > 0 for c in (0.002, 0.01, 0.05)]
    counts = [int(r.sum()) for r in reached]
    assert counts[0] < counts[1] < counts[2]
    # It is least certain where it is farthest from what is known.
    assert not reached[1][-1, -1] and reached[1][HEIGHT // 4, WIDTH // 4]


def test_a_plane_ends_before_it_comes_much_nearer_or_farther_than_anything_known():
    steep = 1 / (0.05 + 1.0 * X)
    found = planes(photo(), known(steep, (X > 0.4) & (X < 0.6))).depth
    there = found[found > 0]
    assert there.min() > 0.69 * steep[(X > 0.4) & (X < 0.6)].min()
    assert there.max() < 1.26 * steep[(X > 0.4) & (X < 0.6)].max()
    assert (found[:, 0] == 0).all() and (found[:, -1] == 0).all()


def test_a_rim_that_matching_made_too_near_gives_way():
    thing = (np.abs(X - 0.5) < 0.15) & (np.abs(Y - 0.5) < 0.2)
    rim = (np.abs(X - 0.5) < 0.19) & (np.abs(Y - 0.5) < 0.25) & ~thing
    frame = photo(((20, 120, 20), thing))
    given = known(np.where(thing | rim, 1.0, WALL), np.ones_like(thing))
    found = planes(frame, given).depth
    np.testing.assert_allclose(found, np.where(thing, 1.0, WALL), rtol=1e-4)
    far_from_outlines = planes(frame, given, params=PlaneParams(rim=1)).depth
    assert (far_from_outlines[rim] == 1).any()


def test_pixels_that_do_not_count_stay_unknown():
    frame = replace(photo(), valid=encode_valid(Y < 0.8))
    found = planes(frame, known(FLOOR, Y < 0.5)).depth
    assert (found[Y < 0.8] > 0).all() and not found[Y > 0.8].any()


def test_the_photo_is_looked_at_at_the_size_of_the_depth():
    coarse = DepthMap("view", np.where(Y < 0.5, FLOOR, 0)[::2, ::2].astype(np.float32), "mvs")
    found = planes(photo(), coarse).depth
    np.testing.assert_allclose(found, FLOOR[::2, ::2], rtol=1e-4)


def test_nothing_comes_of_nothing():
    unknown = known(FLOOR, np.zeros_like(LEFT))
    assert not planes(photo(), unknown).depth.any()
    few = known(FLOOR, (X < 0.05) & (Y < 0.1))
    assert (planes(photo(), few).depth == few.depth).all()
    line = known(FLOOR, Y < 1 / HEIGHT)
    assert np.isfinite(planes(photo(), line).depth).all()


def test_the_plane_of_most_pixels_is_found_among_others():
    rng = np.random.default_rng(1)
    places = np.column_stack([rng.random((500, 2)), np.ones(500)])
    off = np.arange(500) % 5 < 2
    inverse = places @ [0.3, -0.1, 0.5] + np.where(off, rng.uniform(0.05, 0.5, 500), 0)
    assert (on_plane(places, inverse, 0.01) == ~off).all()


def test_the_error_of_a_plane_is_that_of_repeated_measurements():
    rng = np.random.default_rng(2)
    regions, at_corner = np.zeros((HEIGHT, WIDTH), np.int32), np.array([X[-1, -1], Y[-1, -1], 1])
    params, tries = PlaneParams(tolerance=0.5), []
    for _ in range(200):
        # Blocks of fifty pixels that err alike are what the covariance takes for one measurement.
        blocks = np.kron(rng.standard_normal((HEIGHT // 5, WIDTH // 10)), np.ones((5, 10)))
        planes_, covariances = fitted_planes(regions, 0.5 * (1 + 0.02 * blocks), params)
        tries.append((planes_[0] @ at_corner, at_corner @ covariances[0] @ at_corner))
    spread, told = np.std([t for t, _ in tries]), np.sqrt(np.mean([v for _, v in tries]))
    assert 0.8 * spread < told < 1.25 * spread
