"""Whether a process would compute what a key says: the code that it has loaded, its packages and its processor."""

from __future__ import annotations

import functools
import socket
from pathlib import Path
from typing import Any

from ss_flow.closure import fix_sources
from ss_flow.distributions import Changes, changes
from ss_flow.errors import ExecutorLost
from ss_flow.explain import first_difference
from ss_flow.kept_closures import kept_closure
from ss_flow.keys import Components, Recipe
from ss_flow.loaded_code import left_behind
from ss_flow.task import Task


def check_sameness(task: Task[..., Any], components: Components, label: str, closures: Path) -> None:
    """Compare what this process has with what the key of a call stands for; cheap when asked again.

    components: those of the key. label: of the call. closures: the folder of kept closures.
    Raises ExecutorLost when they differ.
    """
    here = _recipe(task, closures, fix_sources(), changes())
    if all(components[part] == value for part, value in here.items()):
        return

    def named(parts: Components) -> Components:
        return {**parts, "code": {f"{task.function.__module__}:{task.function.__qualname__}": parts["code"]}}

    if difference := first_difference(named(components), named({**components, **here})):
        raise ExecutorLost(
            f"a worker on the host {socket.gethostname()} would compute {label} otherwise than its key says: "
            f"{difference}. Code, packages and kind of processor must be everywhere what they were where and when the "
            "run started: run again, after an update in a new process, and restart the workers of a cluster."
        )


@functools.cache
def _recipe(task: Task[..., Any], closures: Path, generation: int, changes: Changes) -> Components:
    recipe = Recipe.of(task, kept_closure(task.function, closures), changes)
    if reason := left_behind(recipe.closure):
        raise ExecutorLost(f"{task.name} would be computed otherwise than its key says: {reason}.")
    return recipe.components
