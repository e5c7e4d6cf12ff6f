"""The mask decoder of Segment Anything (Kirillov et al. 2023, Fig. 14), written down so that a prompt costs little.

The published graph carries the image through every layer for each prompt. But a prompt is a handful of tokens, seven
for a point, that look at the 4,096 cells of the image and are looked at by them, and the products of attention may be
taken in any order. With the cells X, of a head's projections W and biases b, and the weights P of its softmax:

    q (X W_k + b_k)ᵀ = (q W_kᵀ) Xᵀ + q b_kᵀ          P (X W_v + b_v) = (P X) W_v + b_v

so cells need not be projected: eight heads of seven tokens are 56 rows of 256 numbers that meet the cells as they are.
q b_kᵀ is the same for every cell and leaves a softmax over cells; the rows of P sum to one. Where cells ask and tokens
answer it is the same with the roles exchanged. And masks are drawn only where the frame shows the photo. The masks are
those of the published graph but for rounding.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import numpy as np

from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Float32, Float64, Int32
from ss_flow.tasks.models.onnx import all_weights_of, open_written, read_graph, run
from ss_flow.tasks.models.onnx_graph import GraphWriter

SIDE = 64
"""Cells on a side of the square frame."""
FINE = 4
"""Pixels of the masks on a side of a cell."""
MASKS = 4
_CELLS, _WIDTH, _HEADS, _LAYERS = SIDE * SIDE, 256, 8, 2
_FINE_EPSILON = 1e-6
"""Of the layer normalisation between the cuts, as the network was trained."""
_FREQUENCIES = "prompt_encoder.pe_layer.positional_encoding_gaussian_matrix"
_KINDS = ("not_a_point_embed", "point_embeddings.0", "point_embeddings.1")
"""Of tokens: the one of no point, which the network was trained to find after points; points outside and inside."""


class MaskDecoder:
    """The network of a published decoder file; see `open_decoder`."""

    def __init__(self, file: FileRef, folded: Sequence[tuple[str, str]], threads: int) -> None:
        weights = _read(file, folded)
        with all_weights_of(file):
            # What every cell gets where no mask is part of the prompt, and the tokens for predicted IoU and masks.
            self._no_mask = weights["no_mask"].reshape(_WIDTH)
            self._own = weights["tokens"].reshape(1 + MASKS, _WIDTH)
            self._kinds = np.concatenate([weights[f"prompt_encoder.{kind}.weight"] for kind in _KINDS])
            self._frequencies = weights[_FREQUENCIES]
            self._attend = open_written(file, lambda: _attending(weights), threads=threads)
            self._draw = open_written(file, lambda: _drawing(weights), threads=threads)

    def __call__(
        self, features: Float32, points: Float64, labels: Int32, rows: int, columns: int
    ) -> tuple[Float32, Float32]:
        """What M prompts on one image ask for.

        features: [1, 256, 64, 64] of the encoder. points: [M, n, 2] x, y in 0..1 of the frame. labels: [M, n] 1 =
        inside, 0 = outside. rows, columns: how many cells of the frame show the photo.
        Returns logits: [M, 4, 4 rows, 4 columns], predicted_iou: [M, 4].
        """
        import cv2

        count = len(points)
        # OpenCV transposes in a quarter of NumPy's time, which is felt where an image gets one prompt.
        cells = cv2.transpose(features.reshape(_WIDTH, _CELLS)) + self._no_mask
        quality, kernels, seen = run(self._attend, {"cells": cells, "tokens": self._tokens(points, labels)})
        shown = seen.reshape(count, SIDE, SIDE, _WIDTH)[:, :rows, :columns].reshape(count, -1, _WIDTH)
        pixels = run(self._draw, {"shown": shown, "kernels": kernels})[0]
        # A cell was cut in four twice, so its pixels are numbered y x y x.
        grid = pixels.reshape(count, MASKS, rows, columns, 2, 2, 2, 2).transpose(0, 1, 2, 4, 6, 3, 5, 7)
        return grid.reshape(count, MASKS, rows * FINE, columns * FINE), quality

    def _tokens(self, points: Float64, labels: Int32) -> Float32:
        """The network's own tokens, those of the points and that of no point: [M, 5 + n + 1, 256]."""
        asked = _places(points, self._frequencies) + self._kinds[1:][labels]
        own, end = (np.broadcast_to(part, (len(points), *part.shape)) for part in (self._own, self._kinds[:1]))
        return np.concatenate([own, asked, end], axis=1, dtype=np.float32)


