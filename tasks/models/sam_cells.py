"""The cells of an image as prompts of Segment Anything change them, in a network that is written down: as they are, and
factored, so that a prompt costs little.

The published decoder carries the 4,096 cells of the image through every layer for each prompt. But a prompt is a
handful of tokens, seven for a point, and all that they do to the cells is attention, which adds to each cell a mean of
the tokens' values, and layer normalisation, which shifts and scales it. So at every time the cells C [4096, 256] are

    C = (X + S V) / l + b                                                                                     (1)

X is the image's own part, the same for all prompts. S [4096, r] are shares that tokens have in cells, V [r, 256] what
they tell there; r is eight heads times the tokens, for each layer so far. l is a length for each cell, b [256]. All
that is asked of the cells is linear, some C W: X W is computed once for an image, a prompt computes products of few
rows. What cells hear, S' V' + b' with shares that sum to one for each head and cell, keeps the form (1):

    S <- [S, l S']      V <- [V; V' + (b + b') / 8]

and so does layer normalisation with gain g and bias b', where the mean is over the 256 numbers:

    X <- X - mean X     V <- V - mean V     l² <- |X + S V|² / 256 + e l²     X <- X g     V <- V g     b <- b'

    |X + S V|² = |X|² + sum over r of S (2 X Vᵀ + S V Vᵀ)                                                     (2)

V itself is the product of the tokens' values v, of w numbers a head, and a matrix M that the network has, so V W is
v (M W), and M W is computed when the network is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ss_flow.tasks.artifacts import Float32
from ss_flow.tasks.models.onnx_graph import GraphWriter

SIDE = 64
"""Cells on a side of the square frame."""
CELLS, WIDTH, HEADS = SIDE * SIDE, 256, 8
"""Cells of the frame, numbers of each, and heads that attend to them."""
FEATURES = {"features": (WIDTH, CELLS)}
"""The input that the encoder's features are."""
_EPSILON = 1e-5
_ROWS, _BY_HEAD = np.array([0, -1, CELLS]), np.array([0, HEADS, -1, CELLS])
"""Shapes of scores and shares: [m, 8 t, 4096], [m, 8, t, 4096]."""


class Cells(Protocol):
    """What the layers of a network for m prompts of t tokens ask of the cells, and do to them.

    weight, bias: of a linear layer, [out, in] and [out].
    """

    @property
    def known(self) -> Mapping[str, tuple[int, ...]]:
        """Inputs of the network that are the same for all prompts, and their shapes."""

    def compared(self, heads: str, weight: Float32, bias: Float32) -> str:
        """Products of tokens with the cells and their places, projected: heads [m, 8, t, w] -> [m, 8, t, 4096]."""

    def mean(self, shares: str, weight: Float32, bias: Float32) -> str:
        """Means of the cells, projected: shares [m, 8, t, 4096], each row's sum one -> [m, 8, t, w]."""

    def hear(self, shares: str, values: str, weight: Float32, bias: Float32) -> None:
        """Add what tokens tell: shares [m, 8, t, 4096], values [m, 8, t, w]."""

    def normalise(self, gain: Float32, bias: Float32) -> None:
        """Layer normalisation."""

    def drawn(self, matrix: Float32, bias: Float32, shown: str) -> str:
        """The cells that are shown, times matrix [256, n], plus bias: [m, s, n].

        shown: how many rows and columns of cells, an int64 tensor [2]; s is their product.
        """


