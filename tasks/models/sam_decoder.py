"""The mask decoder of Segment Anything (Kirillov et al. 2023, Fig. 14), written down from the weights of its published
file, so that a prompt costs little: what it does to the image's cells stands in `sam_cells.py`, and masks are drawn
only where the frame shows the photo. They are those of the published graph but for rounding.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Float32, Float64, Int32
from ss_flow.tasks.models.onnx import all_weights_of, open_written, read_graph, run
from ss_flow.tasks.models.onnx_graph import GraphWriter
from ss_flow.tasks.models.sam_cells import (
    CELLS,
    FEATURES,
    HEADS,
    SIDE,
    WIDTH,
    Cells,
    FactoredCells,
    PlainCells,
)

FINE = 4
"""Pixels of the masks on a side of a cell."""
MASKS = 4
_LAYERS = 2
_FINE_EPSILON = 1e-6
"""Of the layer normalisation between the cuts, as the network was trained."""
_FREQUENCIES = "prompt_encoder.pe_layer.positional_encoding_gaussian_matrix"
_INT64 = 7  # onnx.TensorProto.INT64, whose module is only loaded where a network is written
_KINDS = ("not_a_point_embed", *(f"point_embeddings.{label}" for label in range(4)))
"""Of tokens: the one of no point, which the network was trained to find after points; points outside and inside, the
upper left and the lower right corner of a box."""


class MaskDecoder:
    """The network of a published decoder file; see `open_decoder`."""

    def __init__(self, file: FileRef, folded: Sequence[tuple[str, str]]) -> None:
        weights = _read(file, folded)
        with all_weights_of(file):
            self._own = weights["tokens"].reshape(1 + MASKS, WIDTH)
            self._kinds = np.concatenate([weights[f"prompt_encoder.{kind}.weight"] for kind in _KINDS])
            self._frequencies = weights[_FREQUENCIES]
        self._factored, self._plain = (_Network(file, weights, factored) for factored in (True, False))

    def known(self, features: Float32, *, few: bool = False) -> Known:
        """What prompts on one image start from: features [1, 256, 64, 64] of the encoder.

        few: the image's cells are kept plain, as it does not pay to compute what is the same for all prompts.
        """
        network = self._plain if few else self._factored
        return Known(network, network.known(features.reshape(WIDTH, CELLS)))

    def __call__(
        self, known: Known, points: Float64, labels: Int32, rows: int, columns: int
    ) -> tuple[Float32, Float32]:
        """What M prompts on one image ask for.

        points: [M, n, 2] x, y in 0..1 of the frame. labels: [M, n] 1 = inside, 0 = outside, 2 and 3 = upper left and
        lower right corner of a box. rows, columns: how many cells of the frame show the photo.
        Returns logits: [M, 4, 4 rows, 4 columns], predicted_iou: [M, 4].
        """
        shown = np.array([rows, columns], np.float32)
        inputs = {"tokens": self._tokens(points, labels), "shown": shown, **known.inputs}
        quality, pixels = run(known.network.prompts, inputs)
        # A cell was cut in four twice, so its pixels are numbered y x y x.
        grid = pixels.reshape(-1, MASKS, rows, columns, 2, 2, 2, 2).transpose(0, 1, 2, 4, 6, 3, 5, 7)
        return grid.reshape(-1, MASKS, rows * FINE, columns * FINE), quality

    def _tokens(self, points: Float64, labels: Int32) -> Float32:
        """The network's own tokens, those of the points and that of no point: [M, 5 + n + 1, 256]."""
        asked = _places(points, self._frequencies) + self._kinds[1:][labels]
        own, end = (np.broadcast_to(part, (len(points), *part.shape)) for part in (self._own, self._kinds[:1]))
        return np.concatenate([own, asked, end], axis=1, dtype=np.float32)


@dataclass(frozen=True)
class Known:
    """What prompts on one image start from, and the network that they go on with."""

    network: _Network
    inputs: Mapping[str, Float32]


@functools.lru_cache(maxsize=4)
def open_decoder(file: FileRef, folded: tuple[tuple[str, str], ...]) -> MaskDecoder:
    """The decoder of a file, one a process for each content.

    folded: pairs of a name in `MaskDecoder` and the file's own name of arrays that its export computed beforehand.
    Raises InputError when the file is missing, damaged or another network.
    """
    return MaskDecoder(file, folded)


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