@functools.lru_cache(maxsize=4)
def open_decoder(file: FileRef, folded: tuple[tuple[str, str], ...], threads: int = 1) -> MaskDecoder:
    """The decoder of a file, one a process for each content and thread count.

    folded: pairs of a name in `MaskDecoder` and the file's own name of arrays that its export computed beforehand.
    Raises InputError when the file is missing, damaged or another network.
    """
    return MaskDecoder(file, folded, threads)


def _read(file: FileRef, folded: Sequence[tuple[str, str]]) -> dict[str, Float32]:
    """The decoder's arrays by the names of its modules, and those that `folded` names.

    A matrix that the export transposed has lost its name, but the node that multiplies by it bears its module's.
    """
    nodes, arrays = read_graph(file)
    weights = {name.removeprefix("model.").removeprefix("mask_decoder."): array for name, array in arrays.items()}
    for node in nodes:
        if node.op_type == "MatMul" and node.input[1] in arrays:
            module = node.name.strip("/").removesuffix("/MatMul").replace("/", ".")
            weights[f"{module}.weight"] = arrays[node.input[1]].T
    return weights | {name: weights[known] for name, known in folded if known in weights}


def _places(points: Float64, frequencies: Float32) -> Float32:
    """Where points are, as sines and cosines of random frequencies: points [..., 2] x, y in 0..1 -> [..., 256]."""
    turns = 2 * np.pi * (2 * points - 1) @ frequencies
    return np.concatenate([np.sin(turns), np.cos(turns)], axis=-1, dtype=np.float32)


def _attending(weights: Mapping[str, Float32]) -> bytes:
    """The two-way transformer: cells [4096, 256] of an image and tokens [m, t, 256] -> predicted IoU [m, 4], kernels of
    the masks [m, 4, 32], the cells as each prompt leaves them [m, 4096, 256].

    Raises KeyError when a weight is missing.
    """
    graph = _Transformer(weights)
    y, x = np.divmod(np.arange(_CELLS), SIDE)
    places = _places((np.stack([x, y], axis=1) + 0.5) / SIDE, weights[_FREQUENCIES])
    prompt, tokens, cells, axes = "tokens", "tokens", "cells", 2
    for number in range(_LAYERS):
        layer = f"transformer.layers.{number}"
        # At first the tokens are nothing but the prompt; later it is added to them wherever they are compared.
        compared = graph.added(tokens, prompt) if number else prompt
        heard = graph.tokens_of_tokens(compared, tokens, f"{layer}.self_attn")
        tokens = graph.normalised(graph.added(tokens, heard) if number else heard, f"{layer}.norm1")
        placed = graph.turned(graph.added(cells, places), axes)
        seen = graph.tokens_of_cells(graph.added(tokens, prompt), placed, cells, f"{layer}.cross_attn_token_to_image")
        tokens = graph.normalised(graph.added(tokens, seen), f"{layer}.norm2")
        thought = graph.perceptron(tokens, f"{layer}.mlp.lin1", f"{layer}.mlp.lin2")
        tokens = graph.normalised(graph.added(tokens, thought), f"{layer}.norm3")
        compared = graph.added(tokens, prompt)
        told = graph.cells_of_tokens(placed, compared, tokens, f"{layer}.cross_attn_image_to_token")
        cells, axes = graph.normalised(graph.added(cells, told), f"{layer}.norm4"), 3
    placed = graph.turned(graph.added(cells, places), axes)
    compared = graph.added(tokens, prompt)
    seen = graph.tokens_of_cells(compared, placed, cells, "transformer.final_attn_token_to_image")
    tokens = graph.normalised(graph.added(tokens, seen), "transformer.norm_final_attn")
    quality, *kernels = (
        graph.perceptron(graph.operator("Gather", tokens, np.array(token), axis=1), *_layers_of(head))
        for token, head in enumerate(("iou_prediction_head", *(f"output_hypernetworks_mlps.{m}" for m in range(MASKS))))
    )
    kernels = [graph.operator("Unsqueeze", kernel, np.array([1])) for kernel in kernels]
    entries = {"cells": (_CELLS, _WIDTH), "tokens": ("m", "t", _WIDTH)}
    return graph.finished(entries, quality, graph.operator("Concat", *kernels, axis=1), cells)


