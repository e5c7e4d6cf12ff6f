"""LPIPS: how different two pictures look, learned from what people said (Zhang et al., "The Unreasonable Effectiveness
of Deep Features as a Perceptual Metric", CVPR 2018; version 0.1).

The features are those of VGG-16 (Simonyan and Zisserman, 2015), after the last ReLU of each of its five blocks, as the
literature of 3D Gaussian splatting takes them.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Bool, Float32, UInt8
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import all_weights_of, open_written, run
from ss_flow.tasks.models.onnx_graph import GraphWriter, read_state

_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""The convolutions of VGG-16, block by block, by their numbers among torchvision's layers; a pooling follows each."""
LEAST_SIDE = 1 << (len(_BLOCKS) - 1)
"""Pixels of the shorter side, of which the last block leaves one."""
_SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
_SCALE = np.array([0.458, 0.448, 0.450], np.float32)
"""Mean and deviation of ImageNet's colours where these are -1..1."""
_EPSILON = 1e-10


class Lpips:
    """The network and the weights of its channels."""

    def __init__(self, model: Model) -> None:
        """Raises InputError when a file is damaged, or of another network."""
        features, linear = model.file("features"), model.file("linear")
        self._session = open_written(features, lambda: _network(read_state(features)))
        weights = read_state(linear)
        with all_weights_of(linear):
            self._weights = [weights[f"lin{block}.model.1.weight"].ravel() for block in range(len(_BLOCKS))]

    def differences(self, image: UInt8, reference: UInt8, *, lowest: float = -1.0) -> tuple[Float32, ...]:
        """Where the features of two pictures differ: five maps [h, w], each over the whole picture, ever coarser.

        Each is the squared difference of the unit vectors of two features, summed over the channels by their weights
        (Eq. 1). image, reference: [H, W, 3] RGB; 0..255 is stretched to lowest..1. The paper's `lowest` is -1; the
        evaluation of 3DGS (Kerbl et al. 2023), and with it most tables of its successors, feeds 0..1.
        Raises InputError when a side has less than 16 pixels.
        """
        if min(image.shape[:2]) < LEAST_SIDE:
            raise InputError(
                f"LPIPS compares pictures of {LEAST_SIDE} x {LEAST_SIDE} pixels or more, "
                f"not of {image.shape[1]} x {image.shape[0]}; choose evaluate.lpips=none."
            )
        first, second = (self._features(picture, lowest) for picture in (image, reference))
        maps = []
        for a, b, weights in zip(first, second, self._weights, strict=True):
            a -= b  # in place, as the first block holds 64 numbers a pixel
            a *= a
            maps.append(np.einsum("c,chw->hw", weights, a))
        return tuple(maps)

    def _features(self, picture: UInt8, lowest: float) -> list[Float32]:
        """Of each block, the features as unit vectors: [C, h, w]."""
        colours = picture.astype(np.float32) * np.float32((1 - lowest) / 255) + np.float32(lowest)
        pixels = np.ascontiguousarray(((colours - _SHIFT) / _SCALE).transpose(2, 0, 1)[None])
        blocks = [block[0] for block in run(self._session, {"pixels": pixels})]
        for block in blocks:
            block /= np.sqrt(np.einsum("chw,chw->hw", block, block)) + np.float32(_EPSILON)
        return blocks


def distance(differences: Sequence[Float32], inside: Bool | None = None) -> float:
    """LPIPS: the sum over the maps of `Lpips.differences` of their means.

    inside: [H, W] the pixels that count, all when None. A cell of a coarse map counts by the share of them in it.
    """
    import cv2

    if inside is None:
        return float(sum(one.mean(dtype=np.float64) for one in differences))
    shares = inside.astype(np.float32)
    total = 0.0
    for one in differences:
        weights = np.asarray(cv2.resize(shares, one.shape[::-1], interpolation=cv2.INTER_AREA), np.float64)
        total += float((weights * one).sum() / weights.sum())
    return total


@functools.lru_cache(maxsize=1)
def lpips_of(model: Model) -> Lpips:
    """The network that a model's files hold, kept open for the next views. Raises InputError."""
    return Lpips(model)


def _network(weights: Mapping[str, Float32]) -> bytes:
    """The features of the five blocks from pixels [1, 3, H, W]. Raises KeyError when a weight is missing."""
    graph = GraphWriter(weights)
    tensor, taps = "pixels", []
    for number, block in enumerate(_BLOCKS):
        if number:
            tensor = graph.operator("MaxPool", tensor, kernel_shape=[2, 2], strides=[2, 2])
        for layer in block:
            kernel, bias = (weights[f"features.{layer}.{part}"] for part in ("weight", "bias"))
            tensor = graph.operator("Relu", graph.operator("Conv", tensor, kernel, bias, pads=[1, 1, 1, 1]))
        taps.append(tensor)
    return graph.finished({"pixels": (1, 3, "h", "w")}, *taps)
