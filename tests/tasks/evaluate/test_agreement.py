"""Our measures against independent implementations, where these are installed."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.evaluate.contingency import contingency
from ss_flow.tasks.evaluate.novel_view import psnr, ssim
from ss_flow.tasks.evaluate.panoptic import panoptic_quality
from ss_flow.tasks.masks.overlap import iou

CLOSE = {"abs": 1e-6}


def _pictures(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture and a noisy copy, black for 8 pixels at the border, where implementations differ."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:40, :56]
    smooth = 127 + 90 * np.sin(x[..., None] / (4.0, 6.0, 9.0)) * np.cos(y[..., None] / 7)
    noisy = smooth + rng.normal(0, 20, smooth.shape)
    return tuple(np.pad(np.clip(p, 0, 255).astype(np.uint8), ((8, 8), (8, 8), (0, 0))) for p in (smooth, noisy))


@pytest.mark.parametrize("seed", range(3))
def test_psnr_and_ssim_are_those_of_scikit_image(seed: int) -> None:
    metrics = pytest.importorskip("skimage.metrics")
    photo, image = _pictures(seed)
    assert psnr(image, photo) == pytest.approx(metrics.peak_signal_noise_ratio(photo, image), **CLOSE)
    _, similarity = metrics.structural_similarity(
        photo / 255,
        image / 255,
        data_range=1,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    assert ssim(image, photo) == pytest.approx(similarity.mean(), **CLOSE)


@pytest.mark.parametrize("seed", range(5))
def test_panoptic_quality_is_that_of_torchmetrics(seed: int) -> None:
    detection = pytest.importorskip("torchmetrics.detection")
    import torch

    rng = np.random.default_rng(seed)
    truth = np.kron(rng.integers(0, 6, (5, 6)), np.ones((6, 6), int))
    predicted = np.where(rng.random(truth.shape) < 0.75, truth, rng.integers(0, 6, truth.shape))
    # Category 1 for all instances, 0 for the background, which is stuff there.
    shown = [torch.tensor(np.stack([ids > 0, ids], axis=-1).astype(int))[None] for ids in (predicted, truth)]
    theirs = detection.PanopticQuality(things={1}, stuffs={0}, return_sq_and_rq=True, return_per_class=True)
    values = theirs(*shown).squeeze()
    things = values[theirs.cat_id_to_continuous_id[1]].tolist()
    ours = panoptic_quality(contingency(truth, predicted).without(truth=0, predicted=0))
    assert [ours.pq, ours.sq, ours.rq] == pytest.approx(things, **CLOSE) and 0 < ours.pq < 1


@pytest.mark.parametrize("seed", range(3))
def test_ious_are_those_of_pycocotools(seed: int) -> None:
    mask = pytest.importorskip("pycocotools.mask")
    rng = np.random.default_rng(seed)
    truth, predicted = rng.integers(0, 4, (2, 30, 40))
    packed = [
        [mask.encode(np.asfortranarray((ids == i).astype(np.uint8))) for i in range(4)] for ids in (truth, predicted)
    ]
    theirs = mask.iou(packed[1], packed[0], [0] * 4).T
    np.testing.assert_allclose(contingency(truth, predicted).iou, theirs, atol=1e-6)
    assert iou(truth == 1, predicted == 2) == pytest.approx(theirs[1, 2], **CLOSE)