class PlainCells:
    """The cells as they are, [m, 4096, 256], or [4096, 256] before a prompt has changed them."""

    def __init__(self, graph: GraphWriter, places: Float32, no_mask: Float32) -> None:
        """graph: of the prompts; its input "features" [256, 4096] is the encoder's. places: [4096, 256] where cells
        are. no_mask: [256] what every cell gets where no mask is part of the prompt."""
        self.known = FEATURES
        self._graph, self._places = graph, places
        self._cells = graph.operator("Add", graph.operator("Transpose", "features", perm=[1, 0]), no_mask)
        self._turned = [1, 0]

    def compared(self, heads: str, weight: Float32, bias: Float32) -> str:
        op = self._graph.operator
        placed = op("Transpose", op("Add", self._cells, self._places), perm=self._turned)
        # Few rows meet the cells as they are, instead of all cells being projected.
        rows = op("MatMul", heads, weight.reshape(HEADS, -1, WIDTH))
        scores = op("MatMul", op("Reshape", rows, np.array([0, -1, WIDTH])), placed)
        constant = op("MatMul", heads, bias.reshape(HEADS, -1, 1))
        return op("Add", op("Reshape", scores, _BY_HEAD), constant)

    def mean(self, shares: str, weight: Float32, bias: Float32) -> str:
        op = self._graph.operator
        seen = op("Reshape", op("MatMul", op("Reshape", shares, _ROWS), self._cells), np.array([0, HEADS, -1, WIDTH]))
        projected = op("MatMul", seen, weight.reshape(HEADS, -1, WIDTH).transpose(0, 2, 1))
        return op("Add", projected, bias.reshape(HEADS, 1, -1))

    def hear(self, shares: str, values: str, weight: Float32, bias: Float32) -> None:
        op = self._graph.operator
        # The shares of each head sum to one, so its values may carry a head's part of the bias.
        told = op("Add", op("MatMul", values, weight.T.reshape(HEADS, -1, WIDTH)), bias * np.float32(1 / HEADS))
        rows = op("Transpose", op("Reshape", shares, _ROWS), perm=[0, 2, 1])
        self._cells = op("Add", self._cells, op("MatMul", rows, op("Reshape", told, np.array([0, -1, WIDTH]))))
        self._turned = [0, 2, 1]

    def normalise(self, gain: Float32, bias: Float32) -> None:
        self._cells = self._graph.operator("LayerNormalization", self._cells, gain, bias, epsilon=_EPSILON)

    def drawn(self, matrix: Float32, bias: Float32, shown: str) -> str:
        op = self._graph.operator
        grid = op("Reshape", self._cells, np.array([0, SIDE, SIDE, WIDTH]))
        cells = op("Reshape", op("Slice", grid, np.array([0, 0]), shown, np.array([1, 2])), np.array([0, -1, WIDTH]))
        return op("Add", op("MatMul", cells, matrix), bias)


