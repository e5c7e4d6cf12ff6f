"""Dataclasses as parameters, some of which the declared type of a parameter does not tell."""

from __future__ import annotations

from dataclasses import dataclass

from ss_flow.task import task


@dataclass(frozen=True)
class Linear:
    slope: float = 1.0


@dataclass(frozen=True)
class Square(Linear):
    pass


@dataclass(frozen=True)
class Nothing:
    pass


@dataclass(frozen=True)
class Holder:
    one: Linear | Nothing
    many: tuple[Linear, ...] = ()


@task()
def modelled(
    *,
    base: Linear = Linear(),
    union: Linear | Holder | None = None,
    several: tuple[Linear, ...] | None = None,
    empty: Nothing | None = None,
) -> Linear:
    return Linear()
