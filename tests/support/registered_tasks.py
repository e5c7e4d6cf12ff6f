"""All tasks of the algorithm."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

import ss_flow.tasks
from ss_flow.task import Task


def registered_tasks() -> dict[str, Task[..., Any]]:
    """Every task that a module below `ss_flow.tasks` declares, by name."""
    found: dict[str, Task[..., Any]] = {}
    for place in pkgutil.walk_packages(ss_flow.tasks.__path__, "ss_flow.tasks."):
        if "._rasterizer_" not in place.name:  # a shared object, but no module
            module = importlib.import_module(place.name)
            found |= {v.name: v for v in vars(module).values() if isinstance(v, Task)}
    return dict(sorted(found.items()))
