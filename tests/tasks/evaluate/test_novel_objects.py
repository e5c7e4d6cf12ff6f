"""Renderings object by object: boxes, borders, and what is left when an object is taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from random_networks import narrow_lpips

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Cameras, Frame, Gaussians, LabelMap
from ss_flow.tasks.evaluate.novel_objects import border_band, object_views, removals
from ss_flow.tasks.evaluate.novel_view import to_8bit
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import encode_png

WIDTH, HEIGHT = 64, 48
CAMERAS = Cameras(("a",), np.int32([[WIDTH, HEIGHT]]), np.array([[40.0, 40.0, 32.0, 24.0]]), np.eye(4)[None], True)


def _scene() -> tuple[Gaussians, LabelMap]:
    """Two flat squares of small opaque Gaussians, left and right of the middle, and where they are seen."""
    ids = np.zeros((HEIGHT, WIDTH), np.uint16)
    ids[14:34, 8:24], ids[14:34, 40:56] = 1, 2
    y, x = np.nonzero(ids)
    n = len(x)
    means = np.stack([(x + 0.5 - 32) / 40, (y + 0.5 - 24) / 40, np.ones(n)], axis=1).astype(np.float32)
    scene = Gaussians(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.full((n, 3), np.log(0.008), np.float32),
        np.full(n, 6, np.float32),
        np.full((n, 1, 3), 0.9, np.float32),
        ids[y, x].astype(np.int32),
        np.ones(n, np.float32),
        np.zeros(n, np.int32),
    )
    return scene, LabelMap("a", ids)


SCENE, TRUTH = _scene()
SEEN = to_8bit(render(SCENE, camera_of(CAMERAS, 0)).rgb)


def _frame(photo: np.ndarray, valid: np.ndarray | None = None) -> Frame:
    packed = np.zeros(0, np.uint8) if valid is None else encode_png(np.uint8(255) * valid)
    return Frame("a", WIDTH, HEIGHT, encode_png(photo), packed, WIDTH, HEIGHT)


def test_an_error_in_one_box_is_that_objects_alone() -> None:
    photo = SEEN.copy()
    photo[14:34, 40:56] = SEEN[14:34, 40:56] // 2
    found = object_views((_frame(photo),), CAMERAS, SCENE, (TRUTH,))
    assert found.instance.tolist() == [1, 2] and found.views.tolist() == [1, 1]
    error = ((SEEN[14:34, 40:56].astype(float) - photo[14:34, 40:56]) / 255) ** 2
    assert found.psnr.tolist() == pytest.approx([100, -10 * np.log10(error.mean())])
    assert found.ssim[0] == pytest.approx(1) and found.ssim[1] < 0.9
    assert found.psnr[1] < found.whole_psnr < 100


def test_lpips_of_an_object_is_that_of_its_box(tmp_path) -> None:
    model, photo = narrow_lpips(tmp_path), SEEN.copy()
    photo[14:34, 40:56] = SEEN[14:34, 40:56] // 2
    found = object_views((_frame(photo),), CAMERAS, SCENE, (TRUTH,), perception=model)
    assert found.lpips[1] > found.whole_lpips > found.lpips[0] >= 0
    same = object_views((_frame(SEEN),), CAMERAS, SCENE, (TRUTH,), perception=model)
    assert same.lpips.tolist() == [0, 0] and same.whole_lpips == 0
    without = object_views((_frame(photo),), CAMERAS, SCENE, (TRUTH,))
    assert np.isnan(without.lpips).all() and np.isnan(without.whole_lpips)
    assert without.psnr.tolist() == found.psnr.tolist()


def test_the_band_is_five_pixels_on_either_side_of_a_border(tmp_path) -> None:
    band, model = border_band(TRUTH.ids), narrow_lpips(tmp_path)
    assert band[24, 3:13].all() and not band[24, 2] and not band[24, 13:19].any()
    clean = object_views((_frame(SEEN),), CAMERAS, SCENE, (TRUTH,), perception=model)
    assert (clean.band_psnr, clean.band_ssim, clean.band_lpips) == (100, pytest.approx(1), 0)
    photo = SEEN.copy()
    photo[24, 16] = 255 - photo[24, 16]  # in the middle of the first object
    found = object_views((_frame(photo),), CAMERAS, SCENE, (TRUTH,))
    assert found.band_psnr == 100 > found.whole_psnr and np.isnan(found.band_lpips)
    photo = SEEN.copy()
    photo[24, 8] = 255 - photo[24, 8]
    found = object_views((_frame(photo),), CAMERAS, SCENE, (TRUTH,), perception=model)
    assert found.band_psnr < 60 and found.band_ssim < found.whole_ssim < 1 and found.band_lpips > found.whole_lpips > 0


def test_pixels_that_are_not_valid_do_not_count() -> None:
    photo, valid = SEEN.copy(), np.ones((HEIGHT, WIDTH), bool)
    photo[14:34, 40:48], valid[14:34, 40:48] = 0, False
    found = object_views((_frame(photo, valid),), CAMERAS, SCENE, (TRUTH,))
    assert found.psnr.tolist() == [100, 100] and found.whole_psnr == 100


def test_a_view_without_an_object_has_no_band_and_counts_in_the_whole_alone() -> None:
    cameras = Cameras(("a", "b"), *(np.repeat(x, 2, axis=0) for x in list(vars(CAMERAS).values())[1:4]), True)
    frames = _frame(SEEN // 2), replace(_frame(SEEN), name="b")
    alone = object_views(frames[:1], CAMERAS, SCENE, (TRUTH,))
    found = object_views(frames, cameras, SCENE, (TRUTH, LabelMap("b", np.zeros_like(TRUTH.ids))))
    assert (found.band_psnr, found.psnr.tolist()) == (alone.band_psnr, alone.psnr.tolist())
    assert found.whole_psnr == pytest.approx((alone.whole_psnr + 100) / 2)


def test_a_view_without_a_valid_pixel_counts_nowhere() -> None:
    cameras = Cameras(("a", "b"), *(np.repeat(x, 2, axis=0) for x in list(vars(CAMERAS).values())[1:4]), True)
    frames = _frame(SEEN // 2), replace(_frame(SEEN, np.zeros((HEIGHT, WIDTH), bool)), name="b")
    alone = object_views(frames[:1], CAMERAS, SCENE, (TRUTH,))
    found = object_views(frames, cameras, SCENE, (TRUTH, LabelMap("b", TRUTH.ids)))
    assert (found.whole_psnr, found.whole_ssim) == (alone.whole_psnr, alone.whole_ssim)
    assert (found.psnr.tolist(), found.views.tolist()) == (alone.psnr.tolist(), [1, 1])


def test_views_without_an_object_are_refused() -> None:
    with pytest.raises(InputError, match="show no instance"):
        object_views((_frame(SEEN),), CAMERAS, SCENE, (LabelMap("a", np.zeros_like(TRUTH.ids)),))


def test_a_clean_object_leaves_nothing_behind_and_one_that_reaches_beyond_its_mask_does() -> None:
    clean = removals(CAMERAS, SCENE, (LabelMap("a", np.where(border_band(TRUTH.ids), 2, TRUTH.ids).astype(np.uint16)),))
    assert clean.instance.tolist() == [1, 2]
    found = removals(CAMERAS, SCENE, (TRUTH,)).residual
    # Half of the first object is called the second one: taking the second out changes pixels of the first.
    wrong = replace(SCENE, instance_id=np.where(SCENE.means[:, 0] > -0.4, 2, SCENE.instance_id).astype(np.int32))
    spoilt = removals(CAMERAS, wrong, (TRUTH,)).residual
    assert found[1] < 0.01 < spoilt[1]
    absent = LabelMap("a", np.where(TRUTH.ids == 2, 0, TRUTH.ids).astype(np.uint16))
    assert removals(CAMERAS, SCENE, (absent,)).instance.tolist() == [1], "what no view shows is not taken out"
