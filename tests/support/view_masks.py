"""Masks of views as the fields of an instance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.tasks.artifacts import Int32, UInt8
from ss_flow.tasks.masks.packing import joined


def sizes_and_bits(masks: Sequence[np.ndarray] | np.ndarray) -> tuple[Int32, UInt8]:
    """Masks [H, W], one a view, as `sizes` and `packed`."""
    return joined([(mask.shape[1], mask.shape[0]) for mask in masks], [np.packbits(mask) for mask in masks])


def as_fields(masks: Sequence[np.ndarray] | np.ndarray) -> dict[str, np.ndarray]:
    """The same by name, for `dataclasses.replace`."""
    return dict(zip(("sizes", "packed"), sizes_and_bits(masks), strict=True))
