"""A capture so small that the whole pipeline runs on it in seconds, and the command line called in this process."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.flows.cli.main import main
from ss_flow.flows.generated import RoomParams, generate, write_scene

ROOM = RoomParams(objects=2, views=5, width=96, height=72, held_out=0)

SHORT = [
    f"--set={assignment}"
    for assignment in (
        "reconstruct.iterations_per_view=2",
        "reconstruct.min_iterations=10",
        "reconstruct.max_iterations=20",
        "plan.max_rounds=10",
        "plan.min_score=0.05",  # what stands on a table touches it, but is no pair to merge
        "merge.iterations_per_view=2",
        "merge.min_iterations=4",
        "merge.max_iterations=8",
        "merge.global_iterations=20",
        "split.dense.max_points=8000",
    )
]
"""Trainings of a few steps, and the method's own merging of pairs: what comes out looks bad, and is made in the same
way."""


@dataclass(frozen=True)
class Called:
    """What a command came to."""

    code: int
    out: str
    err: str

    def document(self) -> dict[str, Any]:
        """Its one JSON document on stdout."""
        return json.loads(self.out)

    def computed(self) -> Counter[str]:
        """How many results of each step a run with --json computed."""
        return Counter(node["step"] for node in self.document()["nodes"] if not node["hit"])

    def results(self) -> dict[str, Any]:
        return self.document()["results"]


def write_room(folder: Path, masks: str | None = "truth", params: RoomParams = ROOM) -> Path:
    """The room as a capture on disk."""
    write_scene(generate(params), folder, masks=masks)
    return folder


def ss_flow(*arguments: str | Path) -> Called:
    """Call the command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as ended:
            code = int(ended.code or 0)
    return Called(code, out.getvalue(), err.getvalue())


def run_tiny(scene: Path, store: Path, *more: str | Path, out: Path | None = None) -> Called:
    """`ss-flow run SCENE --json` with short trainings."""
    place = out or store.parent / f"{scene.name}-out"
    return ss_flow("run", scene, "--out", place, "--cache", store, "--preset", "fast", "--json", *SHORT, *more)


def start_tiny(scene: Path, store: Path, *more: str, out: Path) -> subprocess.Popen[str]:
    """The same in a process of its own."""
    options = ["--out", str(out), "--cache", str(store), "--preset", "fast", "--json", *SHORT, *more]
    return subprocess.Popen(
        [sys.executable, "-c", "from ss_flow.flows.cli.main import entry; entry()", "run", str(scene), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def bytes_of(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, by relative name."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
