"""ImageNet's class names as an encoder: with a classifier and vectors that are known, and with the real networks."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from box_scene import frames

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.models import class_names
from ss_flow.tasks.models.catalogue import find
from ss_flow.tasks.models.class_names import ClassNames, read_classes
from ss_flow.tasks.semantics.encoders import encoder_of

WORDS = [f"word{i}" for i in range(30)]


class Sentences:
    """The k-th word is the k-th axis."""

    dimension = len(WORDS)

    def __init__(self, weights, tokenizer) -> None:
        pass

    def encode(self, texts):
        return np.eye(len(WORDS), dtype=np.float32)[[WORDS.index(text) for text in texts]]


@pytest.fixture
def encoder(monkeypatch, tmp_path) -> ClassNames:
    """The classes are the words; a picture's own pixels are its probabilities."""
    lines = ["# a note", *(f"n{i:08d} {word}" for i, word in enumerate(WORDS))]
    (tmp_path / "classes.txt").write_text("\n".join(lines))
    monkeypatch.setattr(class_names, "SentenceEncoder", Sentences)
    known = SimpleNamespace(probabilities=lambda images: np.array([image.ravel() for image in images], np.float32))
    monkeypatch.setattr(class_names, "EfficientNetLite2", lambda file: known)
    nothing = FileRef(tmp_path, "")
    return ClassNames("names", nothing, nothing, nothing, FileRef(tmp_path / "classes.txt", "classes"))


def test_a_picture_is_the_mixture_of_its_ten_likeliest_classes(encoder):
    shares = np.arange(1, 31) / np.arange(1, 31).sum()
    expected = np.where(np.arange(30) >= 20, shares, 0)
    (row,) = encoder.encode_images([shares])
    np.testing.assert_allclose(row, expected / np.linalg.norm(expected), atol=1e-6)


def test_the_cosine_is_the_sum_of_probability_times_similarity(encoder):
    shares = np.zeros(30)
    shares[[3, 7]] = 0.8, 0.6
    cosines = encoder.encode_images([shares]) @ encoder.encode_texts(["word3", "word7", "word9"]).T
    np.testing.assert_allclose(cosines, [[0.8, 0.6, 0]], atol=1e-6)


def test_masks_are_not_for_this_encoder(encoder):
    with pytest.raises(ValueError, match="whole pictures"):
        encoder.encode_images([np.zeros((4, 4, 3), np.uint8)], [np.ones((4, 4), bool)])


def test_a_list_of_classes_without_names_is_refused(tmp_path):
    (tmp_path / "classes.txt").write_text("n00000001 cup\nn00000002\n")
    with pytest.raises(InputError, match=r"classes\.txt names no classes"):
        read_classes(FileRef(tmp_path / "classes.txt", ""))


def test_the_list_has_imagenets_thousand_classes_in_the_order_of_their_ids():
    from pathlib import Path

    file = Path(class_names.__file__).with_name("imagenet_classes.txt")
    ids = [line.split()[0] for line in file.read_text().splitlines() if not line.startswith("#")]
    names = read_classes(FileRef(file, ""))
    assert len(names) == 1000 and ids == sorted(set(ids))
    assert names[0].startswith("tench") and names[414].startswith("backpack") and names[999].startswith("toilet tissue")


@pytest.mark.skipif(find("imagenet-class-names") is None, reason="needs the extra `names`")
def test_the_real_networks_give_unit_vectors_of_one_space():
    encoder = encoder_of(find("imagenet-class-names"))
    from ss_flow.tasks.geometry.images import decode_rgb

    rows = encoder.encode_images([decode_rgb(frames()[0])])
    words = encoder.encode_texts(["a box", "military uniform"])
    assert encoder.name == "imagenet-class-names" and rows.shape == (1, 384) == (1, words.shape[1])
    np.testing.assert_allclose(np.linalg.norm([*rows, *words], axis=1), 1, atol=1e-5)
