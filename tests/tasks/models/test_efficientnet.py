"""The classifier: its blocks against torch's own convolutions, its answer to a photo that everybody has."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.models import efficientnet
from ss_flow.tasks.models.catalogue import find
from ss_flow.tasks.models.class_names import read_classes
from ss_flow.tasks.models.onnx import open_written, run
from ss_flow.tasks.models.onnx_graph import GraphWriter


def block_weights(channels: int, wide: int, kernel: int) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(kernel)
    shapes = {"_expand_conv": (wide, channels, 1, 1), "_depthwise_conv": (wide, 1, kernel, kernel)}
    shapes |= {"_project_conv": (channels, wide, 1, 1)}
    weights = {f"b.{name}.weight": generator.normal(0, 0.4, shape) for name, shape in shapes.items()}
    for norm, size in (("_bn0", wide), ("_bn1", wide), ("_bn2", channels)):
        weights[f"b.{norm}.weight"] = generator.normal(1, 0.2, size)
        weights[f"b.{norm}.bias"] = generator.normal(0, 0.2, size)
        weights[f"b.{norm}.running_mean"] = generator.normal(0, 0.2, size)
        weights[f"b.{norm}.running_var"] = generator.uniform(0.5, 2, size)
    return {name: array.astype(np.float32) for name, array in weights.items()}


def reference_block(weights: dict[str, np.ndarray], pixels: np.ndarray, kernel: int, stride: int) -> np.ndarray:
    import torch
    from torch.nn import functional

    def normed(rows: torch.Tensor, name: str) -> torch.Tensor:
        mean, var, gain, bias = (
            torch.tensor(weights[f"b.{name}.{part}"]) for part in ("running_mean", "running_var", "weight", "bias")
        )
        return functional.batch_norm(rows, mean, var, gain, bias, eps=1e-3)

    def kernel_of(name: str) -> torch.Tensor:
        return torch.tensor(weights[f"b.{name}.weight"])

    rows = torch.tensor(pixels)
    inner = functional.relu6(normed(functional.conv2d(rows, kernel_of("_expand_conv")), "_bn0"))
    # TensorFlow's "same": as much padding as the outputs need, the odd pixel below and at the right.
    size = pixels.shape[-1]
    missing = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    inner = functional.pad(inner, (missing // 2, missing - missing // 2) * 2)
    inner = functional.conv2d(inner, kernel_of("_depthwise_conv"), stride=stride, groups=inner.shape[1])
    inner = functional.relu6(normed(inner, "_bn1"))
    inner = normed(functional.conv2d(inner, kernel_of("_project_conv")), "_bn2")
    return (inner + rows if stride == 1 else inner).numpy()


@pytest.mark.parametrize(("kernel", "stride", "size"), [(3, 1, 8), (5, 1, 9), (3, 2, 10), (5, 2, 9), (5, 2, 10)])
def test_a_block_is_what_torch_makes_of_its_formula(kernel, stride, size):
    weights = block_weights(4, 12, kernel)
    pixels = np.random.default_rng(1).normal(0, 1, (2, 4, size, size)).astype(np.float32)
    graph = GraphWriter(weights)
    result = efficientnet._block(graph, "pixels", "b.", stride)
    network = graph.finished({"pixels": ("n", 4, size, size)}, result)
    session = open_written(FileRef("block", "block"), lambda: network)
    expected = reference_block(weights, pixels, kernel, stride)
    np.testing.assert_allclose(run(session, {"pixels": pixels})[0], expected, atol=1e-5)


def test_what_holds_no_weights_is_refused(tmp_path):
    (tmp_path / "weights.pth").write_bytes(b"no weights")
    with pytest.raises(InputError, match="cannot be read as PyTorch weights"):
        efficientnet.EfficientNetLite2(FileRef(tmp_path / "weights.pth", "bad"))


def test_weights_of_another_network_are_refused(tmp_path):
    import torch

    torch.save({"fc.weight": torch.zeros(2, 2)}, tmp_path / "weights.pth")
    with pytest.raises(InputError, match=r"_conv_stem\.weight"):
        efficientnet.EfficientNetLite2(FileRef(tmp_path / "weights.pth", "other"))


@pytest.mark.skipif(find("imagenet-class-names") is None, reason="needs the extra `names`")
def test_a_portrait_in_uniform_is_a_military_uniform():
    """The answer that TensorFlow's own example has for this photo."""
    import cv2
    from matplotlib import cbook

    model = find("imagenet-class-names")
    photo = cv2.imread(str(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))[..., ::-1]
    shares = efficientnet.EfficientNetLite2(model.file("classifier")).probabilities([photo])
    assert shares.shape == (1, 1000) and shares.sum() == pytest.approx(1, abs=1e-4)
    assert read_classes(model.file("classes"))[int(shares[0].argmax())] == "military uniform"
