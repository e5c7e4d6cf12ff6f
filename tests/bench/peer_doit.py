"""The same tasks for doit: files in, files out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from doit.tools import config_changed


def tasks(folder: Path, count: int) -> dict[str, Any]:
    sources = [str(folder / f"source{i}.npy") for i in range(count)]
    steps = [str(folder / f"step{i}.npy") for i in range(count)]

    def save(target: str, value: float) -> None:
        np.save(target, np.array([value]))

    def scale(source: str, target: str, factor: float) -> None:
        np.save(target, factor * np.load(source))

    def add() -> None:
        np.save(folder / "total.npy", np.array([sum(float(np.load(file)[0]) for file in steps)]))

    def task_source() -> Any:
        for i, target in enumerate(sources):
            value = float(i)
            yield {
                "name": str(i),
                "actions": [(save, [target, value])],
                "targets": [target],
                "uptodate": [config_changed(str(value))],
            }

    def task_step() -> Any:
        for i, (source, target) in enumerate(zip(sources, steps, strict=True)):
            yield {
                "name": str(i),
                "actions": [(scale, [source, target, 2.0])],
                "file_dep": [source],
                "targets": [target],
                "uptodate": [config_changed("2.0")],
            }

    def task_total() -> dict[str, Any]:
        return {"actions": [add], "file_dep": steps, "targets": [str(folder / "total.npy")]}

    return {
        "DOIT_CONFIG": {"dep_file": str(folder / "doit.db"), "default_tasks": ["total"]},
        "task_source": task_source,
        "task_step": task_step,
        "task_total": task_total,
    }
