"""The text-image encoder of a run: a CLIP model, ImageNet's class names, or colour words."""

from __future__ import annotations

import functools

from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.colour_words import ColourWords
from ss_flow.tasks.models.text_image import TextImageEncoder


@functools.lru_cache(maxsize=2)
def encoder_of(model: Model | None) -> TextImageEncoder:
    """The encoder that a model's files hold; the colour words for None. Kept open for the next instance of a scene.

    model: with the roles "vision" and "text", and "vocabulary" and "merges" or "tokenizer"; or with "classifier",
    "classes", "sentences" and "tokenizer".
    Raises InputError when the files are not those of such a model.
    """
    if model is None:
        return ColourWords()
    if "classifier" in {entry.role for entry in model.files}:
        from ss_flow.tasks.models.class_names import ClassNames

        roles = ("classifier", "sentences", "tokenizer", "classes")
        return ClassNames(model.name, *(model.file(role) for role in roles))
    from ss_flow.tasks.models.clip import Clip

    tokenizer = [entry.ref.path for entry in model.files if entry.role in ("vocabulary", "merges", "tokenizer")]
    return Clip(model.name, model.file("vision"), model.file("text"), tokenizer)
