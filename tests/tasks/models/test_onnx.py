"""Sessions of networks."""

import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper

from ss_flow.errors import InputError
from ss_flow.running import Surroundings, running
from ss_flow.task import FileRef
from ss_flow.tasks.models import onnx as networks
from ss_flow.tasks.models.onnx import open_session, read_graph, run


@pytest.fixture
def network(tmp_path):
    """y = (x + 1) * 2; z = x - unused."""
    one = helper.make_tensor("one", TensorProto.FLOAT, [1], [1.0])
    two = helper.make_tensor("two", TensorProto.FLOAT, [1], [2.0])
    graph = helper.make_graph(
        [
            helper.make_node("Add", ["x", "one"], ["inner"]),
            helper.make_node("Mul", ["inner", "two"], ["y"]),
            helper.make_node("Sub", ["x", "unused"], ["z"]),
        ],
        "small",
        [
            helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3]),
            helper.make_tensor_value_info("unused", TensorProto.FLOAT, [1, 3]),
        ],
        [
            helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 3]),
            helper.make_tensor_value_info("z", TensorProto.FLOAT, [1, 3]),
        ],
        [one, two],
    )
    path = tmp_path / "small.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), path)
    return FileRef(path, "digest")


def test_network_gives_its_own_outputs_in_order(network):
    x = np.array([[1, 2, 3]], np.float32)
    y, z = run(open_session(network), {"x": x, "unused": x})
    np.testing.assert_array_equal(y, [[4, 6, 8]])
    np.testing.assert_array_equal(z, [[0, 0, 0]])


def test_session_is_opened_once_for_each_content(network):
    assert open_session(network) is open_session(network)
    assert open_session(network) is not open_session(FileRef(network.path, "other"))


def test_missing_input_names_both_sides(network):
    with pytest.raises(InputError, match="takes the inputs x, unused but not pixels"):
        open_session(network, inputs=("pixels",))


def test_wrong_shape_is_an_input_error(network):
    with pytest.raises(InputError, match=r"x float32\[2, 3\]"):
        run(open_session(network), {"x": np.zeros((2, 3), np.float32), "unused": np.zeros((1, 3), np.float32)})


@pytest.mark.parametrize("reader", [open_session, read_graph])
@pytest.mark.parametrize("keep", [0.5, 0.0], ids=["cut off", "text"])
def test_damaged_file_is_named(network, keep, reader):
    data = network.path.read_bytes()
    network.path.write_bytes(data[: int(len(data) * keep)] or b"<html>not found</html>")
    with pytest.raises(InputError, match=r"small\.onnx cannot be read as an ONNX network"):
        reader(FileRef(network.path, f"damaged {keep}"))


@pytest.mark.parametrize("reader", [open_session, read_graph])
def test_missing_file_is_named(tmp_path, reader):
    with pytest.raises(InputError, match=r"gone\.onnx does not exist"):
        reader(FileRef(tmp_path / "gone.onnx", "gone"))


def test_onnx_runtime_is_told_not_to_report_its_use_before_it_is_imported():
    code = "import sys, os; from ss_flow.tasks.models import onnx; assert 'onnxruntime' not in sys.modules; "
    code += "onnx.load_onnxruntime(); assert os.environ['ORT_DISABLE_TELEMETRY'] == '1'"
    subprocess.run([sys.executable, "-c", code], check=True)
    roots = [Path(networks.__file__).parents[2] / name for name in ("tasks", "flows")]
    sources = [path for root in roots for path in root.rglob("*.py")]
    found = (re.findall(r"^ +import onnxruntime", p.read_text(), re.MULTILINE) for p in sources)
    others = [p.name for p, lines in zip(sources, found, strict=True) if lines]
    assert others == ["onnx.py"]


def test_networks_share_the_memory_that_they_work_in(tmp_path):
    """Two that need 200 MB each while they run, one after the other."""
    value = lambda name, side: onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [side, side])  # noqa: E731
    nodes = [
        onnx.helper.make_node("Exp", ["x"], ["a"]),
        onnx.helper.make_node("Concat", ["a"] * 50, ["b"], axis=0),
        onnx.helper.make_node("ReduceMax", ["b"], ["y"], keepdims=1),
    ]
    graph = onnx.helper.make_graph(nodes, "large", [value("x", 1024)], [value("y", 1)])
    opset = onnx.helper.make_opsetid("", 17)
    file = tmp_path / "large.onnx"
    file.write_bytes(onnx.helper.make_model(graph, opset_imports=[opset], ir_version=9).SerializeToString())
    code = "import sys, psutil, numpy; from pathlib import Path; from ss_flow.task import FileRef; "
    code += "from ss_flow.tasks.models.onnx import open_session, run; x = numpy.zeros((1024, 1024), numpy.float32); "
    code += "sessions = [open_session(FileRef(Path(sys.argv[1]), name)) for name in 'ab']; held = []\n"
    code += "for session in sessions: run(session, {'x': x}); held.append(psutil.Process().memory_info().rss)\n"
    code += "assert held[1] - held[0] < 50e6, held"
    subprocess.run([sys.executable, "-c", code, str(file)], check=True)


