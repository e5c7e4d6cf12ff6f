"""The same tasks for redun."""

from __future__ import annotations

import numpy as np
from redun import task

redun_namespace = "ss_flow_bench"


@task()
def source(value: int) -> np.ndarray:
    return np.array([float(value)])


@task()
def step(x: np.ndarray, factor: float) -> np.ndarray:
    return factor * x


@task()
def total(xs: list) -> np.ndarray:
    return np.array([sum(float(x[0]) for x in xs)])


@task()
def main(count: int) -> np.ndarray:
    return total([step(source(i), 2.0) for i in range(count)])
