"""EfficientNet-Lite2: the probabilities of ImageNet's 1,000 classes for a picture (Tan and Le, "EfficientNet:
Rethinking Model Scaling for Convolutional Neural Networks"; the "Lite" networks leave out squeeze-and-excitation and
put ReLU6 in the place of swish)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Float32, UInt8
from ss_flow.tasks.models.onnx import open_written, run
from ss_flow.tasks.models.onnx_graph import GraphWriter, read_state

SIDE = 260
"""Side of the square pictures that the network was trained on, pixels."""
_MEAN, _DEVIATION = 127.0, 128.0
_STRIDES = (1, 2, 1, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 1, 2, 1, 1, 1, 1, 1)
"""Of the 21 blocks: seven stages of 1, 3, 3, 4, 4, 5 and 1 of them."""
_EPSILON = 1e-3
"""Of batch normalisation, as the network was trained."""
_BATCH = 8


class EfficientNetLite2:
    """The network, given by the file of its weights: a PyTorch state dictionary."""

    def __init__(self, weights: FileRef) -> None:
        """Raises InputError when the file holds no weights, or those of another network."""
        self._session = open_written(weights, lambda: _network(read_state(weights)))

    def probabilities(self, images: Sequence[UInt8]) -> Float32:
        """Of every class for each picture: [n, 1000], rows of sum 1.

        images: n times [h, w, 3] RGB, of any sizes; each is stretched to a square.
        """
        rows = []
        for start in range(0, len(images), _BATCH):
            pixels = np.stack([_prepared(image) for image in images[start : start + _BATCH]])
            logits = run(self._session, {"pixels": pixels})[0].astype(np.float64)
            shares = np.exp(logits - logits.max(axis=1, keepdims=True))
            rows.append((shares / shares.sum(axis=1, keepdims=True)).astype(np.float32))
        return np.concatenate(rows) if rows else np.zeros((0, 1000), np.float32)


def _prepared(image: UInt8) -> Float32:
    import cv2

    shrinks = max(image.shape[:2]) > SIDE
    scaled = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return ((np.asarray(scaled, np.float32) - _MEAN) / _DEVIATION).transpose(2, 0, 1)


def _network(weights: Mapping[str, Float32]) -> bytes:
    """The network from pixels [n, 3, 260, 260] to logits [n, 1000]. Raises KeyError when a weight is missing."""
    graph = GraphWriter(weights)
    tensor = _convolution(graph, "pixels", "_conv_stem", "_bn0", stride=2, clipped=True)
    for number, stride in enumerate(_STRIDES):
        tensor = _block(graph, tensor, f"_blocks.{number}.", stride)
    tensor = _convolution(graph, tensor, "_conv_head", "_bn1", clipped=True)
    pooled = graph.operator("Flatten", graph.operator("GlobalAveragePool", tensor))
    return graph.finished({"pixels": ("n", 3, SIDE, SIDE)}, graph.linear(pooled, "_fc"))


def _block(graph: GraphWriter, tensor: str, name: str, stride: int) -> str:
    """An inverted bottleneck: wider, filtered channel by channel, narrower; added to its input where it fits."""
    inner = tensor
    if f"{name}_expand_conv.weight" in graph.weights:
        inner = _convolution(graph, inner, f"{name}_expand_conv", f"{name}_bn0", clipped=True)
    inner = _convolution(graph, inner, f"{name}_depthwise_conv", f"{name}_bn1", stride=stride, clipped=True)
    inner = _convolution(graph, inner, f"{name}_project_conv", f"{name}_bn2")
    entry = graph.weights.get(f"{name}_expand_conv.weight")
    narrow = entry is not None and entry.shape[1] == len(graph.weights[f"{name}_bn2.weight"])
    return graph.operator("Add", inner, tensor) if stride == 1 and narrow else inner


def _convolution(
    graph: GraphWriter, tensor: str, name: str, norm: str, *, stride: int = 1, clipped: bool = False
) -> str:
    """A convolution with its batch normalisation folded in, and ReLU6 where `clipped`; padded as TensorFlow does."""
    kernel = graph.weights[f"{name}.weight"]
    gain = graph.weights[f"{norm}.weight"] / np.sqrt(graph.weights[f"{norm}.running_var"] + _EPSILON)
    bias = graph.weights[f"{norm}.bias"] - graph.weights[f"{norm}.running_mean"] * gain
    result = graph.operator(
        "Conv",
        tensor,
        kernel * gain[:, None, None, None],
        bias,
        strides=[stride, stride],
        auto_pad="SAME_UPPER",
        group=len(kernel) if kernel.shape[1] == 1 else 1,
    )
    return graph.operator("Clip", result, np.array(0, np.float32), np.array(6, np.float32)) if clipped else result
