"""Names for the instances: the word of a vocabulary that fits each of them best."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Descriptors, Float32, Int32, PointLabels
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.colour_words import TERMS, ColourWords
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.semantics.encoders import encoder_of

# fmt: off
HOUSEHOLD = (
    "armchair", "backpack", "bag", "bed", "blanket", "blinds", "book", "bookshelf", "bottle", "bowl", "box",
    "cabinet", "ceiling", "chair", "clock", "computer", "couch", "counter", "cup", "curtain", "cushion", "desk",
    "dish", "door", "drawer", "fan", "faucet", "fireplace", "floor", "food", "fridge", "guitar", "jacket", "jar",
    "kettle", "keyboard", "lamp", "laptop", "microwave", "mirror", "monitor", "mouse", "mug", "ottoman", "oven",
    "paper", "phone", "picture", "pillow", "pipe", "plant", "plate", "pot", "printer", "radiator", "remote",
    "rug", "screen", "shelf", "shoe", "sink", "sofa", "speaker", "spoon", "stool", "stove", "suitcase", "table",
    "telephone", "television", "toaster", "toilet", "towel", "toy", "tray", "vase", "wall", "wardrobe",
    "whiteboard", "window",
)
# fmt: on
"""Things that indoor scenes hold."""


@dataclass(frozen=True)
class InstanceNames:
    """The best word for each instance."""

    instance_id: Int32
    """[L] in the order of the descriptors."""
    names: tuple[str, ...]
    """L words; "object" for an instance that no view showed well enough."""
    score: Float32
    """[L] cosine of the descriptor and the word; 0 where there is no descriptor."""
    encoder: str
    """Name of the text-image encoder."""
    given: Int32 = field(default_factory=lambda: np.zeros(0, np.int32))
    """[G] ids of the instances whose name is the user's own."""


@task(environment=network_identity)
def name(
    descriptors: tuple[Descriptors, ...], *, encoder: Model | None = None, vocabulary: tuple[str, ...] = HOUSEHOLD
) -> InstanceNames:
    """The word with the highest cosine for each instance.

    encoder: None for colour words, which say "red object" and so on whatever the vocabulary.
    """
    model = encoder_of(encoder)
    by_colour = isinstance(model, ColourWords)
    words = TERMS if by_colour else vocabulary
    vectors = np.array([d.embedding for d in descriptors], np.float32).reshape(-1, model.dimension)
    cosines = np.einsum("ld,td->lt", vectors, model.encode_texts(words))
    best = cosines.argmax(axis=1)
    seen = np.linalg.norm(vectors, axis=1) > 0
    names = tuple(
        "object" if not known else f"{words[word]} object" if by_colour else words[word]
        for word, known in zip(best, seen, strict=True)
    )
    ids = np.array([d.instance_id for d in descriptors], np.int32)
    return InstanceNames(ids, names, cosines.max(axis=1, initial=-1) * seen, model.name)


@task(name="semantics.given_names")
def given_names(
    names: InstanceNames, hinted: PointLabels, labels: PointLabels, *, objects: tuple[str, ...]
) -> InstanceNames:
    """The user's own names in the place of words, for the instances that are the objects that were clicked.

    hinted: the dense points labelled by object; labels: by instance. objects: the objects' names. An object is the
    instance that has most of its points, if that instance has of no other object more.
    """
    shared = np.zeros((len(objects) + 1, int(labels.label.max(initial=0)) + 1), np.int64)
    np.add.at(shared, (hinted.label, labels.label), 1)
    shared[0], shared[:, 0] = 0, 0
    word_of = {}
    for number, called in enumerate(objects, start=1):
        best = int(shared[number].argmax())
        if shared[number, best] and shared[:, best].argmax() == number:
            word_of[best] = called
    words = tuple(word_of.get(i, word) for i, word in zip(names.instance_id.tolist(), names.names, strict=True))
    given = np.intersect1d(names.instance_id, list(word_of)).astype(np.int32)
    return replace(names, names=words, given=given)
