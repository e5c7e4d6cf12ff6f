from pathlib import Path

import numpy as np
import pytest
from generated_views import views

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture.mono import MonoParams, mono


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> FileRef:
    """A network whose "inverse depth" is the mean of the normalised channels, so that tests can say what it sees."""
    import onnx
    from onnx import TensorProto, helper

    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])
    out = helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, "h", "w"])
    axes = helper.make_tensor("axes", TensorProto.INT64, [1], [1])
    node = helper.make_node("ReduceMean", ["image", "axes"], ["depth"], keepdims=1)
    graph = helper.make_graph([node], "tiny", [image], [out], [axes])
    path = tmp_path_factory.mktemp("model") / "tiny.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)
    return FileRef(path, "0")


@pytest.fixture(scope="module")
def scene(model):
    """One gray frame whose brightness is an increasing function of inverse depth: what the network sees is right."""
    from dataclasses import replace

    from ss_flow.tasks.geometry.images import encode_png

    frames, cameras, depth = views([(0, 0, 0)], width=140, height=112)
    level = np.round(600 / depth[0]).astype(np.uint8)
    frame = replace(frames[0], encoded=encode_png(np.repeat(level[..., None], 3, axis=2)))
    return frame, cameras, depth[0].astype(np.float32)


def share_off(found: DepthMap, true: np.ndarray) -> float:
    known = found.depth > 0
    assert known.mean() > 0.99
    return float(np.median(np.abs(found.depth - true)[known] / true[known]))


@pytest.mark.parametrize("unit", [0.3, 1.0, 3.0])
def test_scale_and_shift_come_from_sensor_depth_within_a_percent(model, scene, unit):
    frame, cameras, depth = scene
    sensor = np.where(np.random.default_rng(0).random(depth.shape) < 0.3, depth * unit, 0).astype(np.float32)
    sensor[:20] *= 1.5
    params = MonoParams(input_side=140)
    found = mono(frame, cameras, (DepthMap(frame.name, sensor, "sensor"),), model=model, params=params)
    assert found.source == "mono"
    assert found.depth.shape == (112, 140)
    assert share_off(found, depth * unit) < 0.01


def test_scale_and_shift_come_from_sparse_points_without_sensor_depth(model, scene):
    from dataclasses import replace

    from ss_flow.tasks.geometry.cameras import backproject, camera_of

    frame, cameras, depth = scene
    points = backproject(depth, camera_of(cameras, 0))[::97].astype(np.float32)
    found = mono(frame, replace(cameras, sparse_points=points), (), model=model, params=MonoParams(input_side=140))
    assert share_off(found, depth) < 0.01


def test_sides_of_the_input_are_multiples_of_a_patch(model, scene):
    frame, cameras, depth = scene
    known = (DepthMap(frame.name, depth, "sensor"),)
    assert mono(frame, cameras, known, model=model, params=MonoParams(input_side=100)).depth.shape == (84, 98)


def test_too_little_known_depth_is_refused(model, scene):
    frame, cameras, _ = scene
    with pytest.raises(InputError, match=f"monocular depth of {frame.name} cannot be fitted to 0 known depths"):
        mono(frame, cameras, (), model=model)


def test_depth_that_nothing_agrees_with_is_refused(model, scene):
    frame, cameras, depth = scene
    random = DepthMap(frame.name, np.exp(np.random.default_rng(0).uniform(-3, 3, depth.shape)).astype(np.float32), "s")
    with pytest.raises(InputError, match="best fit meets"):
        mono(frame, cameras, (random,), model=model, params=MonoParams(input_side=140))


def test_a_file_that_is_no_model_is_refused_by_name(scene, tmp_path: Path):
    frame, cameras, _ = scene
    (tmp_path / "broken.onnx").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"broken\.onnx cannot be read as an ONNX network") as refusal:
        mono(frame, cameras, (), model=FileRef(tmp_path / "broken.onnx", "0"))
    assert "\n" not in str(refusal.value)