@pytest.mark.parametrize(
    "said",
    [
        "[ONNXRuntimeError] : 6 : RUNTIME_EXCEPTION : Failed to allocate memory for requested buffer of size 268435456",
        "[ONNXRuntimeError] : 1 : FAIL : CUDA failure 2: out of memory ; GPU=0 ; expr=cudaMalloc",
    ],
)
def test_a_network_without_memory_is_told_as_the_host_is(said):
    def run(outputs, inputs):
        raise RuntimeError(said)

    with pytest.raises(MemoryError, match="to run a network"):
        networks.run(types.SimpleNamespace(run=run), {})


class Runtime:
    """An ONNX Runtime with the CUDA provider; whether that starts is said when it is made."""

    def __init__(self, starts: bool) -> None:
        self.starts, self.asked = starts, []

    def get_available_providers(self):
        return ["CUDAExecutionProvider", "CPUExecutionProvider"]

    def SessionOptions(self):
        return onnxruntime.SessionOptions()

    def preload_dlls(self):
        if not self.starts:
            print("Failed to load libcublasLt.so.13: no such file\nPlease follow a page to install CUDA.")

    def InferenceSession(self, source, options, providers):
        self.asked.append(providers)
        session = onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
        names = ["CPUExecutionProvider"] if not self.starts else ["CUDAExecutionProvider", "CPUExecutionProvider"]
        return types.SimpleNamespace(get_providers=lambda: names, run=session.run)


@pytest.fixture
def machine(monkeypatch):
    """Have this machine be one with or without CUDA and ONNX Runtime for it."""

    def be(*, device: bool, installed: bool, starts: bool = True, wanted: str = "") -> Runtime:
        runtime = Runtime(starts)
        monkeypatch.setattr(networks, "has_device", lambda: device)
        monkeypatch.setattr(networks, "wanted", lambda: wanted)
        monkeypatch.setattr(networks, "distributions", lambda name: ["one"] * installed)
        monkeypatch.setattr(networks, "version", lambda name: "1.31.1")
        monkeypatch.setattr(networks, "load_onnxruntime", lambda: runtime)
        networks.lacks_cuda.cache_clear()
        return runtime

    yield be
    networks.lacks_cuda.cache_clear()


def test_networks_run_on_cuda_where_it_starts_and_their_keys_say_so(machine):
    machine(device=True, installed=True)
    (name, options), fallback = networks.providers()
    assert (name, fallback) == ("CUDAExecutionProvider", "CPUExecutionProvider")
    assert options["use_tf32"] == "0"
    assert networks.network_identity()["networks"] == "CUDA, onnxruntime-gpu 1.31.1"


@pytest.mark.parametrize(
    ("here", "warned"),
    [
        ({"device": False, "installed": False}, None),
        ({"device": False, "installed": True}, None),
        ({"device": True, "installed": False}, None),
        ({"device": True, "installed": True, "wanted": "cpu"}, None),
        (
            {"device": True, "installed": True, "starts": False},
            "the CUDA provider of onnxruntime-gpu does not start here (Failed to load libcublasLt.so.13: no such file)",
        ),
        ({"device": True, "installed": False, "wanted": "cuda"}, "onnxruntime-gpu is not installed"),
        ({"device": False, "installed": True, "wanted": "cuda"}, "there is no CUDA device with a driver"),
    ],
)
def test_networks_run_on_the_cpu_elsewhere_and_say_why_where_cuda_was_asked_for(machine, here, warned):
    machine(**here)
    heard = []
    with running(Surroundings(warned=heard)):
        assert networks.providers() == ["CPUExecutionProvider"]
    assert networks.network_identity().keys() == {"instruction set"}
    if warned is None:
        assert heard == []
    else:
        (sentence,) = heard
        assert sentence.startswith("Networks run on the CPU: ") and warned in sentence and sentence.endswith(".")
