"""Lists in the sentences that steps tell."""

from __future__ import annotations

from collections.abc import Sequence

_NAMED = 10
"""Views that a warning names."""


def first_of(names: Sequence[str], most: int = _NAMED) -> str:
    """Names in words, the first of them where there are many; the others are counted."""
    return f"{', '.join(names[:most])}{f' and {len(names) - most} more' if len(names) > most else ''}"
