"""What a run really imports, against what the keys of its tasks know."""

from __future__ import annotations

import builtins
import importlib.metadata
import sys
from types import FrameType

from registered_tasks import registered_tasks
from tiny_runs import run_tiny, write_room

from ss_flow import execute
from ss_flow.keys import Recipe


def task_of(frame: FrameType | None) -> str:
    """The task that runs below a frame; "" when none does."""
    while frame is not None:
        if frame.f_code is execute.execute.__code__:
            return str(frame.f_locals["task"].name)
        frame = frame.f_back
    return ""


def test_no_task_of_a_run_imports_a_distribution_that_its_key_does_not_know(tmp_path, monkeypatch):
    seen: set[tuple[str, str]] = set()
    load = builtins.__import__

    def watched(name, globals=None, *more, **named):
        if globals and str(globals.get("__name__", "")).startswith("ss_flow.tasks."):
            seen.add((task_of(sys._getframe(1)), name.partition(".")[0]))
        return load(name, globals, *more, **named)

    monkeypatch.setattr(builtins, "__import__", watched)
    assert run_tiny(write_room(tmp_path / "room"), tmp_path / "store", "--jobs", "1").code == 0
    monkeypatch.undo()
    assert {("split.dense", "cv2"), ("split.propagate", "scipy")} <= seen, "what is known to be imported is seen"
    owners, tasks = importlib.metadata.packages_distributions(), registered_tasks()
    for task, module in sorted(seen):
        if task and module not in sys.stdlib_module_names and module != "ss_flow":
            known = Recipe.of(tasks[task]).components["packages"]
            assert known.keys() >= set(owners.get(module, [module])), f"the key of {task} does not know {module}"
