"""ONNX networks that are written down here, from the weights that others publish without one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Float32

_OPSET, _IR_VERSION = 20, 9  # ONNX 1.15, which has GELU; read by ONNX Runtime from 1.17 on


class GraphWriter:
    """A network, operator by operator; tensors are known by their names."""

    def __init__(self, weights: Mapping[str, Float32], letter: str = "t") -> None:
        """weights: arrays by the names under which layers find them. letter: what names of tensors begin with, so that
        those of one network may be inputs of another."""
        self.weights = weights
        self._letter = letter
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def operator(self, kind: str, *inputs: str | np.ndarray, **attributes: Any) -> str:
        """Add an operator with one output, whose name is returned; an array among its inputs becomes a constant."""
        from onnx import helper

        name = f"{self._letter}{len(self._nodes)}"
        read = [tensor if isinstance(tensor, str) else self._constant(tensor) for tensor in inputs]
        self._nodes.append(helper.make_node(kind, read, [name], **attributes))
        return name

    def linear(self, tensor: str, name: str) -> str:
        """x Wᵀ + b with the weights `name`.weight [out, in] and `name`.bias [out], on the last axis."""
        product = self.operator("MatMul", tensor, np.ascontiguousarray(self.weights[f"{name}.weight"].T))
        return self.operator("Add", product, self.weights[f"{name}.bias"])

    def normalised(self, tensor: str, name: str, epsilon: float = 1e-5) -> str:
        """Layer normalisation over the last axis, with the gain `name`.weight and the bias `name`.bias."""
        gain, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        return self.operator("LayerNormalization", tensor, gain, bias, axis=-1, epsilon=epsilon)

    def finished(self, entries: Mapping[str, Sequence[int | str]], *results: str) -> bytes:
        """The network as a file's content: these inputs and outputs, all float32.

        entries: shapes by name; a word stands for a size that varies.
        """
        from onnx import TensorProto, helper

        graph = helper.make_graph(
            self._nodes,
            "network",
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in entries.items()],
            [helper.make_tensor_value_info(result, TensorProto.FLOAT, None) for result in results],
            self._constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
        return bytes(model.SerializeToString())

    def _constant(self, array: np.ndarray) -> str:
        from onnx import numpy_helper

        name = f"c{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name))
        return name


def read_state(file: FileRef) -> dict[str, Float32]:
    """The arrays of a PyTorch state dictionary by name. Raises InputError when the file holds none."""
    import torch

    try:
        state = torch.load(file.path, map_location="cpu", weights_only=True)
        return {name: tensor.numpy() for name, tensor in state.items()}
    except Exception as error:  # torch passes on those of zip files and of unpickling
        reason = type(error).__name__
        raise InputError(f"{file.path} cannot be read as PyTorch weights ({reason}); install it again.") from error
