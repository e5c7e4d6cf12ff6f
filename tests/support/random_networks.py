"""Small networks with random weights and the exact signatures of real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper, save


def dino_like(file: Path, length: int) -> Path:
    """Write a network of DINOv2's signature: patches of 14 x 14 pixels are projected, a first token stands before."""
    generator = np.random.default_rng(2)
    weights = {
        "kernel": generator.normal(0, 1, (length, 3, 14, 14)).astype(np.float32),
        "first": generator.normal(0, 1, (1, 1, length)).astype(np.float32),
        "rows": np.array([0, length, -1], np.int64),
    }
    nodes = [
        helper.make_node("Conv", ["pixel_values", "kernel"], ["map"], strides=[14, 14]),
        helper.make_node("Reshape", ["map", "rows"], ["flat"]),
        helper.make_node("Transpose", ["flat"], ["patches"], perm=[0, 2, 1]),
        helper.make_node("Concat", ["first", "patches"], ["last_hidden_state"], axis=1),
    ]
    graph = helper.make_graph(
        nodes,
        "dino",
        [helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, ["n", 3, "h", "w"])],
        [helper.make_tensor_value_info("last_hidden_state", TensorProto.FLOAT, ["n", "t", length])],
        [numpy_helper.from_array(array, name) for name, array in weights.items()],
    )
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), file)
    return file
