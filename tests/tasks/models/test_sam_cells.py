"""The factored cells against the plain ones, in a network of two layers with weights of chance."""

import numpy as np
import pytest

from ss_flow.tasks.models.onnx import load_onnxruntime
from ss_flow.tasks.models.onnx_graph import GraphWriter
from ss_flow.tasks.models.sam_cells import CELLS, FEATURES, HEADS, SIDE, WIDTH, FactoredCells, PlainCells

TOKENS, HEAD, PROMPTS = 5, 16, 3
SHOWN = 48, 64
"""Rows and columns of cells."""


def layer(rng: np.random.Generator, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    weight = rng.normal(0, columns**-0.5, (rows, columns)).astype(np.float32)
    return weight, rng.normal(0, 0.3, rows).astype(np.float32)


def opened(network: bytes):
    return load_onnxruntime().InferenceSession(network, providers=["CPUExecutionProvider"])


def answers(factored: bool, features: np.ndarray, heads: np.ndarray) -> list[np.ndarray]:
    """What tokens see after each of two layers, and the cells that are shown in the end, projected."""
    rng = np.random.default_rng(7)
    places = rng.normal(size=(CELLS, WIDTH)).astype(np.float32)
    no_mask = rng.normal(size=WIDTH).astype(np.float32)
    graph, image = GraphWriter({}), GraphWriter({}, "x")
    cells = FactoredCells(graph, image, places, no_mask) if factored else PlainCells(graph, places, no_mask)
    seen = []
    for _ in range(2):
        scores = cells.compared("heads", *layer(rng, HEADS * HEAD, WIDTH))
        exponents = graph.operator("Exp", scores)
        shares = graph.operator("Div", exponents, graph.operator("ReduceSum", exponents, np.array([2])))
        cells.hear(shares, "heads", *layer(rng, WIDTH, HEADS * HEAD))
        cells.normalise(*(rng.normal(1, 0.3, WIDTH).astype(np.float32) for _ in range(2)))
        scores = cells.compared("heads", *layer(rng, HEADS * HEAD, WIDTH))
        shares = graph.operator("Softmax", scores)
        seen.append(cells.mean(shares, *layer(rng, HEADS * HEAD, WIDTH)))
    matrix, bias = layer(rng, WIDTH, 24)[0], layer(rng, 24, 1)[1]
    shown = graph.operator("Cast", "shown", to=7)
    seen.append(cells.drawn(matrix, bias, shown))
    entries = {"heads": ("m", HEADS, "t", HEAD), "shown": (2,), **cells.known}
    known = {"features": features}
    if factored:
        known = dict(zip(cells.known, opened(image.finished(FEATURES, *cells.known)).run(None, known), strict=True))
    given = {"heads": heads, "shown": np.array(SHOWN, np.float32), **known}
    return opened(graph.finished(entries, *seen)).run(None, given)


@pytest.fixture(scope="module")
def both() -> list[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(WIDTH, CELLS)).astype(np.float32)
    heads = (0.5 * rng.normal(size=(PROMPTS, HEADS, TOKENS, HEAD))).astype(np.float32)
    plain, factored = (answers(kind, features, heads) for kind in (False, True))
    return list(zip(plain, factored, strict=True))


def test_tokens_see_the_same_in_factored_cells(both):
    for plain, factored in both[:2]:
        assert plain.shape == (PROMPTS, HEADS, TOKENS, HEAD)
        np.testing.assert_allclose(factored, plain, atol=2e-5)
    assert np.abs(both[0][0] - both[1][0]).max() > 0.1, "the second layer changes something"


def test_the_same_cells_are_drawn(both):
    plain, factored = both[2]
    assert plain.shape == (PROMPTS, SHOWN[0] * SHOWN[1], 24) and SHOWN[0] < SIDE
    np.testing.assert_allclose(factored, plain, atol=2e-4)
    assert np.abs(plain[0] - plain[1]).max() > 0.1, "prompts differ"
