"""LPIPS: against its definition in torch, against torchmetrics, and what holds for any such distance."""

from __future__ import annotations

import numpy as np
import pytest
from random_networks import NARROW, VGG_LAYERS, lpips_in, narrow_lpips, vgg_like

from ss_flow.errors import InputError
from ss_flow.tasks.models.catalogue import Model, find
from ss_flow.tasks.models.lpips import Lpips, distance

RNG = np.random.default_rng(0)
PHOTO = RNG.integers(0, 256, (37, 50, 3), dtype=np.uint8)
"""Sides that no pooling halves evenly."""
NOISY = np.clip(PHOTO + RNG.normal(0, 40, PHOTO.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Model:
    return narrow_lpips(tmp_path_factory.mktemp("lpips"))


def by_definition(model: Model, image: np.ndarray, reference: np.ndarray, lowest: float) -> float:
    """Zhang et al., Eq. 1, with the convolutions of torch, in double precision."""
    import torch
    from torch.nn import functional

    features, linear = (torch.load(model.file(role).path) for role in ("features", "linear"))
    pair = torch.tensor(np.stack([image, reference]).transpose(0, 3, 1, 2), dtype=torch.float64) / 255
    mean, deviation = (torch.tensor(v)[:, None, None] for v in ([-0.03, -0.088, -0.188], [0.458, 0.448, 0.45]))
    rows = (lowest + (1 - lowest) * pair - mean) / deviation
    total = 0.0
    for block, layers in enumerate(VGG_LAYERS):
        if block:
            rows = functional.max_pool2d(rows, 2)
        for layer in layers:
            kernel, bias = (features[f"features.{layer}.{part}"].double() for part in ("weight", "bias"))
            rows = functional.relu(functional.conv2d(rows, kernel, bias, padding=1))
        unit = rows / (rows.norm(dim=1, keepdim=True) + 1e-10)
        weighted = linear[f"lin{block}.model.1.weight"].double()[0] * (unit[0] - unit[1]) ** 2
        total += float(weighted.sum(dim=0).mean())
    return total


@pytest.mark.parametrize("lowest", [-1.0, 0.0])
def test_it_is_the_definition_whatever_the_range_of_the_input(small, lowest):
    found = distance(Lpips(small).differences(NOISY, PHOTO, lowest=lowest))
    assert found == pytest.approx(by_definition(small, NOISY, PHOTO, lowest), abs=1e-5) and found > 0.01


def test_the_range_of_the_input_matters(small):
    stretched, plain = (distance(Lpips(small).differences(NOISY, PHOTO, lowest=lowest)) for lowest in (-1.0, 0.0))
    assert abs(stretched - plain) > 0.01


def test_equal_pictures_are_no_distance_apart_and_the_order_does_not_matter(small):
    network = Lpips(small)
    assert distance(network.differences(PHOTO, PHOTO)) == 0
    there, back = network.differences(NOISY, PHOTO), network.differences(PHOTO, NOISY)
    assert distance(there) == distance(back) > 0


def test_each_map_covers_the_picture_at_half_the_size_of_the_one_before(small):
    shapes = [one.shape for one in Lpips(small).differences(NOISY, PHOTO)]
    assert shapes == [(37, 50), (18, 25), (9, 12), (4, 6), (2, 3)]


def test_only_what_is_inside_counts(small):
    changed = PHOTO.copy()
    changed[:, :8] = 255 - changed[:, :8]
    found = Lpips(small).differences(changed, PHOTO)
    everywhere, left, right = np.ones((37, 50), bool), np.arange(50) < 16, np.arange(50) >= 46
    assert distance(found, everywhere) == pytest.approx(distance(found))
    assert distance(found, np.broadcast_to(left, (37, 50))) > distance(found) > 0
    assert distance(found[:2], np.broadcast_to(right, (37, 50))) == 0, "no feature of two blocks reaches so far"
    one = np.zeros((37, 50), bool)
    one[20, 30] = True
    assert 0 <= distance(found, one) < np.inf


def test_pictures_that_the_last_block_would_leave_nothing_of_are_refused(small):
    with pytest.raises(InputError, match=r"16 x 16 pixels or more, not of 40 x 15.*evaluate\.lpips=none"):
        Lpips(small).differences(PHOTO[:15, :40], PHOTO[:15, :40])
    assert distance(Lpips(small).differences(NOISY[:16, :16], PHOTO[:16, :16])) > 0


def test_weights_of_another_network_are_refused_by_the_one_that_is_missing(tmp_path):
    features = vgg_like(NARROW)
    with pytest.raises(InputError, match=r"linear has no weights 'lin0\.model\.1\.weight'"):
        Lpips(lpips_in(tmp_path, features, {}))
    del features["features.28.bias"]
    with pytest.raises(InputError, match=r"features has no weights 'features\.28\.bias'"):
        Lpips(lpips_in(tmp_path, features, {}))


def test_it_is_torchmetrics_lpips_with_the_same_weights(tmp_path):
    """The backbone's are random here; those of the channels are the published ones."""
    lpips = pytest.importorskip("torchmetrics.functional.image.lpips")
    pytest.importorskip("torchvision", reason="torchmetrics takes VGG-16 from torchvision")
    import torch

    theirs = lpips._LPIPS(pretrained=True, net="vgg", pnet_rand=True)
    features = vgg_like()
    blocks = [getattr(theirs.net, f"slice{i}") for i in range(1, 6)]
    layers = {name: layer for block in blocks for name, layer in block.named_children()}
    for name, array in features.items():
        _, number, part = name.split(".")
        getattr(layers[number], part).data.copy_(array)
    model = lpips_in(tmp_path, features, {k: v for k, v in theirs.state_dict().items() if k.startswith("lin")})
    pair = [torch.tensor(p.transpose(2, 0, 1)[None]) / 255 for p in (NOISY, PHOTO)]
    for lowest, normalise in ((-1.0, True), (0.0, False)):
        with torch.no_grad():
            expected = float(theirs(*pair, normalize=normalise))
        assert distance(Lpips(model).differences(NOISY, PHOTO, lowest=lowest)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.skipif(find("lpips-vgg") is None, reason="needs the network lpips-vgg")
def test_noise_looks_worse_than_a_small_change_of_brightness():
    """What people say, and what PSNR does not: both are as far from the photo by their mean squared error."""
    import cv2
    from matplotlib import cbook

    photo = cv2.imread(str(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))[:256, :256, ::-1]
    calm = np.clip(photo, 20, 235)
    noisy = calm + RNG.choice((-16, 16), calm.shape)
    network = Lpips(find("lpips-vgg"))
    apart = [distance(network.differences(one.astype(np.uint8), calm)) for one in (noisy, calm + 16)]
    assert apart[0] > 3 * apart[1] > 0
