"""Exposure and white balance of photos are found from surfaces that several of them show."""

from dataclasses import replace

import numpy as np
import pytest

from ss_flow.flows.generated import RoomParams, generate
from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame, SceneUnit
from ss_flow.tasks.capture.colours import ColourParams, Observations, colours, gain, photo_maps
from ss_flow.tasks.geometry.images import decode_rgb, encode_png, transformed

IDENTITY = np.eye(4)[:3]


def observed(maps: np.ndarray, seed: int, wrong: float = 0.0) -> Observations:
    """Points seen in a third of the photos each, with a little noise; a share of them shows something else."""
    rng = np.random.default_rng(seed)
    scene = rng.uniform(0.1, 0.9, (2000, 3))
    view, point = np.nonzero(rng.random((len(maps), len(scene))) < 0.35)
    color = np.einsum("mab,mb->ma", maps[view, :, :3], scene[point]) + maps[view, :, 3]
    color += rng.normal(0, 0.01, color.shape)
    off = rng.random(len(view)) < wrong
    color[off] = rng.random((int(off.sum()), 3))
    return Observations(view.astype(np.int32), point.astype(np.int32), np.clip(color, 0.02, None))


def between(maps: np.ndarray) -> np.ndarray:
    """[K, 3, 4] from the first photo's colours to those of the others: what does not depend on the scene's."""
    square = np.concatenate([maps, np.tile([[[0, 0, 0, 1.0]]], (len(maps), 1, 1))], axis=1)
    return (square @ np.linalg.inv(square[0]))[:, :3]


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_affine_maps_between_photos_are_found_among_wrong_observations(wrong):
    rng = np.random.default_rng(1)
    maps = np.tile(IDENTITY, (12, 1, 1))
    maps[:, :, :3] *= rng.uniform(0.6, 1.3, (12, 1, 1)) * rng.uniform(0.9, 1.1, (12, 3, 1))
    maps[:, :, :3] += rng.uniform(-0.04, 0.04, (12, 3, 3))
    maps[:, :, 3] = rng.uniform(-0.03, 0.03, (12, 3))
    found = photo_maps(observed(maps, 2, wrong), 12, 1e-2)
    some = np.random.default_rng(3).uniform(0.2, 0.8, (500, 3))

    def worst(of: np.ndarray) -> float:
        wanted, given = (np.einsum("kab,nb->kna", m[:, :, :3], some) + m[:, None, :, 3] for m in (between(maps), of))
        return float(np.abs(wanted - given).mean(axis=(1, 2)).max())

    assert worst(between(found)) < 0.02
    assert worst(np.tile(IDENTITY, (12, 1, 1))) > 0.2


def test_photos_that_agree_stay_as_they_are():
    found = photo_maps(observed(np.tile(IDENTITY, (8, 1, 1)), 4), 8, 1e-2)
    np.testing.assert_allclose(found, np.tile(IDENTITY, (8, 1, 1)), atol=0.01)


def test_only_what_holds_for_other_points_too_is_gained():
    maps = np.tile(IDENTITY, (12, 1, 1))
    assert gain(observed(maps, 7, wrong=0.2), 12, 1e-2) < 0.05
    maps[:, :, :3] *= np.linspace(0.6, 1.2, 12)[:, None, None]
    assert gain(observed(maps, 7), 12, 1e-2) > 0.5


def test_photos_of_one_exposure_stay_as_they_are_to_the_bit():
    for transform in colours(*captured(np.ones((6, 3))), SceneUnit(1.0), params=ColourParams()):
        assert transform.reference == ""
        np.testing.assert_array_equal(transform.matrix, IDENTITY)


def test_a_photo_that_shares_no_point_stays_as_it_is():
    maps = np.tile(IDENTITY, (6, 1, 1))
    maps[:, :, :3] *= np.array([0.8, 0.9, 1.0, 1.1, 1.2, 1.0])[:, None, None]
    seen = observed(maps, 5)
    keep = seen.view != 5
    found = photo_maps(Observations(seen.view[keep], seen.point[keep], seen.color[keep]), 6, 1e-2)
    np.testing.assert_allclose(found[5], IDENTITY, atol=0.01)
    assert found[0, 0, 0] < 0.9 < 1.1 < found[4, 0, 0]


def captured(gains: np.ndarray) -> tuple[tuple[Frame, ...], Cameras, tuple[DepthMap, ...]]:
    """A generated room, each photo brighter by its gains [K, 3]."""
    made = generate(RoomParams(objects=4, views=len(gains), width=160, height=120, seed=0, held_out=0))
    frames, depths = [], []
    for name, rgb, factor, depth in zip(made.cameras.names, made.rgb, gains, made.depth, strict=True):
        photo = np.round(np.clip(rgb * factor, 0, 255)).astype(np.uint8)
        frames.append(Frame(name, 160, 120, encode_png(photo), np.zeros(0, np.uint8), 160, 120))
        depths.append(DepthMap(name, depth, "sensor"))
    return tuple(frames), made.cameras, tuple(depths)


def test_photos_of_a_room_in_changing_light_come_to_the_colours_of_the_reference():
    gains = np.random.default_rng(6).uniform(0.55, 1.0, (8, 1)) * np.array([1.0, 0.97, 0.94])
    frames, cameras, depths = captured(gains)
    even, _, _ = captured(np.ones((8, 3)))
    with pytest.warns(UserWarning, match="change from photo to photo: points and Gaussians") as told:
        found = colours(frames, cameras, depths, SceneUnit(1.0), params=ColourParams())
    assert [t.name for t in found] == list(cameras.names)
    (reference,) = {t.reference for t in found}
    assert f"photo {reference}," in str(told[0].message)
    own = cameras.names.index(reference)
    np.testing.assert_allclose(found[own].matrix, IDENTITY, atol=1e-12)
    for view, transform in enumerate(found):
        photo, wanted = decode_rgb(frames[view]) / 255.0, decode_rgb(even[view]) / 255.0 * gains[own]
        shown = transformed(photo.astype(np.float32), transform)
        before, after = np.abs(photo - wanted).mean(), np.abs(shown - wanted).mean()
        assert after < 0.02 and (after < 0.5 * before or before < 0.02), (view, before, after)


def test_pixels_that_do_not_count_and_unknown_depth_say_nothing():
    frames, cameras, depths = captured(np.linspace(0.6, 1.0, 6)[:, None] * np.ones(3))
    unknown = tuple(replace(depth, depth=np.zeros_like(depth.depth)) for depth in depths)
    masked = tuple(replace(frame, valid=encode_png(np.zeros((120, 160), np.uint8))) for frame in frames)
    for case in ((frames, cameras, unknown), (masked, cameras, depths)):
        for transform in colours(*case, SceneUnit(1.0), params=ColourParams()):
            np.testing.assert_array_equal(transform.matrix, IDENTITY)


def test_the_same_photos_give_the_same_bytes():
    made = captured(np.linspace(0.6, 1.0, 5)[:, None] * np.ones(3))
    with pytest.warns(UserWarning, match="change from photo to photo"):
        first, second = (colours(*made, SceneUnit(1.0), params=ColourParams()) for _ in range(2))
    assert [t.matrix.tobytes() for t in first] == [t.matrix.tobytes() for t in second]
