"""Image measures: closed forms, a slow reference, masks; and the task on renders that are known."""

from __future__ import annotations

import pathlib
import sys
import types
from typing import Any

import numpy as np
import pytest
from random_networks import narrow_lpips

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Cameras, ColourTransform, Frame, Gaussians
from ss_flow.tasks.evaluate.novel_view import colour_fitted, novel_view, psnr, ssim, to_8bit
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.models.lpips import Lpips, distance

_RNG = np.random.default_rng(0)
PHOTO = _RNG.integers(0, 256, (20, 24, 3), dtype=np.uint8)


def test_psnr_of_a_constant_error_is_the_closed_form() -> None:
    dark = np.full((8, 8, 3), 100, np.uint8)
    assert psnr(dark + np.uint8(51), dark) == pytest.approx(20 * np.log10(255 / 51))
    assert psnr(np.zeros_like(dark), np.full_like(dark, 255)) == pytest.approx(0)
    assert psnr(dark, dark) == 100


def test_psnr_looks_at_valid_pixels_only() -> None:
    image = PHOTO.copy()
    image[:, :12] = 0
    image[:, 12:] = np.clip(PHOTO[:, 12:].astype(int) + 1, 0, 255)
    right = np.zeros((20, 24), bool)
    right[:, 12:] = True
    changed = (PHOTO[:, 12:] < 255).mean()
    assert psnr(image, PHOTO, right) == pytest.approx(-10 * np.log10(changed / 255**2))


