"""ImageNet's class names as a text-image encoder: no network here has seen pictures and texts together.

A picture is the mean of its likeliest classes' names, each the unit vector that a sentence encoder gives it, weighted
by the probabilities that a classifier gives the classes; a text is its own vector (Norouzi et al., "Zero-Shot Learning
by Convex Combination of Semantic Embeddings", Eq. 1). Their cosine is thus, up to the length of that mean, the sum over
the classes of probability times similarity of name and text. It knows what the classes hold: "backpack" is one of them,
"tissue box" is near "toilet tissue", colours and relations it knows nothing of.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Bool, Float32, UInt8
from ss_flow.tasks.models.efficientnet import EfficientNetLite2
from ss_flow.tasks.models.sentences import SentenceEncoder
from ss_flow.tasks.models.text_image import CANONICAL, unit_rows

LIKELIEST = 10
"""How many classes a picture is made of; the paper's choice."""


class ClassNames:
    """The encoder, given by its files; the classifier is opened when the first picture comes.

    name: what results carry. classifier: see `EfficientNetLite2`. sentences, tokenizer: see `SentenceEncoder`. classes:
    the classes' names in the order of the classifier's outputs (see `read_classes`).
    Raises InputError when a file is damaged, or is not what its role says.
    """

    sees_masks = False
    absolute = False

    def __init__(
        self, name: str, classifier: FileRef, sentences: FileRef, tokenizer: FileRef, classes: FileRef
    ) -> None:
        self.name = name
        self._classifier_file = classifier
        self._sentences = SentenceEncoder(sentences, tokenizer)
        self.classes = read_classes(classes)

    @property
    def dimension(self) -> int:
        return self._sentences.dimension

    def encode_images(self, images: Sequence[UInt8], masks: Sequence[Bool] | None = None) -> Float32:
        """Unit vectors of pictures: [n, D].

        images: n times [h, w, 3] RGB. masks must be None: this model sees whole pictures.
        """
        if masks is not None:
            raise ValueError("the classifier sees whole pictures; compose the background before")
        probabilities = self._classifier.probabilities(images)
        least = np.sort(probabilities, axis=1)[:, -LIKELIEST, None]
        likely = np.where(probabilities >= least, probabilities, 0)
        return unit_rows(np.einsum("nc,cd->nd", likely, self._class_vectors))

    def encode_texts(self, texts: Sequence[str]) -> Float32:
        """Unit vectors of texts: [n, D]."""
        return self._sentences.encode(texts)

    def negatives(self, text: str) -> tuple[str, ...]:
        """The canonical phrases."""
        return CANONICAL

    @functools.cached_property
    def _classifier(self) -> EfficientNetLite2:
        return EfficientNetLite2(self._classifier_file)

    @functools.cached_property
    def _class_vectors(self) -> Float32:
        return self._sentences.encode(self.classes)


def read_classes(file: FileRef) -> tuple[str, ...]:
    """The names of classes: a line each, "n02769748 backpack, back pack, knapsack"; lines that begin with # are notes.

    Raises InputError when a line has no name.
    """
    lines = [line for line in file.path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    names = tuple(line.partition(" ")[2] for line in lines)
    if not names or not all(names):
        raise InputError(f"{file.path} names no classes: each line should be an id and a name.")
    return names