class FactoredCells:
    """The cells in the form (1), whose names the attributes bear: X [256, 4096], S [m, r, 4096], V = v M with v [m, h,
    t, w] and M [h, w, 256], l [m, 1, 4096]; h is eight for each layer so far."""

    def __init__(self, graph: GraphWriter, image: GraphWriter, places: Float32, no_mask: Float32) -> None:
        """graph: of the prompts. image: what has the input "features" instead, and computes all that is the same for
        every prompt: its outputs are `known`. The other arguments are those of `PlainCells`."""
        self.known: dict[str, tuple[int, ...]] = {}
        self._graph, self._image, self._places = graph, image, places
        self._x = image.operator("Add", "features", no_mask.reshape(WIDTH, 1))
        self._s = self._v = self._l = ""
        self._m: Float32 = np.zeros((0, 0, WIDTH), np.float32)
        self._b: Float32 = np.zeros(WIDTH, np.float32)

    def compared(self, heads: str, weight: Float32, bias: Float32) -> str:
        op, by_head = self._graph.operator, weight.T.reshape(WIDTH, HEADS, -1)
        placed: Float32 = weight @ (self._places + self._b).T
        constant: Float32 = (placed + bias[:, None]).reshape(HEADS, -1, CELLS)
        if not self._l:
            return op("MatMul", heads, self._x_times(by_head, constant))
        rows = op("MatMul", heads, op("Transpose", self._v_times(by_head), perm=[0, 2, 3, 1]))
        told = op("MatMul", op("Reshape", rows, self._and_rank(0, -1)), self._s)
        known = op("Reshape", op("MatMul", heads, self._x_times(by_head)), _ROWS)
        scores = op("Div", op("Add", known, told), self._l)
        return op("Add", op("Reshape", scores, _BY_HEAD), op("MatMul", heads, constant))

    def mean(self, shares: str, weight: Float32, bias: Float32) -> str:
        op, by_head = self._graph.operator, weight.T.reshape(WIDTH, HEADS, -1)
        constant = (self._b @ weight.T + bias).reshape(HEADS, 1, -1)
        known = op("Transpose", self._x_times(by_head), perm=[0, 2, 1])
        if not self._l:
            return op("Add", op("MatMul", shares, known), constant)
        rows = op("Div", op("Reshape", shares, _ROWS), self._l)
        met = op("MatMul", rows, op("Transpose", self._s, perm=[0, 2, 1]))
        answers = op("Transpose", self._v_times(by_head), perm=[0, 2, 1, 3])
        told = op("MatMul", op("Reshape", met, self._and_rank(0, HEADS, -1)), answers)
        seen = op("MatMul", op("Reshape", rows, _BY_HEAD), known)
        return op("Add", op("Add", seen, told), constant)

    def hear(self, shares: str, values: str, weight: Float32, bias: Float32) -> None:
        op = self._graph.operator
        v = op("Pad", values, np.array([0] * 7 + [1]), np.array(1, np.float32))  # for the last row of m
        each = np.broadcast_to((bias + self._b) / HEADS, (HEADS, 1, WIDTH))
        m = np.concatenate([weight.T.reshape(HEADS, -1, WIDTH), each], axis=1)
        s = op("Reshape", shares, _ROWS)
        if self._l:
            s = op("Concat", self._s, op("Mul", s, self._l), axis=1)
            v = op("Concat", self._v, v, axis=1)
            m = np.concatenate([self._m, m])
        self._s, self._v, self._m = s, v, m

    def normalise(self, gain: Float32, bias: Float32) -> None:
        op, of_x, over = self._graph.operator, self._image.operator, np.array([0])
        self._x = of_x("Sub", self._x, of_x("ReduceMean", self._x, over))
        self._m = self._m - self._m.mean(axis=-1, keepdims=True)
        # Eq. 2
        v = self._v_times(np.eye(WIDTH, dtype=np.float32))
        gram = op("MatMul", op("MatMul", v, op("Transpose", v, perm=[0, 2, 1])), self._s)
        twice = op("MatMul", self._v, self._x_times(2 * self._m.transpose(2, 0, 1)))
        told = op("Mul", op("Add", op("Reshape", twice, _ROWS), gram), self._s)
        of_image = self._shared(of_x("ReduceSum", of_x("Mul", self._x, self._x), over), 1, CELLS)
        square = op("Add", op("ReduceSum", told, np.array([1])), of_image)
        epsilon, mean = np.array(_EPSILON, np.float32), op("Mul", square, np.array(1 / WIDTH, np.float32))
        spared = op("Mul", op("Mul", self._l, self._l), epsilon) if self._l else epsilon
        self._l = op("Sqrt", op("Add", mean, spared))
        self._x = of_x("Mul", self._x, gain.reshape(WIDTH, 1))
        self._m = self._m * gain
        self._b = bias

    def drawn(self, matrix: Float32, bias: Float32, shown: str) -> str:
        op = self._graph.operator

        def seen(tensor: str) -> str:
            """[m, n, 4096] -> [m, s, n]."""
            grid = op("Reshape", tensor, np.array([0, -1, SIDE, SIDE]))
            cells = op("Reshape", op("Slice", grid, np.array([0, 0]), shown, np.array([2, 3])), np.array([0, 0, -1]))
            return op("Transpose", cells, perm=[0, 2, 1])

        told = op("MatMul", seen(self._s), self._v_times(matrix))
        cells = op("Add", told, seen(self._x_times(matrix.reshape(WIDTH, 1, -1))))
        return op("Add", op("Div", cells, seen(self._l)), self._b @ matrix + bias)

    def _x_times(self, matrix: Float32, constant: Float32 | None = None) -> str:
        """X W: matrix W [256, h, w] -> [h, w, 4096], plus a constant of that shape."""
        op, shape = self._image.operator, (*matrix.shape[1:], CELLS)
        product = op("Reshape", op("MatMul", matrix.reshape(WIDTH, -1).T, self._x), np.array(shape))
        return self._shared(product if constant is None else op("Add", product, constant), *shape)

    def _v_times(self, matrix: Float32) -> str:
        """V W: matrix W [256, ...] -> [m, r, ...]."""
        product = self._graph.operator("MatMul", self._v, self._m @ matrix.reshape(WIDTH, -1))
        return self._graph.operator("Reshape", product, np.array([0, -1, *matrix.shape[1:]]))

    def _shared(self, tensor: str, *shape: int) -> str:
        """A tensor of the image's network, in that of the prompts."""
        self.known[tensor] = shape
        return tensor

    def _and_rank(self, *before: int) -> str:
        """A shape of these sizes and r."""
        rank = self._graph.operator("Shape", self._s, start=1, end=2)
        return self._graph.operator("Concat", np.array(before), rank, axis=0)