def _slow_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Window by window, zeros beyond the border."""
    x = np.arange(-5, 6)
    window = np.exp(-(x[:, None] ** 2 + x**2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for channel in range(3):
        p, q = (np.pad(im[..., channel] / 255.0, 5) for im in (a, b))
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                u, v = p[i : i + 11, j : j + 11], q[i : i + 11, j : j + 11]
                mu, mv = (window * u).sum(), (window * v).sum()
                vu, vv = (window * u * u).sum() - mu**2, (window * v * v).sum() - mv**2
                cov = (window * u * v).sum() - mu * mv
                top = (2 * mu * mv + 1e-4) * (2 * cov + 9e-4)
                values.append(top / ((mu**2 + mv**2 + 1e-4) * (vu + vv + 9e-4)))
    return float(np.mean(values))


def test_ssim_agrees_with_the_definition_window_by_window() -> None:
    noisy = np.clip(PHOTO + _RNG.normal(0, 40, PHOTO.shape), 0, 255).astype(np.uint8)
    assert ssim(noisy, PHOTO) == pytest.approx(_slow_ssim(noisy, PHOTO), abs=1e-9)
    assert 0 < ssim(noisy, PHOTO) < 1


def test_ssim_is_one_for_equal_images_and_symmetric() -> None:
    assert ssim(PHOTO, PHOTO) == pytest.approx(1)
    other = PHOTO[::-1].copy()
    assert ssim(PHOTO, other) == pytest.approx(ssim(other, PHOTO))


def test_what_a_render_shows_at_invalid_pixels_does_not_matter() -> None:
    valid = np.ones((20, 24), bool)
    valid[5:12, 5:12] = False
    spoilt = PHOTO.copy()
    spoilt[~valid] = 0
    assert ssim(spoilt, PHOTO, valid) == pytest.approx(1)
    assert psnr(spoilt, PHOTO, valid) == 100
    assert ssim(spoilt, PHOTO) < 0.9


def test_renders_are_rounded_and_clipped_to_eight_bits() -> None:
    assert to_8bit(np.float32([-1, 0.5, 0.998, 2])).tolist() == [0, 128, 254, 255]


def _gaussians() -> Gaussians:
    one = np.zeros((1, 3), np.float32)
    flat = np.zeros(1, np.float32)
    ids = np.zeros(1, np.int32)
    return Gaussians(one, np.float32([[1, 0, 0, 0]]), one, flat, np.zeros((1, 1, 3), np.float32), ids, flat, ids)


def _frame(name: str, valid: np.ndarray | None = None) -> Frame:
    mask = np.zeros(0, np.uint8) if valid is None else encode_png(valid.astype(np.uint8) * 255)
    return Frame(name, 24, 20, encode_png(PHOTO), mask, 24, 20)


def _cameras(*names: str) -> Cameras:
    k = len(names)
    return Cameras(names, np.tile(np.int32([48, 40]), (k, 1)), np.ones((k, 4)), np.tile(np.eye(4), (k, 1, 1)), True)


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """A renderer that shows the photo, brighter by one step in each further view, and notes its cameras."""
    cameras: list[Any] = []

    def render(scene: Gaussians, camera: Any, **_: Any) -> Any:
        cameras.append(camera)
        return types.SimpleNamespace(rgb=((PHOTO * 0.9 + len(cameras) - 1) / 255).astype(np.float32))

    fake = types.ModuleType("ss_flow.tasks.gaussians.render")
    fake.render = render  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ss_flow.tasks.gaussians.render", fake)
    return cameras


def test_novel_views_are_the_mean_over_views_at_the_size_of_the_frames(rendered: list[Any]) -> None:
    values = novel_view((_frame("a"), _frame("b")), _cameras("a", "b"), _gaussians()).values
    images = [to_8bit(np.float32(PHOTO * 0.9 + i) / 255) for i in (0, 1)]
    assert values["psnr"] == pytest.approx(np.mean([psnr(i, PHOTO) for i in images]))
    assert values["ssim"] == pytest.approx(np.mean([ssim(i, PHOTO) for i in images]))
    assert [(c.width, c.height, c.fx) for c in rendered] == [(24, 20, 0.5)] * 2


def test_the_valid_mask_of_a_frame_counts(rendered: list[Any]) -> None:
    valid = PHOTO.max(axis=2) < 120
    values = novel_view((_frame("a", valid),), _cameras("a"), _gaussians()).values
    image = to_8bit(np.float32(PHOTO * 0.9) / 255)
    assert values["psnr"] == pytest.approx(psnr(image, PHOTO, valid))
    assert values["psnr"] > psnr(image, PHOTO) + 1


def test_lpips_is_measured_with_a_network_and_on_valid_pixels_alone(
    rendered: list[Any], tmp_path: pathlib.Path
) -> None:
    model = narrow_lpips(tmp_path)
    views = (_frame("a"),), _cameras("a"), _gaussians()
    assert not any(name.startswith("lpips") for name in novel_view(*views).values)
    rendered.clear()
    values = novel_view(*views, perception=model).values
    image, network = to_8bit(np.float32(PHOTO * 0.9) / 255), Lpips(model)
    assert values["lpips"] == pytest.approx(distance(network.differences(image, PHOTO)))
    assert values["lpips_unscaled"] == pytest.approx(distance(network.differences(image, PHOTO, lowest=0.0)))
    assert values["lpips"] > 0 and values["lpips"] != values["lpips_unscaled"]
    rendered.clear()
    valid = np.zeros((20, 24), bool)
    valid[:, :12] = True
    masked = novel_view((_frame("a", valid),), _cameras("a"), _gaussians(), perception=model).values
    half = np.where(valid[..., None], image, PHOTO)
    assert masked["lpips"] == pytest.approx(distance(network.differences(half, PHOTO), valid))


def test_an_affine_change_of_colours_is_fitted_away(rendered: list[Any]) -> None:
    values = novel_view((_frame("a"), _frame("b")), _cameras("a", "b"), _gaussians()).values
    assert values["psnr"] < 40 < 55 < values["psnr_colour_fitted"]  # what is left is rounding


def test_renderings_are_compared_in_the_colours_of_the_photos_beside_too(rendered: list[Any]) -> None:
    views = (_frame("b"),), _cameras("b"), _gaussians()
    assert "psnr_neighbour_colours" not in novel_view(*views).values
    rendered.clear()
    trained = _cameras("a", "c")
    matrix = np.hstack([0.9 * np.eye(3), np.zeros((3, 1))])  # what made the photos as dark as the renderings are
    colours = tuple(ColourTransform(name, "a", matrix) for name in ("a", "c"))
    values = novel_view(*views, (camera_of(trained, 0), camera_of(trained, 1)), colours).values
    assert values["psnr"] < 30 < 35 < values["psnr_neighbour_colours"]


def test_colours_are_fitted_to_the_valid_pixels_alone() -> None:
    rng = np.random.default_rng(2)
    image, valid = rng.random((20, 24, 3)).astype(np.float32), np.arange(24) < 12
    mixed = np.array([[0.7, 0.1, 0.0], [0.0, 0.5, 0.2], [0.1, 0.0, 0.6]], np.float32)
    photo = to_8bit(np.where(valid[:, None], image @ mixed + 0.05, rng.random((20, 24, 3))).astype(np.float32))
    fitted = colour_fitted(image, photo, np.broadcast_to(valid, (20, 24)))
    np.testing.assert_allclose(fitted[:, :12], photo[:, :12] / 255, atol=0.004)
    np.testing.assert_allclose(fitted, image @ mixed + 0.05, atol=0.004)


def test_views_that_cannot_be_compared_are_refused(rendered: list[Any]) -> None:
    with pytest.raises(InputError, match="no held-out view"):
        novel_view((), _cameras(), _gaussians())
    with pytest.raises(InputError, match="not the same views"):
        novel_view((_frame("a"),), _cameras("b"), _gaussians())
    with pytest.raises(InputError, match="view a leaves no pixel"):
        novel_view((_frame("a", np.zeros((20, 24), bool)),), _cameras("a"), _gaussians())
