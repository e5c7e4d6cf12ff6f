"""The sentence encoder, against torch's own transformer and against what its publisher's library gives."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.models import sentences
from ss_flow.tasks.models.catalogue import find
from ss_flow.tasks.models.onnx import open_written, run

WIDTH, LAYERS, WIDE = 24, 2, 40


@pytest.fixture(scope="module")
def weights() -> dict[str, np.ndarray]:
    """Random weights of a small network, by the names that published ones have."""
    generator = np.random.default_rng(3)
    shapes = {"embeddings.LayerNorm": (WIDTH,)}
    for number in range(LAYERS):
        layer = f"encoder.layer.{number}"
        shapes |= {f"{layer}.attention.self.{kind}": (WIDTH, WIDTH) for kind in ("query", "key", "value")}
        shapes |= {
            f"{layer}.attention.output.dense": (WIDTH, WIDTH),
            f"{layer}.attention.output.LayerNorm": (WIDTH,),
            f"{layer}.intermediate.dense": (WIDE, WIDTH),
            f"{layer}.output.dense": (WIDTH, WIDE),
            f"{layer}.output.LayerNorm": (WIDTH,),
        }
    tensors = {}
    for name, shape in shapes.items():
        tensors[f"{name}.weight"] = generator.normal(0, 0.5, shape).astype(np.float32)
        tensors[f"{name}.bias"] = generator.normal(0, 0.5, shape[:1]).astype(np.float32)
    tensors["embeddings.word_embeddings.weight"] = generator.normal(0, 1, (9, WIDTH)).astype(np.float32)
    tensors["embeddings.position_embeddings.weight"] = generator.normal(0, 1, (16, WIDTH)).astype(np.float32)
    tensors["embeddings.token_type_embeddings.weight"] = generator.normal(0, 1, (2, WIDTH)).astype(np.float32)
    return tensors


def reference(weights: dict[str, np.ndarray], embedded: np.ndarray) -> np.ndarray:
    """The mean of torch's transformer encoder, layer by layer."""
    import torch

    def tensor(name: str) -> torch.Tensor:
        return torch.tensor(weights[name])

    rows = torch.nn.functional.layer_norm(
        torch.tensor(embedded),
        (WIDTH,),
        tensor("embeddings.LayerNorm.weight"),
        tensor("embeddings.LayerNorm.bias"),
        1e-12,
    )
    for number in range(LAYERS):
        layer = torch.nn.TransformerEncoderLayer(
            WIDTH, 12, WIDE, dropout=0, activation="gelu", layer_norm_eps=1e-12, batch_first=True
        ).eval()
        name = f"encoder.layer.{number}"
        own = {}
        for end in ("weight", "bias"):
            own[f"self_attn.in_proj_{end}"] = torch.cat(
                [tensor(f"{name}.attention.self.{kind}.{end}") for kind in ("query", "key", "value")]
            )
            own[f"self_attn.out_proj.{end}"] = tensor(f"{name}.attention.output.dense.{end}")
            own[f"norm1.{end}"] = tensor(f"{name}.attention.output.LayerNorm.{end}")
            own[f"linear1.{end}"] = tensor(f"{name}.intermediate.dense.{end}")
            own[f"linear2.{end}"] = tensor(f"{name}.output.dense.{end}")
            own[f"norm2.{end}"] = tensor(f"{name}.output.LayerNorm.{end}")
        layer.load_state_dict(own)
        with torch.no_grad():
            rows = layer(rows)
    return rows.mean(dim=1).numpy()


def test_the_network_is_torchs_transformer(weights):
    embedded = np.random.default_rng(5).normal(0, 1, (3, 7, WIDTH)).astype(np.float32)
    session = open_written(FileRef("small", "small"), lambda: sentences._network(weights))
    np.testing.assert_allclose(run(session, {"embedded": embedded})[0], reference(weights, embedded), atol=2e-5)


def test_a_file_that_lacks_a_weight_is_refused_by_its_name(weights):
    fewer = {name: array for name, array in weights.items() if "output.dense.bias" not in name}
    with pytest.raises(InputError, match=r"weights 'encoder\.layer\.0\.attention\.output\.dense\.bias'"):
        open_written(FileRef("small", "small"), lambda: sentences._network(fewer))


@pytest.fixture
def encoder(weights, tmp_path) -> sentences.SentenceEncoder:
    """A small encoder whose words are single letters."""
    pytest.importorskip("tokenizers")
    numpy = pytest.importorskip("safetensors.numpy")
    numpy.save_file(weights, tmp_path / "model.safetensors")
    vocabulary = {letter: row for row, letter in enumerate("?abcdefgh")}
    model = {"type": "WordLevel", "vocab": vocabulary, "unk_token": "?"}
    document = {"version": "1.0", "added_tokens": [], "pre_tokenizer": {"type": "Whitespace"}, "model": model}
    (tmp_path / "tokenizer.json").write_text(json.dumps(document))
    files = (FileRef(tmp_path / name, name) for name in ("model.safetensors", "tokenizer.json"))
    return sentences.SentenceEncoder(*files)


def test_a_text_is_the_unit_mean_over_its_tokens(encoder, weights):
    rows = encoder.encode(["a b", "h", "c c d"])
    words, places, segments = (
        weights[f"embeddings.{kind}_embeddings.weight"] for kind in ("word", "position", "token_type")
    )
    for row, ids in zip(rows, ([1, 2], [8], [3, 3, 4]), strict=True):
        mean = reference(weights, (words[ids] + places[: len(ids)] + segments[0])[None])[0]
        np.testing.assert_allclose(row, mean / np.linalg.norm(mean), atol=2e-5)


def test_a_text_means_the_same_whatever_stands_beside_it(encoder):
    alone = encoder.encode(["a b"])
    np.testing.assert_allclose(encoder.encode(["c", "a b", "a b c d", "e f"])[1:2], alone, atol=1e-6)
    assert encoder.encode([]).shape == (0, WIDTH)


def test_a_damaged_file_is_refused(encoder, tmp_path):
    (tmp_path / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(InputError, match="holds no sentence encoder"):
        sentences.SentenceEncoder(*(FileRef(tmp_path / n, n) for n in ("model.safetensors", "tokenizer.json")))


@pytest.mark.skipif(find("imagenet-class-names") is None, reason="needs the extra `names`")
def test_texts_of_one_meaning_are_nearer_than_others():
    model = find("imagenet-class-names")
    encoder = sentences.SentenceEncoder(model.file("sentences"), model.file("tokenizer"))
    one, same, other = encoder.encode(["a sofa", "a couch", "a goldfish"])
    assert float(one @ same) > 0.8 > 0.4 > float(one @ other)
