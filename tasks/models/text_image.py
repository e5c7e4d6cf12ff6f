"""Encoders that put pictures and words into one space: what the semantic steps ask of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, UInt8

CANONICAL = ("object", "things", "stuff", "texture")
"""The canonical phrases, which fit anything (Kerr et al., "LERF", Sec. 3.4)."""


def unit_rows(rows: Float32) -> Float32:
    """Rows [n, D] brought to length 1; zeros stay."""
    rows = rows.astype(np.float32)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


class TextImageEncoder(Protocol):
    """A model for which the cosine between a picture and a text says how well they agree."""

    @property
    def name(self) -> str:
        """What the results carry, so that every answer says which model gave it."""
        ...

    @property
    def dimension(self) -> int: ...

    @property
    def sees_masks(self) -> bool:
        """Whether it looks at an object's pixels alone; if not, the caller blurs or paints what lies around it."""
        ...

    @property
    def absolute(self) -> bool:
        """Whether a text fits an object does not depend on the other objects ("red")."""
        ...

    def encode_images(self, images: Sequence[UInt8], masks: Sequence[Bool] | None = None) -> Float32:
        """Unit vectors of pictures: [n, D].

        images: n times [h, w, 3] RGB, of any sizes. masks: n times [h, w], the pixels that count; only for an encoder
        that `sees_masks`.
        """
        ...

    def encode_texts(self, texts: Sequence[str]) -> Float32:
        """Unit vectors of texts: [n, D]. Raises InputError for a text that it cannot read."""
        ...

    def negatives(self, text: str) -> tuple[str, ...]:
        """Texts that a picture of `text` must agree with less than with `text` itself."""
        ...
