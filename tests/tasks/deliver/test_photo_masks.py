"""Masks in the pixels of the photos as they were taken: what is painted there is found there again."""

from __future__ import annotations

import struct
from pathlib import Path

import capture_folders as made
import cv2
import numpy as np
import pytest
from capture_folders import ref

from ss_flow.tasks.artifacts import Frame, LabelMap
from ss_flow.tasks.capture.id_images import ready_masks
from ss_flow.tasks.capture.ingest import IngestParams, frames
from ss_flow.tasks.capture.lens import Lens, distorted, inside_source, photo_lens, undistorted, undistortion_map
from ss_flow.tasks.capture.photo_pixels import photo_pixels
from ss_flow.tasks.capture.sfm import registered
from ss_flow.tasks.deliver.output import write_masks
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid

WIDTH, HEIGHT = 320, 240
LENSES = {
    "radial": Lens(WIDTH, HEIGHT, 300, 310, 161, 117, (-0.4, 0.1, 0.0, 0.0)),
    "cushion": Lens(WIDTH, HEIGHT, 300, 310, 161, 117, (0.9, 0.3, 0.0, 0.0)),
    "tangential": Lens(WIDTH, HEIGHT, 300, 310, 161, 117, (-0.3, 0.05, 0.03, -0.02, 0.01)),
    "rational": Lens(WIDTH, HEIGHT, 300, 310, 161, 117, (0.4, 0.1, 0.004, -0.003, 0.02, 0.8, 0.2, 0.03)),
    "fisheye": Lens(WIDTH, HEIGHT, 190, 195, 161, 117, (-0.1, 0.02, -0.01, 0.001), fisheye=True),
}


def forward(points: np.ndarray, lens: Lens) -> np.ndarray:
    """OpenCV's own word for where points of the undistorted image lie in the photo."""
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]], float)
    slopes = (points - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    if lens.fisheye:
        return cv2.fisheye.distortPoints(slopes[:, None], matrix, np.array(lens.distortion))[:, 0]
    rays = np.column_stack([slopes, np.ones(len(points))])
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(lens.distortion))[0][:, 0]


def all_pixels(width: int, height: int) -> np.ndarray:
    v, u = np.mgrid[:height, :width] + 0.5
    return np.column_stack([u.ravel(), v.ravel()])


def frame_of(width: int, height: int, lens: Lens) -> Frame:
    return Frame("a", width, height, np.zeros(0, np.uint8), np.zeros(0, np.uint8), lens.width, lens.height)


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_bends_as_opencv_says_and_straightening_undoes_it(name):
    lens, points = LENSES[name], all_pixels(WIDTH, HEIGHT)
    np.testing.assert_allclose(distorted(points, lens), forward(points, lens), atol=1e-9)
    straight = undistorted(points, lens)
    assert np.isfinite(straight).all()
    np.testing.assert_allclose(forward(straight, lens), points, atol=1e-5)


@pytest.mark.parametrize("times", [1, 5])
@pytest.mark.parametrize("name", LENSES)
def test_each_pixel_of_a_photo_is_shown_by_the_pixel_of_the_frame_in_which_it_falls(name, times):
    """Also in a photo of many pixels, most of which are interpolated, and in a frame of another size."""
    lens = LENSES[name].scaled(times * WIDTH, times * HEIGHT)
    pixels = photo_pixels(frame_of(200, 150, lens), lens).ravel()
    place = undistorted(all_pixels(lens.width, lens.height), lens) * (200 / lens.width, 150 / lens.height)
    inside = ((place >= 0) & (place < (200, 150))).all(axis=1)
    expected = np.where(inside, np.floor(place[:, 1]) * 200 + np.floor(place[:, 0]), -1)
    sure = (np.abs(place - np.round(place)) > 1e-3).all(axis=1)
    assert sure.mean() > 0.99
    np.testing.assert_array_equal(pixels[sure], expected[sure])


@pytest.mark.parametrize("name", LENSES)
def test_the_photos_pixels_that_the_frame_was_made_of_are_all_shown(name):
    lens = LENSES[name]
    source = undistortion_map(lens)
    used = np.round(source[inside_source(source)]).astype(int)
    used = used[((used >= 1) & (used < (WIDTH - 1, HEIGHT - 1))).all(axis=1)]
    pixels = photo_pixels(frame_of(WIDTH, HEIGHT, lens), lens)
    # A photo's pixel at the rim of what the frame shows may have its centre beyond.
    assert (pixels[used[:, 1], used[:, 0]] >= 0).mean() > 0.99


def test_where_the_lens_folds_the_image_over_only_the_part_up_to_the_fold_is_shown():
    """By hand: r (1 - 0.3 r^2) is largest, 0.703, at r = 1.054; what lands farther out comes from nowhere near."""
    lens = Lens(400, 400, 200, 200, 200, 200, (-0.3, 0.0, 0.0, 0.0))
    wide = frame_of(400, 400, lens)
    points = all_pixels(400, 400)
    landed = np.hypot(*(points - 200).T) / 200
    straight = undistorted(points, lens)
    assert (np.hypot(*(straight[landed < 0.702] - 200).T) < 1.054 * 200).all()
    pixels = photo_pixels(wide, lens).ravel()
    assert (pixels[landed > 0.704] == -1).all() and (pixels[landed < 0.65] >= 0).all()


