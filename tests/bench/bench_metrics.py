"""How long all measures on points take, for a scan of a million vertices.

    python tests/bench/bench_metrics.py [--points 1000000] [--instances 500] [--repeats 5]

Prints the processor seconds of the contingency table, of the protocol of ScanNet's instances, and of all measures
together (`evaluate.points.point_metrics`), each the least of the repeats.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from ss_flow.tasks.evaluate.contingency import contingency
from ss_flow.tasks.evaluate.points import ig_metrics, point_metrics


def least(repeats: int, call: Callable[[], object]) -> float:
    """The least processor seconds of a call."""
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        seconds.append(time.process_time() - start)
    return min(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--instances", type=int, default=500)
    parser.add_argument("--repeats", type=int, default=5)
    asked = parser.parse_args()
    rng = np.random.default_rng(0)
    truth = np.sort(rng.integers(-1, asked.instances, asked.points)).astype(np.int32)
    # Mostly right: one point in five carries any label.
    predicted = np.where(rng.random(asked.points) < 0.8, truth + 1, rng.integers(0, asked.instances, asked.points))
    predicted = predicted.astype(np.int32)
    score = {i: float(s) for i, s in enumerate(rng.random(asked.instances + 1))}
    print(f"{asked.points} points, {asked.instances} x {asked.instances} instances, processor seconds:")
    for name, call in {
        "contingency": lambda: contingency(truth, predicted),
        "ig_metrics": lambda: ig_metrics(truth, predicted),
        "point_metrics": lambda: point_metrics(truth, predicted, score),
    }.items():
        print(f"{name:14} {least(asked.repeats, call):.3f}")


if __name__ == "__main__":
    main()
