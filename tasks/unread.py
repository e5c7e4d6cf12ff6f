"""Parameters that a step does not read stay out of its key, so that changing them computes nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

P = TypeVar("P")


def by_default(params: P, *names: str) -> P:
    """The parameters (a dataclass, frozen) with the named ones as by default, as they are in any key then."""
    default: Any = type(params)()
    return replace(params, **{name: getattr(default, name) for name in names})  # type: ignore[type-var]
