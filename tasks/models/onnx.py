"""Networks in ONNX form: sessions that are opened once."""

from __future__ import annotations

import functools
import io
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from importlib.metadata import distributions, version
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import warn
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Float32, UInt8
from ss_flow.tasks.device import VARIABLE, has_device, wanted
from ss_flow.tasks.processor import on_this_processor, widest_instruction_set

if TYPE_CHECKING:
    import onnx
    import onnxruntime


_CPU, _CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
_CUDA_OPTIONS = {"arena_extend_strategy": "kSameAsRequested", "cudnn_conv_algo_search": "HEURISTIC", "use_tf32": "0"}
"""Others share the device, and the algorithm must not be what happened to be fastest this time."""
_AS_ASKED = 1
"""kSameAsRequested, as above, for the CPU."""
_ONE_AT_A_TIME = threading.Lock()
_SLOW_FUSIONS = ("SkipLayerNormFusion", "BiasGeluFusion")
"""What ONNX Runtime puts in the place of two operators and, on a CPU, computes without vector instructions."""
_NO_MEMORY = ("Failed to allocate memory", "out of memory", "bad_alloc", "bad allocation")
"""What ONNX Runtime says where there is none, on CUDA or a CPU; all its errors are of one kind."""
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)


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
    missing = _load_cuda(runtime)
    quiet = runtime.SessionOptions()
    quiet.log_severity_level = 4
    tried = runtime.InferenceSession(_one_node(), quiet, providers=[(_CUDA, _CUDA_OPTIONS), _CPU])
    if _CUDA in tried.get_providers():
        return None
    return f"the CUDA provider of {_GPU_BUILD} does not start here" + (f" ({missing})" if missing else "")


def _load_cuda(runtime: ModuleType) -> str:
    """Load CUDA's libraries from the packages that pip installs, where the loader does not look; gives what ONNX
    Runtime says of one that is missing."""
    if not hasattr(runtime, "preload_dlls"):  # before 1.21
        return ""
    with redirect_stdout(io.StringIO()) as said:
        runtime.preload_dlls()
    return next(iter(said.getvalue().splitlines()), "")


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


def open_session(file: FileRef, *, inputs: tuple[str, ...] = ()) -> onnxruntime.InferenceSession:
    """The session of a network, one a process for each file content; on CUDA where it can be.

    file: an ONNX file. inputs: names that the network has to take.
    Raises InputError when the file is missing, is damaged, is no ONNX graph, or lacks one of the names.
    """
    providers()  # warns, also where the session is open already
    session = _open(str(file.path), file.digest)
    taken = [node.name for node in session.get_inputs()]
    missing = [name for name in inputs if name not in taken]
    if missing:
        raise InputError(
            f"{file.path} takes the inputs {', '.join(taken)} but not {', '.join(missing)}: "
            "it is another network than the catalogue describes."
        )
    return session


def open_written(weights: FileRef, write: Callable[[], bytes]) -> onnxruntime.InferenceSession:
    """The session of a network that is written down from a file of weights; one a caller.

    write: gives the network as an ONNX file's content.
    Raises InputError when the file lacks a weight that the network has.
    """
    with all_weights_of(weights):
        return _session(write(), str(weights.path), _SLOW_FUSIONS)


@contextmanager
def all_weights_of(file: FileRef) -> Iterator[None]:
    """Says of a KeyError inside, a weight that is missing, which file lacks it: an InputError."""
    try:
        yield
    except KeyError as error:
        raise InputError(
            f"{file.path} has no weights {error}: it is another network than the catalogue describes."
        ) from error


@functools.lru_cache(maxsize=8)
def _open(path: str, digest: str) -> onnxruntime.InferenceSession:
    _assert_file(Path(path))
    return _session(path, path)


def _session(source: str | bytes, path: str, but: tuple[str, ...] = ()) -> onnxruntime.InferenceSession:
    """source: a file, or its content. path: what to call it. but: ONNX Runtime's rewritings that are left out."""
    onnxruntime = load_onnxruntime()
    options = onnxruntime.SessionOptions()
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    options.add_session_config_entry("session.use_env_allocators", "1")
    with _ONE_AT_A_TIME:
        _share_arena()
    try:
        return onnxruntime.InferenceSession(source, options, providers=providers(), disabled_optimizers=list(but))
    except Exception as error:  # onnxruntime has a class for every cause, with no common base
        raise _unreadable(path, error) from error


@functools.cache
def _share_arena() -> None:
    """Have all networks of this process work in the same memory on the CPU.

    ONNX Runtime gives none of it back while a network is open. Each would keep what it needed at its largest, those of
    a segmenter more than 1 GB together, and by default asks for twice as much as before whenever it needs more.
    """
    runtime = load_onnxruntime()
    memory = runtime.OrtMemoryInfo("Cpu", runtime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, runtime.OrtMemType.DEFAULT)
    runtime.create_and_register_allocator(memory, runtime.OrtArenaCfg({"arena_extend_strategy": _AS_ASKED}))


def read_graph(file: FileRef) -> tuple[Sequence[onnx.NodeProto], dict[str, Float32]]:
    """The nodes of an ONNX file, and its constant arrays by name. Raises InputError when the file is missing or holds
    no network."""
    import onnx

    _assert_file(file.path)
    try:
        graph = onnx.load(str(file.path)).graph
    except Exception as error:  # protobuf's own exceptions, which depend on its backend
        raise _unreadable(str(file.path), error) from error
    return graph.node, {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}


def _assert_file(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path} does not exist; it should be an ONNX network.")


def _unreadable(path: str, error: Exception) -> InputError:
    return InputError(f"{path} cannot be read as an ONNX network ({_first_line(error)}); fetch it again.")


def imagenet_input(image: UInt8) -> Float32:
    """[1, 3, h, w] a picture [h, w, 3] RGB as networks take it that were trained on ImageNet's."""
    return np.ascontiguousarray(((image.astype(np.float32) / 255 - _MEAN) / _DEVIATION).transpose(2, 0, 1)[None])


def run(session: onnxruntime.InferenceSession, inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """All outputs of a network, in its own order.

    Raises InputError when the network refuses the arrays' names, types or shapes, MemoryError.
    """
    try:
        return list(session.run(None, dict(inputs)))
    except Exception as error:
        if any(words in str(error) for words in _NO_MEMORY):
            raise MemoryError("not enough memory to run a network") from error
        shapes = ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in inputs.items())
        raise InputError(
            f"the network refuses the inputs {shapes} ({_first_line(error)}); "
            "its file is not the one that the catalogue describes."
        ) from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__).strip()
