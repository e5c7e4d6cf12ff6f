"""How noisy photos are, and photos without their noise."""

import numpy as np
import pytest

from ss_flow.tasks.geometry.noise import noise_of, without_noise


def photo() -> np.ndarray:
    """A plain half, and one of fine stripes: [96, 128, 3]."""
    rgb = np.full((96, 128, 3), (120, 90, 150), np.uint8)
    rgb[:, 64::4] = (40, 60, 50)
    return rgb


def noisy(deviation: float, rgb: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, deviation, rgb.shape[:2])[..., None]
    return np.clip(np.rint(rgb + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("deviation", [2.0, 5.0, 10.0])
def test_noise_is_told_beside_texture(deviation):
    assert noise_of(noisy(deviation, photo())) == pytest.approx(deviation, rel=0.15)


def test_stripes_and_ramps_are_no_noise():
    ramp = np.repeat(np.arange(128, dtype=np.uint8)[None, :, None], 96, axis=0).repeat(3, axis=2) + np.uint8(50)
    assert noise_of(photo()) < 1e-3
    assert noise_of(ramp) < 0.5


def test_a_black_border_hides_no_noise():
    rgb = np.zeros((192, 192, 3), np.uint8)
    rgb[48:144, 32:160] = noisy(5.0, photo())
    assert noise_of(rgb) == pytest.approx(5.0, rel=0.15)


@pytest.mark.parametrize("shape", [(15, 200, 3), (200, 15, 3)])
def test_less_than_a_block_tells_nothing(shape):
    assert noise_of(noisy(10.0, np.full(shape, 128, np.uint8))) == 0


def test_noise_is_taken_away_and_edges_stay():
    clean = photo()
    smooth = without_noise(noisy(6.0, clean))
    off = np.abs(smooth.astype(int) - clean)
    assert smooth.shape == clean.shape and smooth.dtype == np.uint8
    assert off[8:-8, 8:56].mean() < 2
    assert off[8:-8, 72:-8].mean() < 6  # a step of the stripes is 72
