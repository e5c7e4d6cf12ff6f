"""The same tasks for Hamilton. Its annotations are read, so they are not postponed."""

import numpy as np
from hamilton.htypes import Collect, Parallelizable


def source(count: int) -> Parallelizable[float]:
    for i in range(count):
        yield float(i)


def number(source: float) -> np.ndarray:
    return np.array([source])


def step(number: np.ndarray) -> np.ndarray:
    return 2.0 * number


def total(step: Collect[np.ndarray]) -> np.ndarray:
    return np.array([sum(float(x[0]) for x in step)])