class _Network:
    """The decoder for prompts whose cells are factored, or plain."""

    def __init__(self, file: FileRef, weights: Mapping[str, Float32], factored: bool) -> None:
        with all_weights_of(file):
            y, x = np.divmod(np.arange(CELLS), SIDE)
            places = _places((np.stack([x, y], axis=1) + 0.5) / SIDE, weights[_FREQUENCIES])
            no_mask = weights["no_mask"].reshape(WIDTH)
            graph, of_image = _Decoder(weights), GraphWriter(weights, "x")
            cells = FactoredCells(graph, of_image, places, no_mask) if factored else PlainCells(graph, places, no_mask)
            answer = graph.answer(cells)
        known: dict[str, Sequence[int | str]] = {**cells.known}
        self._names = tuple(known)
        image = functools.partial(of_image.finished, FEATURES, *known)
        self._image = open_written(file, image) if factored else None
        entries = {"tokens": ("m", "t", WIDTH), "shown": (2,), **known}
        self.prompts = open_written(file, lambda: graph.finished(entries, *answer))

    def known(self, features: Float32) -> dict[str, Float32]:
        """What the image [256, 4096] gives to the inputs of `prompts`."""
        inputs = {"features": features}
        return inputs if self._image is None else dict(zip(self._names, run(self._image, inputs), strict=True))


