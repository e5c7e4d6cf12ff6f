"""The same tasks as plain functions, for joblib."""

from __future__ import annotations

import numpy as np


def source(value: int) -> np.ndarray:
    return np.array([float(value)])


def step(x: np.ndarray, factor: float) -> np.ndarray:
    return factor * x


def total(xs: list[np.ndarray]) -> np.ndarray:
    return np.array([sum(float(x[0]) for x in xs)])