def _layers_of(head: str) -> list[str]:
    return [f"{head}.layers.{number}" for number in range(3)]


class _Transformer(GraphWriter):
    """Layers of few tokens [m, t, 256] and many cells [m, 4096, 256], or [4096, 256] where all prompts have the same;
    attention as the head of this file tells."""

    def added(self, tensor: str, other: str | Float32) -> str:
        return self.operator("Add", tensor, other)

    def perceptron(self, tensor: str, *names: str) -> str:
        for name in names[:-1]:
            tensor = self.operator("Relu", self.linear(tensor, name))
        return self.linear(tensor, names[-1])

    def tokens_of_tokens(self, compared: str, told: str, name: str) -> str:
        """What tokens learn of tokens."""
        queries, keys = self._heads(compared, f"{name}.q_proj", scaled=True), self._heads(compared, f"{name}.k_proj")
        shares = self.operator("Softmax", self.operator("MatMul", queries, self.turned(keys, 4)))
        seen = self.operator("MatMul", shares, self._heads(told, f"{name}.v_proj"))
        return self.linear(self._side_by_side(seen), f"{name}.out_proj")

    def tokens_of_cells(self, compared: str, placed: str, cells: str, name: str) -> str:
        """What tokens see in the cells. placed: the cells with their places, turned."""
        queries = self._heads(compared, f"{name}.q_proj", scaled=True)
        asked = self._stacked(self.operator("MatMul", queries, self._matrices(f"{name}.k_proj")))
        shares = self.operator("Softmax", self.operator("MatMul", asked, placed))
        seen = self._unstacked(self.operator("MatMul", shares, cells))
        values = self.operator("MatMul", seen, self._matrices(f"{name}.v_proj").transpose(0, 2, 1))
        joined = self.added(self._side_by_side(values), self.weights[f"{name}.v_proj.bias"])
        return self.linear(joined, f"{name}.out_proj")

    def cells_of_tokens(self, placed: str, compared: str, told: str, name: str) -> str:
        """What cells learn of the tokens. placed: as above."""
        keys = self._heads(compared, f"{name}.k_proj", scaled=True)
        asked = self._stacked(self.operator("MatMul", keys, self._matrices(f"{name}.q_proj")))
        scores = self._unstacked(self.operator("MatMul", asked, placed), _CELLS)
        constant = self.operator("MatMul", keys, self.weights[f"{name}.q_proj.bias"].reshape(_HEADS, -1, 1))
        shares = self._softmax_of_tokens(self.added(scores, constant))
        outward = self.weights[f"{name}.out_proj.weight"].T.reshape(_HEADS, -1, _WIDTH)
        values = self.operator("MatMul", self._heads(told, f"{name}.v_proj"), outward)
        # The shares of each head sum to one, so its values may carry a head's part of the bias.
        values = self.added(values, self.weights[f"{name}.out_proj.bias"] * np.float32(1 / _HEADS))
        return self.operator("MatMul", self.turned(self._stacked(shares, _CELLS), 3), self._stacked(values))

    def turned(self, tensor: str, axes: int) -> str:
        """A tensor of so many axes with the last two exchanged."""
        return self.operator("Transpose", tensor, perm=[*range(axes - 2), axes - 1, axes - 2])

    def _matrices(self, name: str) -> Float32:
        """A projection head by head: [8, w, 256]."""
        return self.weights[f"{name}.weight"].reshape(_HEADS, -1, _WIDTH)

    def _heads(self, tensor: str, name: str, scaled: bool = False) -> str:
        """A projection of tokens, head by head: [m, t, 256] -> [m, 8, t, w]; scaled for dot products if so asked."""
        split = self.operator("Reshape", self.linear(tensor, name), np.array([0, 0, _HEADS, -1]))
        heads = self.operator("Transpose", split, perm=[0, 2, 1, 3])
        width = len(self.weights[f"{name}.bias"]) // _HEADS
        return self.operator("Mul", heads, np.array(width**-0.5, np.float32)) if scaled else heads

    def _side_by_side(self, heads: str) -> str:
        """[m, 8, t, w] -> [m, t, 8 w]."""
        moved = self.operator("Transpose", heads, perm=[0, 2, 1, 3])
        return self.operator("Reshape", moved, np.array([0, 0, -1]))

    def _stacked(self, heads: str, width: int = _WIDTH) -> str:
        """[m, 8, t, width] -> [m, 8 t, width]."""
        return self.operator("Reshape", heads, np.array([0, -1, width]))

    def _unstacked(self, rows: str, width: int = _WIDTH) -> str:
        """The reverse."""
        return self.operator("Reshape", rows, np.array([0, _HEADS, -1, width]))

    def _softmax_of_tokens(self, scores: str) -> str:
        """Over the third of four axes; ONNX Runtime's own would first move that axis to the end."""
        over = np.array([2])
        powers = self.operator("Exp", self.operator("Sub", scores, self.operator("ReduceMax", scores, over)))
        return self.operator("Div", powers, self.operator("ReduceSum", powers, over))