class _Decoder(GraphWriter):
    """Layers of tokens [m, t, 256], which are compared with each other and with cells, and the drawing of masks."""

    def answer(self, cells: Cells) -> tuple[str, str]:
        """Inputs tokens [m, t, 256], shown [2] (rows and columns) and what `cells` starts from -> predicted IoU [m, 4],
        logits [m, 4, 16 s], the 16 pixels of a cell together. Raises KeyError when a weight is missing."""
        prompt = tokens = "tokens"
        for number in range(_LAYERS):
            layer = f"transformer.layers.{number}"
            # At first the tokens are nothing but the prompt; later it is added to them wherever they are compared.
            compared = self._added(tokens, prompt) if number else prompt
            heard = self._tokens_of_tokens(compared, tokens, f"{layer}.self_attn")
            tokens = self.normalised(self._added(tokens, heard) if number else heard, f"{layer}.norm1")
            seen = self._tokens_of_cells(self._added(tokens, prompt), cells, f"{layer}.cross_attn_token_to_image")
            tokens = self.normalised(self._added(tokens, seen), f"{layer}.norm2")
            thought = self._perceptron(tokens, f"{layer}.mlp.lin1", f"{layer}.mlp.lin2")
            tokens = self.normalised(self._added(tokens, thought), f"{layer}.norm3")
            self._cells_of_tokens(cells, self._added(tokens, prompt), tokens, f"{layer}.cross_attn_image_to_token")
            cells.normalise(*self._both(f"{layer}.norm4"))
        seen = self._tokens_of_cells(self._added(tokens, prompt), cells, "transformer.final_attn_token_to_image")
        tokens = self.normalised(self._added(tokens, seen), "transformer.norm_final_attn")
        heads = "iou_prediction_head", *(f"output_hypernetworks_mlps.{mask}" for mask in range(MASKS))
        quality, *kernels = (
            self._perceptron(
                self.operator("Gather", tokens, np.array(token), axis=1), *(f"{head}.layers.{n}" for n in range(3))
            )
            for token, head in enumerate(heads)
        )
        kernels = [self.operator("Unsqueeze", kernel, np.array([1])) for kernel in kernels]
        return quality, self._drawn(cells, self.operator("Concat", *kernels, axis=1))

    def _drawn(self, cells: Cells, kernels: str) -> str:
        """Each cell is cut in four, and each of these again; kernels [m, 4, 32] are of the masks."""
        first, second = "output_upscaling.0", "output_upscaling.3"
        shown = self.operator("Cast", "shown", to=_INT64)
        halves = self._cut(cells.drawn(*self._four_of(first), shown), first)
        norm = (part.ravel() for part in self._both("output_upscaling.1"))
        halves = self.operator("Gelu", self.operator("LayerNormalization", halves, *norm, epsilon=_FINE_EPSILON))
        matrix, bias = self._four_of(second)
        quarters = self._cut(self._added(self.operator("MatMul", halves, matrix), bias), second)
        quarters = self.operator("Gelu", quarters)
        return self.operator("MatMul", kernels, self.operator("Transpose", quarters, perm=[0, 2, 1]))

    def _four_of(self, name: str) -> tuple[Float32, Float32]:
        """A transposed convolution with kernel and stride 2, which mixes no neighbours, as a linear layer: matrix [i, 4
        o], bias [4 o]; the four pixels of a cell row by row."""
        kernel, bias = self._both(name)
        return kernel.transpose(0, 2, 3, 1).reshape(len(kernel), -1), np.tile(bias, 4)

    def _cut(self, tensor: str, name: str) -> str:
        """[m, s, 4 o] -> [m, 4 s, o]."""
        return self.operator("Reshape", tensor, np.array([0, -1, self.weights[f"{name}.bias"].size]))

    def _tokens_of_tokens(self, compared: str, told: str, name: str) -> str:
        """What tokens learn of tokens."""
        queries, keys = self._heads(compared, f"{name}.q_proj", scaled=True), self._heads(compared, f"{name}.k_proj")
        turned = self.operator("Transpose", keys, perm=[0, 1, 3, 2])
        shares = self.operator("Softmax", self.operator("MatMul", queries, turned))
        seen = self.operator("MatMul", shares, self._heads(told, f"{name}.v_proj"))
        return self.linear(self._side_by_side(seen), f"{name}.out_proj")

    def _tokens_of_cells(self, compared: str, cells: Cells, name: str) -> str:
        """What tokens see in the cells."""
        queries = self._heads(compared, f"{name}.q_proj", scaled=True)
        shares = self.operator("Softmax", cells.compared(queries, *self._both(f"{name}.k_proj")))
        seen = cells.mean(shares, *self._both(f"{name}.v_proj"))
        return self.linear(self._side_by_side(seen), f"{name}.out_proj")

    def _cells_of_tokens(self, cells: Cells, compared: str, told: str, name: str) -> None:
        """What cells learn of the tokens."""
        keys = self._heads(compared, f"{name}.k_proj", scaled=True)
        shares = self._softmax_of_tokens(cells.compared(keys, *self._both(f"{name}.q_proj")))
        cells.hear(shares, self._heads(told, f"{name}.v_proj"), *self._both(f"{name}.out_proj"))

    def _added(self, tensor: str, other: str | Float32) -> str:
        return self.operator("Add", tensor, other)

    def _perceptron(self, tensor: str, *names: str) -> str:
        for name in names[:-1]:
            tensor = self.operator("Relu", self.linear(tensor, name))
        return self.linear(tensor, names[-1])

    def _both(self, name: str) -> tuple[Float32, Float32]:
        return self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]

    def _heads(self, tensor: str, name: str, scaled: bool = False) -> str:
        """A projection of tokens, head by head: [m, t, 256] -> [m, 8, t, w]; scaled for dot products if so asked."""
        split = self.operator("Reshape", self.linear(tensor, name), np.array([0, 0, HEADS, -1]))
        heads = self.operator("Transpose", split, perm=[0, 2, 1, 3])
        width = len(self.weights[f"{name}.bias"]) // HEADS
        return self.operator("Mul", heads, np.array(width**-0.5, np.float32)) if scaled else heads

    def _side_by_side(self, heads: str) -> str:
        """[m, 8, t, w] -> [m, t, 8 w]."""
        moved = self.operator("Transpose", heads, perm=[0, 2, 1, 3])
        return self.operator("Reshape", moved, np.array([0, 0, -1]))

    def _softmax_of_tokens(self, scores: str) -> str:
        """Over the third of four axes; ONNX Runtime's own would first move that axis to the end."""
        over = np.array([2])
        powers = self.operator("Exp", self.operator("Sub", scores, self.operator("ReduceMax", scores, over)))
        return self.operator("Div", powers, self.operator("ReduceSum", powers, over))
