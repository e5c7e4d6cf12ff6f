"""Networks in ONNX form: sessions that are opened once, and graphs cut at an inner tensor."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping
from importlib.metadata import distributions, version
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import warn
from ss_flow.task import FileRef
from ss_flow.tasks.device import VARIABLE, has_device, wanted
from ss_flow.tasks.processor import on_this_processor, widest_instruction_set

if TYPE_CHECKING:
    import onnx
    import onnxruntime


_CPU, _CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
_CUDA_OPTIONS = {"arena_extend_strategy": "kSameAsRequested", "cudnn_conv_algo_search": "HEURISTIC", "use_tf32": "0"}
"""Others share the device, and the algorithm must not be what happened to be fastest this time."""


def network_identity() -> dict[str, str]:
    """What the outputs of a network depend on besides the network, its inputs and ONNX Runtime: the instruction set,
    and whether CUDA runs it.

    ONNX Runtime picks its kernels by the widest one, and sums in another order in each. For the `environment` of tasks.
    """
    here = {"instruction set": on_this_processor(widest_instruction_set())}
    return here if lacks_cuda() is not None else {**here, "networks": f"CUDA, {_GPU_BUILD} {version(_GPU_BUILD)}"}


_GPU_BUILD = "onnxruntime-gpu"
"""The distribution of ONNX Runtime that has the CUDA provider."""


@functools.cache
def lacks_cuda() -> str | None:
    """Why networks run on the CPU, None where they run on CUDA.

    Whether the provider starts is tried out, on one node: ONNX Runtime itself goes back to the CPU without a word.
    """
    if wanted() == "cpu":
        return f"{VARIABLE} says so"
    if not any(distributions(name=_GPU_BUILD)):
        return f"{_GPU_BUILD} is not installed in the place of onnxruntime"
    if not has_device():
        return "there is no CUDA device with a driver"
    runtime = load_onnxruntime()
    if _CUDA not in runtime.get_available_providers():
        return f"{_GPU_BUILD} is installed, but another onnxruntime hides it"
    quiet = runtime.SessionOptions()
    quiet.log_severity_level = 4
    tried = runtime.InferenceSession(_one_node(), quiet, providers=[(_CUDA, _CUDA_OPTIONS), _CPU])
    return None if _CUDA in tried.get_providers() else f"the CUDA provider of {_GPU_BUILD} does not start here"


def providers() -> list[Any]:
    """What runs networks, in the order of preference, as ONNX Runtime takes it; warns where CUDA was asked for, by
    `SS_FLOW_DEVICE` or by installing ONNX Runtime for it, and is not to be had."""
    reason = lacks_cuda()
    if reason is None:
        return [(_CUDA, _CUDA_OPTIONS), _CPU]
    if wanted() == "cuda" or (wanted() == "" and has_device() and any(distributions(name=_GPU_BUILD))):
        warn(f"Networks run on the CPU: {reason}.")
    return [_CPU]


def _one_node() -> bytes:
    import onnx

    value, result = (onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, [1]) for n in ("x", "y"))
    graph = onnx.helper.make_graph([onnx.helper.make_node("Identity", ["x"], ["y"])], "one", [value], [result])
    opset = onnx.helper.make_opsetid("", 17)
    return bytes(onnx.helper.make_model(graph, opset_imports=[opset], ir_version=9).SerializeToString())


def load_onnxruntime() -> ModuleType:
    """The `onnxruntime` module, which from version 1.31 on reports its use unless told not to before its import."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    return cast(ModuleType, onnxruntime)


def open_session(
    file: FileRef,
    *,
    threads: int = 1,
    outputs: tuple[str, ...] = (),
    batched: tuple[str, ...] = (),
    wires: tuple[tuple[str, str, str], ...] = (),
    inputs: tuple[str, ...] = (),
) -> onnxruntime.InferenceSession:
    """The session of a network, one a process for each file content, thread count and cut; on CUDA where it can be.

    file: an ONNX file. threads: cores that one run may use; nodes run one after the other in a fixed order, so the
    count does not change what a node is given. outputs, batched, wires: how to cut the graph (see `expose`); no outputs
    keeps the graph as it is. inputs: names that the network has to take.
    Raises InputError when the file is missing, is damaged, is no ONNX graph, or lacks one of the names.
    """
    providers()  # warns, also where the session is open already
    session = _open(str(file.path), file.digest, threads, outputs, batched, wires)
    taken = [node.name for node in session.get_inputs()]
    missing = [name for name in inputs if name not in taken]
    if missing:
        raise InputError(
            f"{file.path} takes the inputs {', '.join(taken)} but not {', '.join(missing)}: "
            "it is another network than the catalogue describes."
        )
    return session


