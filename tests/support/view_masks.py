"""Masks of views as the fields of an instance."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ss_flow.tasks.packed import Masks


def as_fields(masks: Iterable[np.ndarray]) -> dict[str, np.ndarray]:
    """Masks [H, W], one a view, by name, for a constructor or `dataclasses.replace`."""
    return vars(Masks.of(masks))
