import json
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper, save

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.models.clip import Clip, prepare
from ss_flow.tasks.models.tokenizer import byte_characters

SIDE = 224


def save_model(path: Path, nodes, inputs, output, constants, size) -> FileRef:
    graph = helper.make_graph(
        nodes,
        "half",
        [helper.make_tensor_value_info(n, t, s) for n, t, s in inputs],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, ["n", size])],
        [numpy_helper.from_array(np.asarray(v), n) for n, v in constants.items()],
    )
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), path)
    return FileRef(path, path.name + str(path.stat().st_mtime_ns))


def vision_model(path: Path, output: str = "image_embeds", matrix=None) -> FileRef:
    """The mean of each colour channel, times a matrix."""
    nodes = [
        helper.make_node("ReduceMean", ["pixel_values"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("MatMul", ["mean", "matrix"], [output]),
    ]
    matrix = np.eye(3, dtype=np.float32) if matrix is None else matrix
    inputs = [("pixel_values", TensorProto.FLOAT, ["n", 3, SIDE, SIDE])]
    return save_model(path, nodes, inputs, output, {"matrix": matrix}, matrix.shape[1])


def text_model(path: Path, table, integer=TensorProto.INT64) -> FileRef:
    """The sum of a table's rows over the tokens."""
    nodes = [
        helper.make_node("Gather", ["table", "input_ids"], ["rows"]),
        helper.make_node("ReduceSum", ["rows", "axes"], ["text_embeds"], keepdims=0),
    ]
    constants = {"table": table, "axes": np.array([1], np.int64)}
    return save_model(path, nodes, [("input_ids", integer, ["n", 77])], "text_embeds", constants, table.shape[1])


@pytest.fixture
def tokenizer(tmp_path: Path) -> Path:
    tokens = [*byte_characters(), *(c + "</w>" for c in byte_characters()), "<|startoftext|>", "<|endoftext|>"]
    model = {"vocab": {t: i for i, t in enumerate(tokens)}, "merges": ["a b"]}
    (tmp_path / "tokenizer.json").write_text(json.dumps({"model": model}))
    return tmp_path / "tokenizer.json"


@pytest.fixture
def table() -> np.ndarray:
    rows = np.zeros((514, 3), np.float32)
    for channel, letter in enumerate("rgb"):
        rows[256 + ord(letter), channel] = 1
    return rows


@pytest.fixture
def clip(tmp_path: Path, tokenizer: Path, table: np.ndarray) -> Clip:
    return Clip("tiny", vision_model(tmp_path / "v.onnx"), text_model(tmp_path / "t.onnx", table), [tokenizer])


def test_texts_go_through_tokenizer_and_model_to_unit_vectors(clip: Clip):
    np.testing.assert_allclose(clip.encode_texts(["r", "G", "b b b"]), np.eye(3), atol=1e-6)
    np.testing.assert_allclose(clip.encode_texts(["r b"]), [[0.5**0.5, 0, 0.5**0.5]], atol=1e-6)


def test_pictures_go_through_preprocessing_and_model_to_unit_vectors(clip: Clip):
    image = np.full((50, 90, 3), (255, 0, 128), np.uint8)
    expected = np.array([1, 0, 128 / 255]) - [0.48145466, 0.4578275, 0.40821073]
    expected /= [0.26862954, 0.26130258, 0.27577711]
    rows = clip.encode_images([image] * 20)
    np.testing.assert_allclose(rows, np.tile(expected / np.linalg.norm(expected), (20, 1)), atol=1e-4)
    assert clip.dimension == 3


def test_nothing_in_gives_no_rows(clip: Clip):
    assert clip.encode_images([]).shape == (0, 3) and clip.encode_texts([]).shape == (0, 3)


def test_the_central_square_is_what_remains():
    image = np.zeros((SIDE, 3 * SIDE, 3), np.uint8)
    image[:, SIDE : 2 * SIDE] = 255
    pixels = prepare(image, SIDE)
    assert pixels.shape == (3, SIDE, SIDE)
    np.testing.assert_array_equal(pixels, prepare(np.full((SIDE, SIDE, 3), 255, np.uint8), SIDE))


@pytest.mark.parametrize("shape", [(100, 37), (37, 100), (1000, 600), (225, 224)])
def test_any_size_becomes_a_square_of_the_models_size(shape):
    assert prepare(np.zeros((*shape, 3), np.uint8), SIDE).shape == (3, SIDE, SIDE)


def test_shrinking_a_fine_pattern_gives_its_mean_and_no_moire():
    image = np.indices((1000, 1000)).sum(axis=0) % 2 * 255
    pixels = prepare(np.repeat(image[..., None], 3, axis=2).astype(np.uint8), SIDE)
    assert pixels.std(axis=(1, 2)).max() < 0.05


def test_models_that_take_32_bit_tokens_work(tmp_path: Path, tokenizer: Path, table: np.ndarray):
    text = text_model(tmp_path / "t32.onnx", table, TensorProto.INT32)
    clip = Clip("tiny", vision_model(tmp_path / "v.onnx"), text, [tokenizer])
    np.testing.assert_allclose(clip.encode_texts(["g"]), [[0, 1, 0]], atol=1e-6)


def test_other_common_output_names_are_taken(tmp_path: Path, tokenizer: Path, table: np.ndarray):
    vision = vision_model(tmp_path / "v2.onnx", "pooler_output")
    assert Clip("tiny", vision, text_model(tmp_path / "t.onnx", table), [tokenizer]).dimension == 3


def test_an_unknown_output_is_refused_by_name(tmp_path: Path, tokenizer: Path, table: np.ndarray):
    vision = vision_model(tmp_path / "v3.onnx", "logits")
    with pytest.raises(InputError, match=r"v3\.onnx has the outputs logits"):
        Clip("tiny", vision, text_model(tmp_path / "t.onnx", table), [tokenizer])


def test_halves_of_two_models_are_refused(tmp_path: Path, tokenizer: Path, table: np.ndarray):
    vision = vision_model(tmp_path / "v4.onnx", matrix=np.ones((3, 5), np.float32))
    with pytest.raises(InputError, match=r"5 numbers.*of 3"):
        Clip("tiny", vision, text_model(tmp_path / "t.onnx", table), [tokenizer])


def test_a_damaged_model_is_refused_by_name(tmp_path: Path, tokenizer: Path, table: np.ndarray):
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(InputError, match=r"bad\.onnx cannot be read"):
        Clip("tiny", FileRef(tmp_path / "bad.onnx", "bad"), text_model(tmp_path / "t.onnx", table), [tokenizer])


def test_masks_are_not_for_this_encoder(clip: Clip):
    with pytest.raises(ValueError, match="whole pictures"):
        clip.encode_images([np.zeros((4, 4, 3), np.uint8)], [np.ones((4, 4), bool)])
