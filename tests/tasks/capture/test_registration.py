"""Depth that does not lie where its photos show it is found out, and moved there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.flows.generated import RoomParams, generate
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame, Registration
from ss_flow.tasks.capture import ingest, sensor_depth
from ss_flow.tasks.capture.registration import (
    _REACH,
    _SCALES,
    RegistrationParams,
    _blurred,
    _coarse_fits,
    _View,
    calibrated,
    registration,
)
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.geometry.images import encode_png

CAPTURES = Path(__file__).parents[3] / ".." / "shared" / "data"
NONE = np.zeros(0, np.uint8)


@pytest.fixture(scope="module", params=[0, 1], ids=["room 0", "room 1"])
def room(request):
    """Frames, cameras and exact depth."""
    made = generate(RoomParams(objects=4, views=6, width=240, height=180, seed=request.param, held_out=0))
    frames = tuple(
        Frame(name, 240, 180, encode_png(rgb), NONE, 240, 180)
        for name, rgb in zip(made.cameras.names, made.rgb, strict=True)
    )
    maps = (DepthMap(name, d, "sensor") for name, d in zip(made.cameras.names, made.depth, strict=True))
    return frames, made.cameras, tuple(maps)


def displaced(depths, scale, shift):
    """[K] maps in which all that lies at frame point x is shown where it would have to be moved away from."""
    moved = []
    for depth in depths:
        h, w = depth.depth.shape
        v, u = np.mgrid[:h, :w] + 0.5
        rows = np.floor((v - h / 2) * scale + h / 2 + shift[1]).astype(int)
        columns = np.floor((u - w / 2) * scale + w / 2 + shift[0]).astype(int)
        seen = (rows >= 0) & (rows < h) & (columns >= 0) & (columns < w)
        values = depth.depth[np.clip(rows, 0, h - 1), np.clip(columns, 0, w - 1)]
        moved.append(replace(depth, depth=np.where(seen, values, 0).astype(np.float32)))
    return tuple(moved)


@pytest.mark.filterwarnings("error")
def test_depth_that_fits_its_photos_is_left_alone_without_a_word(room):
    found = registration(*room)
    assert (found.scale, *found.shift) == (1, 0, 0)
    assert found.gain < 0.1


@pytest.mark.parametrize(("scale", "shift"), [(585 / 526, (0, 0)), (0.9, (2, -3)), (1, (-4, 3)), (1.1, (5, 4))])
def test_another_focal_length_and_a_shift_are_found_and_told(room, scale, shift):
    frames, cameras, depths = room
    with pytest.warns(
        UserWarning, match=r"when the depth images are scaled by .* and shifted .* use --calibrate depth"
    ) as told:
        found = registration(frames, cameras, displaced(depths, scale, shift))
    assert len(told) == 1
    assert found.scale == pytest.approx(scale, abs=0.006)
    np.testing.assert_allclose(found.shift, shift, atol=0.5)
    assert found.gain > 0.4


def test_shifts_are_told_in_pixels_of_the_frames_whatever_the_size_of_the_depth(room):
    frames, cameras, depths = room
    large = tuple(replace(d, depth=d.depth.repeat(2, 0).repeat(2, 1)) for d in displaced(depths, 1, (-4, 3)))
    np.testing.assert_allclose(registration(frames, cameras, large, advise=False).shift, (-4, 3), atol=0.5)


@pytest.mark.filterwarnings("error")
def test_whoever_calibrates_is_not_advised_to(room):
    frames, cameras, depths = room
    assert registration(frames, cameras, displaced(depths, 1.1, (0, 0)), advise=False).scale > 1.09


@pytest.mark.filterwarnings("error")
def test_photos_of_something_else_say_nothing_about_depth(room):
    frames, cameras, depths = room
    found = registration(frames[3:] + frames[:3], cameras, depths)
    assert (found.scale, *found.shift) == (1, 0, 0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("values", [2.0, 0.0], ids=["a wall", "nothing"])
def test_depth_without_edges_says_nothing(room, values):
    frames, cameras, depths = room
    flat = tuple(replace(d, depth=np.full_like(d.depth, values)) for d in depths)
    assert registration(frames, cameras, flat).gain == 0


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("name", "scale"), [("apc_shelf", 1.037), ("hololens_office", 1.0)])
def test_of_two_real_captures_one_has_depth_beside_its_photos(name, scale):
    if not (CAPTURES / name).is_dir():
        pytest.skip(f"{name} is not in shared/data beside the project")
    scene = open_scene(CAPTURES / name)
    scene = scene.every(len(scene.names) // 15)
    photos, depths, valid = (
        tuple(FileRef(p, "") if p else None for p in of) for of in (scene.photos, scene.depths, scene.valid)
    )
    frames = ingest.frames(names=scene.names, photos=photos, valid=valid, lenses=scene.lenses)
    cameras = ingest.cameras(frames, names=scene.names, lenses=scene.lenses, poses=scene.poses, metric=True)
    maps = sensor_depth.depth(
        frames,
        names=scene.names,
        files=depths,
        scale=scene.depth_scale,
        metric=True,
        lenses=scene.lenses,
        depth_lens=scene.depth_lens,
    )
    found = registration(frames, cameras, maps, advise=False)
    assert found.scale == pytest.approx(scale, abs=0.005)
    assert (found.gain >= RegistrationParams().tau_clear) == found.moves == (scale != 1)


def one_view(depth, size=(6, 4), center=(3.0, 2.0)):
    """A frame of a size (width, height), its camera and its depth map."""
    frame = Frame("view", *size, NONE, NONE, *size)
    cameras = Cameras(
        ("view",), np.array([size], np.int32), np.array([[5.0, 5.0, *center]]), np.eye(4)[None], metric=True
    )
    return (frame,), cameras, (DepthMap("view", np.array(depth, np.float32), "sensor"),)


@pytest.mark.filterwarnings("ignore:The depth images")
def test_a_shift_moves_pixels_and_leaves_unknown_what_was_not_seen():
    depth = np.arange(1, 25).reshape(4, 6)
    moved = calibrated(*one_view(depth), Registration(1.0, np.array([2.0, -1.0]), 0.5))[0].depth
    expected = np.zeros((4, 6))
    expected[:3, 2:] = depth[1:, :4]
    np.testing.assert_array_equal(moved, expected)


@pytest.mark.filterwarnings("ignore:The depth images")
def test_a_scale_enlarges_about_the_principal_point_and_keeps_z():
    depth = np.arange(1, 25).reshape(4, 6)
    moved = calibrated(*one_view(depth), Registration(2.0, np.zeros(2), 0.5))[0].depth
    # Columns 1.5 .. 4.5 and rows 1 .. 3 fill the image; a border that falls in the middle of a pixel may go either way.
    np.testing.assert_array_equal(moved[:, 1:5:2], depth[1:3].repeat(2, 0)[:, [2, 3]])


@pytest.mark.filterwarnings("ignore:The depth images")
def test_a_shift_counts_in_pixels_of_the_frame():
    depth = np.arange(1, 25).reshape(4, 6)
    views = one_view(depth, size=(12, 8), center=(6.0, 4.0))
    moved = calibrated(*views, Registration(1.0, np.array([2.0, 0.0]), 0.5))[0].depth
    np.testing.assert_array_equal(moved[:, 1:], depth[:, :-1])


def test_where_nothing_was_found_the_depth_stays_to_the_bit_and_that_is_told(room):
    with pytest.warns(UserWarning, match="The depth images stay as they are"):
        same = calibrated(*room, Registration(1.0, np.zeros(2), 0.02))
    assert all(a is b for a, b in zip(same, room[2], strict=True))


@pytest.mark.filterwarnings("ignore:The depth images")
@given(
    scale=st.floats(0.8, 1.25), x=st.floats(-9, 9), y=st.floats(-9, 9), seed=st.integers(0, 9), share=st.floats(0, 1)
)
def test_no_depth_is_invented(scale, x, y, seed, share):
    random = np.random.default_rng(seed)
    depth = np.where(random.random((12, 16)) < share, random.uniform(1, 5, (12, 16)), 0).astype(np.float32)
    views = one_view(depth, size=(16, 12), center=(8.0, 6.0))
    moved = calibrated(*views, Registration(scale, np.array([x, y]), 0.5))[0].depth
    assert set(moved.ravel().tolist()) <= {0.0, *depth.ravel().tolist()}


@given(seed=st.integers(0, 2**32 - 1), height=st.integers(20, 60), width=st.integers(20, 60))
def test_a_coarse_fit_is_the_mean_of_the_blurred_edges_under_the_outline_at_every_scale_and_shift(seed, height, width):
    rng = np.random.default_rng(seed)
    center = np.array([width / 2, height / 2])
    outline = (rng.random((30, 2)) - 0.5) * (1.3 * width, 1.3 * height)  # some of it beyond the photo
    view = _View(rng.random((height, width), np.float32), outline, center)
    fits = _coarse_fits(view)
    (blurred,) = _blurred([view], 2)
    around = np.pad(blurred.edges, _REACH, constant_values=blurred.neutral)
    for row in (0, 20, 33, len(_SCALES) - 1):
        x, y = np.floor(outline * _SCALES[row] + center).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        for dy, dx in ((0, 0), (_REACH, _REACH), (3, 2 * _REACH), (2 * _REACH, 2 * _REACH)):
            # What a scale moves out of the photo is not asked again at every shift.
            met = np.where(inside, around[(y + dy) * inside, (x + dx) * inside], blurred.neutral)
            assert fits[row, dy, dx] == pytest.approx(met.mean(), abs=1e-5)
