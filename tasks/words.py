"""Lists and sizes in the sentences that people are told."""

from __future__ import annotations

from collections.abc import Sequence

_NAMED = 10
"""Views that a warning names."""


def first_of(names: Sequence[str], most: int = _NAMED) -> str:
    """Names in words, the first of them where there are many; the others are counted."""
    return f"{', '.join(names[:most])}{f' and {len(names) - most} more' if len(names) > most else ''}"


def size_in_words(count: float) -> str:
    """A number of bytes as a person says it."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 999.5:  # above, three digits would make it 1e+03
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"
