"""Milliseconds of a step of the last pass on growing numbers of threads.

    python tests/bench/bench_threads.py CAPTURE --cache STORE --out FOLDER [--preset default] ...

Takes what `ss-flow run` takes, and runs on the CPU up to the last pass. Before its training with views of instances
alone, some steps of it are taken on 1, 2, 4, ... threads, in two turns, of which the faster counts.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from typing import Any
from unittest.mock import patch

from ss_flow.control_groups import usable_cores
from ss_flow.flows.cli.main import main
from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.trainer import TrainResult, _Training, train

WARM, STEPS = 5, 30


def milliseconds(threads: int, *given: Any, **settings: Any) -> float:
    """Of a step of the training that is meant."""
    ended: list[float] = []
    advance = _Training.advance

    def timed(self: _Training) -> None:
        advance(self)
        ended.append(time.perf_counter())
        if len(ended) > WARM + STEPS:
            raise StopIteration

    with patch.object(_Training, "advance", timed), suppress(StopIteration):
        train(*given, **settings, backend=NativeBackend(threads))
    return 1000 * (ended[-1] - ended[WARM]) / STEPS


def measured(*given: Any, **settings: Any) -> TrainResult:
    """Trains as asked, and prints the table first if parts are seen alone."""
    if settings["parts"]:
        threads = [1 << k for k in range(usable_cores().bit_length())]
        turns = [[milliseconds(n, *given, **settings) for n in threads] for _ in range(2)]
        print(f"\n| threads | {' | '.join(map(str, threads))} |\n|---{'|---' * len(threads)}|")
        print(f"| ms a step | {' | '.join(f'{min(both):.1f}' for both in zip(*turns, strict=True))} |", flush=True)
    return train(*given, **settings)


if __name__ == "__main__":
    os.environ["SS_FLOW_DEVICE"] = "cpu"
    with patch("ss_flow.tasks.splat.global_pass.train", measured):
        sys.exit(main(["run", *sys.argv[1:], "--executor", "threads", "--until", "global_pass"]))
