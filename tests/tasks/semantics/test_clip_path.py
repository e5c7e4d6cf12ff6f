"""CLIP's whole way, from photos to an answer, with networks of the exact signature and random weights."""

from __future__ import annotations

import json
from pathlib import Path

import box_scene
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper, save
from view_masks import as_fields

from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import FOUND, Descriptors, InstanceMasks
from ss_flow.tasks.models.catalogue import Model, ModelFile
from ss_flow.tasks.models.tokenizer import byte_characters
from ss_flow.tasks.semantics.describe import DescribeParams, describe
from ss_flow.tasks.semantics.name import name
from ss_flow.tasks.semantics.query import QueryParams, query

DIMENSION, PATCH = 512, 32


def half(path: Path, nodes, entry, output: str, constants: dict[str, np.ndarray]) -> FileRef:
    graph = helper.make_graph(
        [helper.make_node(*node[:3], **node[3]) for node in nodes],
        "half",
        [helper.make_tensor_value_info(*entry)],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, ["n", DIMENSION])],
        [numpy_helper.from_array(value, called) for called, value in constants.items()],
    )
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), path)
    return FileRef(path, path.name)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Model:
    """Patches, a nonlinearity, their mean, a projection; embedded tokens, their mean, a projection."""
    folder, rng = tmp_path_factory.mktemp("clip"), np.random.default_rng(0)

    def random(*shape: int) -> np.ndarray:
        return (rng.normal(size=shape) / np.sqrt(np.prod(shape[1:]))).astype(np.float32)

    vision = half(
        folder / "vision.onnx",
        [
            ("Conv", ["pixel_values", "patches"], ["seen"], {"strides": [PATCH, PATCH]}),
            ("Tanh", ["seen"], ["bent"], {}),
            ("ReduceMean", ["bent"], ["mean"], {"axes": [2, 3], "keepdims": 0}),
            ("MatMul", ["mean", "out"], ["image_embeds"], {}),
        ],
        ("pixel_values", TensorProto.FLOAT, ["n", 3, 224, 224]),
        "image_embeds",
        {"patches": 8 * random(64, 3, PATCH, PATCH), "out": random(64, DIMENSION)},
    )
    text = half(
        folder / "text.onnx",
        [
            ("Gather", ["table", "input_ids"], ["rows"], {}),
            ("ReduceMean", ["rows"], ["mean"], {"axes": [1], "keepdims": 0}),
            ("MatMul", ["mean", "out"], ["text_embeds"], {}),
        ],
        ("input_ids", TensorProto.INT64, ["n", 77]),
        "text_embeds",
        {"table": random(514, 64), "out": random(64, DIMENSION)},
    )
    tokens = [*byte_characters(), *(c + "</w>" for c in byte_characters()), "<|startoftext|>", "<|endoftext|>"]
    (folder / "tokenizer.json").write_text(
        json.dumps({"model": {"vocab": {t: i for i, t in enumerate(tokens)}, "merges": ["a b"]}})
    )
    files = (
        ModelFile("vision", vision),
        ModelFile("text", text),
        ModelFile("tokenizer", FileRef(folder / "tokenizer.json", "tokenizer")),
    )
    return Model("random-clip", "text-image", files, (), ())


@pytest.fixture(scope="module")
def described(model: Model) -> tuple[Descriptors, ...]:
    """The boxes of the scene, by their true masks."""
    ids = np.stack([box_scene.cast(view)[1] for view in range(box_scene.VIEWS)])
    return tuple(
        describe(box_scene.frames(), instance(ids == i, i), encoder=model, params=DescribeParams()) for i in (1, 2, 3)
    )


def instance(masks: np.ndarray, number: int) -> InstanceMasks:
    return InstanceMasks(
        instance_id=number,
        points=np.zeros((0, 3), np.float32),
        colors=np.zeros((0, 3), np.uint8),
        point_confidence=np.zeros(0, np.float32),
        point_part=np.zeros(0, np.int32),
        confidence=1.0,
        views=tuple(f"{k}" for k in range(len(masks))),
        **as_fields(masks),
        origin=np.full(len(masks), FOUND, np.uint8),
        weak=False,
    )


def test_every_object_gets_a_unit_vector_of_the_networks_length(described):
    for found in described:
        assert found.embedding.shape == (DIMENSION,) and found.encoder == "random-clip"
        assert np.linalg.norm(found.embedding) == pytest.approx(1, abs=1e-5)
        assert len(found.views) == box_scene.VIEWS
    cosines = [abs(float(a.embedding @ b.embedding)) for a in described for b in described if a is not b]
    assert max(cosines) < 0.999  # red, green and blue boxes do not look alike


def test_the_answer_is_the_cosine_of_descriptor_and_text(described, model):
    from ss_flow.tasks.semantics.encoders import encoder_of

    found = query(described, text="a red box", encoder=model, params=QueryParams(tau_corr=2.0, min_relevancy=0.0))
    word = encoder_of(model).encode_texts(["a red box"])[0]
    expected = {d.instance_id: float(d.embedding @ word) for d in described}
    assert found.instance_id.tolist() == sorted(expected, key=expected.__getitem__, reverse=True)
    np.testing.assert_allclose(found.score, sorted(expected.values(), reverse=True), atol=1e-6)
    best = query(described, text="a red box", encoder=model, params=QueryParams(select="topk", min_relevancy=0.0))
    assert best.matches() == found.instance_id[:1].tolist()


def test_terms_that_are_not_meant_are_read_by_the_network_too(described, model):
    everything = QueryParams(tau_corr=2.0, min_relevancy=0.0)
    plain = query(described, text="a red box", encoder=model, params=everything)
    against = query(described, text="a red box, not a red box", encoder=model, params=everything)
    np.testing.assert_allclose(against.score, plain.score, atol=1e-6)
    assert (against.relevancy <= 0.5 + 1e-6).all()  # a text fits no better than itself


def test_objects_are_named_from_a_vocabulary(described, model):
    names = name(described, encoder=model, vocabulary=("box", "mug", "lamp"))
    assert names.encoder == "random-clip" and set(names.names) <= {"box", "mug", "lamp"}