def blobs(width: int, height: int) -> np.ndarray:
    """[height, width] a picture of large black and white patches without symmetry."""
    noise = np.random.default_rng(4).normal(size=(height, width)).astype(np.float32)
    return np.where(cv2.GaussianBlur(noise, (0, 0), 9) > 0.005, 255, 0).astype(np.uint8)


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def written_back(path: Path, lens: Lens | None, radial: float, max_side: int, folder: Path) -> tuple[Frame, np.ndarray]:
    """What a run makes of a photo whose bright pixels are object 2 and whose dark ones 1: the frame, and the mask."""
    stated = None if lens is None else (lens,)
    params = IngestParams(max_side=max_side, jpeg_quality=0)
    views = frames(names=("a",), photos=(ref(path),), lenses=stated, params=params)
    cameras = made.cameras_of(views, radial)
    views = registered(views, cameras)
    ids = np.where(decode_rgb(views[0])[..., 0] > 127, 2, 1).astype(np.uint16)
    ids[~decode_valid(views[0])] = 0
    write_masks({folder: [LabelMap("a", ids)]}, views, [photo_lens(views[0], lens, cameras)])
    # Given to another run of the same photo, the mask is that of the frame again.
    file = ref(folder / "a.png")
    (given,) = ready_masks(views, cameras, names=("a",), files=(file,), lenses=stated)
    known = given.dense().any(axis=0)
    again = np.where(known, np.where(given.dense()[-1], 2, 1), 0)
    assert (again == ids)[known].mean() > 0.99 and known.mean() > 0.97 * (ids > 0).mean()
    return views[0], cv2.imread(str(folder / "a.png"), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("max_side", [1600, 200], ids=["as it is", "scaled down"])
@pytest.mark.parametrize("name", [*LENSES, "structure from motion"])
def test_what_is_painted_in_a_photo_is_masked_where_it_was_painted(name, max_side, tmp_path):
    photo = blobs(WIDTH, HEIGHT)
    cv2.imwrite(str(tmp_path / "a.png"), photo)
    lens = LENSES.get(name)
    frame, mask = written_back(tmp_path / "a.png", lens, 0.0 if lens else -0.35, max_side, tmp_path / "masks")
    assert max(frame.width, frame.height) == min(max_side, WIDTH)
    assert (mask.dtype, mask.shape) == (np.uint16, (HEIGHT, WIDTH))
    truth = np.where(photo > 127, 2, 1)
    shown = mask > 0
    assert (mask == truth)[shown].mean() > (0.985 if max_side > WIDTH else 0.96)
    assert 0.45 < shown.mean() < (1 if name == "cushion" or name == "rational" else 0.95)
    # A mask in the frame's own pixels would not do.
    unmoved = cv2.resize(decode_rgb(frame)[..., 0], (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    assert (np.where(unmoved > 127, 2, 1) == truth)[shown].mean() < 0.93


@pytest.mark.parametrize("refers_to", ["the upright photo", "the stored photo"])
def test_masks_of_a_photo_on_its_side_are_upright_unless_its_intrinsics_are_those_of_the_stored_one(
    refers_to, tmp_path
):
    """As given masks are read."""
    upright = blobs(HEIGHT, WIDTH)
    stored = np.ascontiguousarray(np.rot90(upright, 1))  # EXIF's 6: to be turned by a quarter to the right
    jpeg = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(with_orientation(jpeg, 6))
    seen = upright if refers_to == "the upright photo" else stored
    height, width = seen.shape
    lens = Lens(width, height, 300, 310, width / 2 + 3, height / 2 - 2, (-0.4, 0.1, 0.01, 0.0))
    _, mask = written_back(tmp_path / "a.jpg", lens, 0.0, 1600, tmp_path / "masks")
    assert mask.shape == seen.shape
    shown = mask > 0
    assert shown.mean() > 0.5 and (mask == np.where(seen > 127, 2, 1))[shown].mean() > 0.985


def test_frames_of_several_lenses_each_get_their_own_distortion_back(tmp_path):
    ids = np.arange(WIDTH * HEIGHT, dtype=np.uint32).reshape(HEIGHT, WIDTH).astype(np.uint16)
    views = [Frame(n, WIDTH, HEIGHT, np.zeros(0), np.zeros(0), WIDTH, HEIGHT) for n in "abc"]
    lenses = [LENSES["radial"], None, LENSES["fisheye"]]
    maps = [LabelMap(view.name, ids) for view in views]
    write_masks({tmp_path / "masks": maps, tmp_path / "other": maps}, views, lenses)
    for view, lens in zip(views, lenses, strict=True):
        expected = ids
        if lens is not None:
            pixels = photo_pixels(view, lens)
            expected = np.where(pixels >= 0, ids.ravel()[pixels], 0)
        for folder in ("masks", "other"):
            read = cv2.imread(str(tmp_path / folder / f"{view.name}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(read, expected)
