"""Small networks with random weights and the exact signatures of real ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper, save

from ss_flow.task import FileRef
from ss_flow.tasks.models.catalogue import Model, ModelFile

VGG_LAYERS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""The numbers of VGG-16's convolutions among torchvision's layers, block by block."""
NARROW = (4, 6, 8, 10, 12)
"""Widths of its blocks, of a network that is quick."""


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


def vgg_like(widths: tuple[int, ...] = (64, 128, 256, 512, 512)) -> dict[str, Any]:
    """A state dictionary of VGG-16's convolutions as torchvision writes it, of blocks of these widths."""
    import torch

    torch.manual_seed(1)
    state, before = {}, 3
    for width, layers in zip(widths, VGG_LAYERS, strict=True):
        for layer in layers:
            state[f"features.{layer}.weight"] = torch.randn(width, before, 3, 3) * (2 / (9 * before)) ** 0.5
            state[f"features.{layer}.bias"] = torch.randn(width) * 0.1
            before = width
    return state


def lpips_in(folder: Path, features: dict[str, Any], linear: dict[str, Any]) -> Model:
    """LPIPS of these state dictionaries, written into a folder."""
    import torch

    for name, state in (("features", features), ("linear", linear)):
        torch.save(state, folder / name)
    files = tuple(ModelFile(role, FileRef(folder / role, str(folder / role))) for role in ("features", "linear"))
    return Model("lpips-vgg", "image-distance", files, (), ())


def narrow_lpips(folder: Path) -> Model:
    """LPIPS of a narrow network."""
    import torch

    linear = {f"lin{i}.model.1.weight": torch.rand(1, width, 1, 1) for i, width in enumerate(NARROW)}
    return lpips_in(folder, vgg_like(NARROW), linear)
