"""Trivial tasks, so that what is measured is the engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ss_flow.graph import each, gather, labelled
from ss_flow.task import task


@dataclass(frozen=True)
class Number:
    value: np.ndarray


@task(name="bench.source")
def source(*, value: float) -> Number:
    return Number(np.array([value]))


@task(name="bench.step")
def step(x: Number, *, factor: float) -> Number:
    return Number(factor * x.value)


@task(name="bench.total")
def total(xs: tuple[Number, ...]) -> Number:
    return Number(np.array([sum(float(x.value[0]) for x in xs)]))


def flow(count: int) -> dict[str, Any]:
    sources = []
    for i in range(count):
        with labelled(str(i)):
            sources.append(source(value=float(i)))
    return {"total": total(each(gather(sources), build=lambda x: step(x, factor=2.0)))}


@task(name="bench.views")
def views(*, count: int) -> tuple[Number, ...]:
    return tuple(Number(np.array([float(i)])) for i in range(count))


@task(name="bench.instance")
def instance(frames: Sequence[Number], depths: Sequence[Number], masks: Sequence[Number], *, number: int) -> Number:
    """As every training of Splat, it takes all views, and looks at few."""
    return Number(frames[0].value + depths[0].value + masks[0].value + number)


def views_by_instances(count: int, instances: int) -> dict[str, Any]:
    frames = views(count=count)
    depths = each(frames, build=lambda x: step(x, factor=2.0))
    masks = each(frames, build=lambda x: step(x, factor=3.0))
    made = []
    for number in range(instances):
        with labelled(str(number)):
            made.append(instance(frames, depths, masks, number=number))
    return {"total": total(made)}