def _drawing(weights: Mapping[str, Float32]) -> bytes:
    """Cells that are shown [m, s, 256] and kernels of the masks [m, 4, 32] -> logits [m, 4, 16 s]: each cell is cut in
    four, and each of these again. Raises KeyError when a weight is missing."""
    graph = GraphWriter(weights)
    halves = _cut_in_four(graph, "shown", "output_upscaling.0")
    norm = (weights[f"output_upscaling.1.{part}"].ravel() for part in ("weight", "bias"))
    halves = graph.operator("Gelu", graph.operator("LayerNormalization", halves, *norm, epsilon=_FINE_EPSILON))
    quarters = graph.operator("Gelu", _cut_in_four(graph, halves, "output_upscaling.3"))
    logits = graph.operator("MatMul", "kernels", graph.operator("Transpose", quarters, perm=[0, 2, 1]))
    channels = weights["output_upscaling.3.bias"].size
    return graph.finished({"shown": ("m", "s", _WIDTH), "kernels": ("m", MASKS, channels)}, logits)


def _cut_in_four(graph: GraphWriter, tensor: str, name: str) -> str:
    """A transposed convolution with kernel and stride 2, which mixes no neighbours: [m, s, i] -> [m, 4 s, o], the four
    pixels of a cell row by row."""
    kernel, bias = graph.weights[f"{name}.weight"], graph.weights[f"{name}.bias"]
    matrix = kernel.transpose(0, 2, 3, 1).reshape(len(kernel), -1)
    cut = graph.operator("Add", graph.operator("MatMul", tensor, matrix), np.tile(bias, 4))
    return graph.operator("Reshape", cut, np.array([0, -1, bias.size]))