def open_written(weights: FileRef, write: Callable[[], bytes], *, threads: int = 1) -> onnxruntime.InferenceSession:
    """The session of a network that is written down from a file of weights; one a caller.

    write: gives the network as an ONNX file's content. threads: as for `open_session`.
    Raises InputError when the file lacks a weight that the network has.
    """
    try:
        return _session(write(), str(weights.path), threads)
    except KeyError as error:
        raise InputError(
            f"{weights.path} has no weights {error}: it is another network than the catalogue describes."
        ) from error


@functools.lru_cache(maxsize=8)
def _open(
    path: str,
    digest: str,
    threads: int,
    outputs: tuple[str, ...],
    batched: tuple[str, ...],
    wires: tuple[tuple[str, str, str], ...],
) -> onnxruntime.InferenceSession:
    if not Path(path).is_file():
        raise InputError(f"{path} does not exist; it should be an ONNX network.")
    return _session(expose(Path(path), outputs, batched, wires) if outputs else path, path, threads)


def _session(source: str | bytes, path: str, threads: int) -> onnxruntime.InferenceSession:
    """source: a file, or its content. path: what to call it."""
    onnxruntime = load_onnxruntime()
    options = onnxruntime.SessionOptions()
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(source, options, providers=providers())
    except Exception as error:  # onnxruntime has a class for every cause, with no common base
        raise InputError(f"{path} cannot be read as an ONNX network ({_first_line(error)}); fetch it again.") from error


def run(session: onnxruntime.InferenceSession, inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """All outputs of a network, in its own order.

    Raises InputError when the network refuses the arrays' names, types or shapes.
    """
    try:
        return list(session.run(None, dict(inputs)))
    except Exception as error:
        shapes = ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in inputs.items())
        raise InputError(
            f"the network refuses the inputs {shapes} ({_first_line(error)}); "
            "its file is not the one that the catalogue describes."
        ) from error


def expose(
    path: Path,
    outputs: tuple[str, ...],
    batched: tuple[str, ...] = (),
    wires: tuple[tuple[str, str, str], ...] = (),
) -> bytes:
    """An ONNX graph cut so that inner tensors become its outputs, in memory; nothing is written.

    path: the file. outputs: names of the float32 tensors wanted, in this order; nodes and inputs that they do not need
    are dropped. batched: inputs whose first size, fixed by the export, is set free. wires: (node, tensor,
    other): the node reads the other tensor instead.
    Raises InputError when the file is damaged or has no such tensor or wire.
    """
    import onnx

    try:
        model = onnx.load(str(path))
    except Exception as error:  # protobuf's own exceptions, which depend on its backend
        raise InputError(f"{path} cannot be read as an ONNX network ({_first_line(error)}); fetch it again.") from error
    graph = model.graph
    for name, old, new in wires:
        readers = [node for node in graph.node if node.name == name and old in node.input]
        if not readers:
            raise InputError(
                f"{path} has no node {name} that reads {old}: it is another network than the catalogue describes."
            )
        for node in readers:
            node.input[list(node.input).index(old)] = new
    produced = {name for node in graph.node for name in node.output}
    missing = [name for name in outputs if name not in produced]
    if missing:
        raise InputError(
            f"{path} has no tensor {', '.join(missing)}: it is another network than the catalogue describes."
        )

    needed = set(outputs)
    kept: list[onnx.NodeProto] = []
    for node in reversed(graph.node):
        if needed.intersection(node.output):
            kept.append(node)
            needed.update(_names_read(node))
    kept.reverse()
    inputs = [entry for entry in graph.input if entry.name in needed]
    for entry in inputs:
        if entry.name in batched:
            entry.type.tensor_type.shape.dim[0].dim_param = "batch"
    cut = onnx.helper.make_graph(
        kept,
        graph.name,
        inputs,
        [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None) for name in outputs],
        [tensor for tensor in graph.initializer if tensor.name in needed],
    )
    result: Any = onnx.helper.make_model(cut, opset_imports=model.opset_import, ir_version=model.ir_version)
    return bytes(result.SerializeToString())


def _names_read(node: onnx.NodeProto) -> set[str]:
    names = set(node.input)
    for attribute in node.attribute:
        for graph in (attribute.g, *attribute.graphs):
            for inner in graph.node:
                names |= _names_read(inner)
            names.update(entry.name for entry in graph.output)
    return names - {""}


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__).strip()
