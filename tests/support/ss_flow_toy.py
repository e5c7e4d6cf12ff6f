"""A flow over numbers, small enough to see through, for the tests of the engine."""

from __future__ import annotations

import builtins
import os
import signal
import time
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.graph import each, expand
from ss_flow.running import cores, last_try, load_checkpoint, progress, save_checkpoint, warn
from ss_flow.task import Bundle, FileRef, Resources, task

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Number:
    value: np.ndarray


@dataclass(frozen=True, slots=True)
class Score:
    """Plain values of declared types."""

    value: float
    at: tuple[float, int] = (0.0, 0)
    path: tuple[tuple[int, ...], str] = ((), "")
    cells: np.ndarray = field(default_factory=lambda: np.zeros(2))


@dataclass(frozen=True)
class Checked:
    """A type that is known to type checkers alone, and a declared tuple beside it."""

    cells: NDArray[np.float64]
    at: tuple[int, ...] | None
    other: tuple[str, int] = ("", 0)


@dataclass(frozen=True)
class Table:
    """Plain values that can be changed."""

    rows: dict[str, list[int]]
    names: list[str]
    entries: tuple[dict[str, int], ...] = ()


@dataclass(frozen=True)
class Row:
    """A tuple that is declared as nothing else."""

    cells: tuple
    unit: tuple | None = None


@dataclass(frozen=True)
class Scaled:
    """A type that takes what it does not keep."""

    value: np.ndarray
    by: InitVar[float]


@dataclass(frozen=True)
class Shifted:
    """A type that makes something else of its fields whenever it is made."""

    value: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", self.value + 1)


@dataclass(frozen=True)
class Rounded:
    """A type that makes the same of its fields again."""

    value: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", self.value.round())


@dataclass(frozen=True)
class Sorted:
    """A type that changes what it is given."""

    value: np.ndarray

    def __post_init__(self) -> None:
        self.value.sort()


def number(value: float) -> Number:
    return Number(np.array([value]))


@task()
def appended(*, rows: list[int], by: int) -> Number:
    """Changes a parameter, as no task should."""
    rows.append(by)
    return number(len(rows))


@task()
def source(*, values: tuple[float, ...]) -> tuple[Number, ...]:
    return tuple(number(v) for v in values)


@task()
def table() -> Table:
    return Table({"a": [1]}, ["a"])


@task()
def spoilt(of: Table) -> Number:
    """Changes what it is given."""
    of.rows["a"].append(2)
    of.names.clear()
    return number(0.0)


@task()
def counted(of: Table, after: Number) -> Number:
    return number(10 * len(of.rows["a"]) + len(of.names))


@task()
def square(x: Number) -> Number:
    return number(helper(float(x.value[0])))


@task()
def times_file(x: Number, *, files: tuple[FileRef, ...]) -> Number:
    """Multiplies with the number in a file."""
    return number(float(x.value[0]) * float(files[0].path.read_text()))


@task()
def uncertain(x: Number) -> Number:
    """Gives something else each time, as computations on a GPU may."""
    return number(float(time.time_ns()))


def helper(x: float) -> float:
    return x * x


@task()
def clip(x: Number, *, limit: float) -> Number:
    return number(min(float(x.value[0]), limit))


@task()
def total(xs: tuple[Number, ...]) -> Number:
    progress(1, 1, "adding")
    return number(sum(float(x.value[0]) for x in xs))


@dataclass(frozen=True)
class Pair(Bundle):
    one: Number
    rest: Sequence[Number]


@task()
def shifted_total(pair: Pair, more: Number, *, by: float) -> Number:
    assert not isinstance(pair.rest, tuple)
    return number(float(pair.one.value[0]) + sum(float(x.value[0]) for x in pair.rest) + float(more.value[0]) + by)


@task()
def streamed_total(xs: Sequence[Number]) -> Number:
    """The total again, of items that are read one by one; the even ones twice."""
    assert not isinstance(xs, tuple)
    return number(sum(float(x.value[0]) for x in xs) + sum(float(x.value[0]) for x in xs[::2]) + len(xs))


@task()
def half(x: Number) -> Number:
    if x.value[0] < 0:
        raise ValueError("negative")
    return number(float(x.value[0]) / 2)


@task(resources=Resources(most_cores=4))
def given_cores(x: Number) -> Number:
    time.sleep(0.1)
    return number(cores())


@task()
def climb(x: Number, *, top: int, falls_at: str) -> Number:
    """Counts up in steps that it keeps; dies at the step that the file `falls_at` names, while there is one."""
    kept = load_checkpoint()
    height = 0 if kept is None else int(kept["height"])
    start = height
    while height < top:
        height += 1
        save_checkpoint({"height": np.int64(height)})
        if Path(falls_at).exists() and int(Path(falls_at).read_text()) == height:
            raise RuntimeError("fell")
    return number(start)


@task(isolate=True)
def own_process(x: Number) -> Number:
    return number(float(os.getpid()))


@task(isolate=True)
def abort(x: Number) -> Number:
    os.abort()


@task()
def slow(x: Number) -> Number:
    for i in range(200):
        time.sleep(0.05)
        progress(i, 200)
    return x


def halving(x, depth=0):
    """Halve until below one: a flow whose length depends on its results."""

    def build(now):
        return x if now.value[0] < 1 else halving(half(x), depth + 1)

    return expand(x, build)


def flow(values=(1.0, 2.0, 3.0), limit=100.0):
    numbers = source(values=values)
    squares = each(numbers, build=lambda x: clip(square(x), limit=limit), names=[f"n{i}" for i in range(len(values))])
    return {"squares": squares, "total": total(squares)}


@task(resources=Resources(memory_mb=1000))
def hungry(x: Number) -> Number:
    time.sleep(0.2)
    return x


@task(isolate=True)
def killed_once(x: Number, *, marker: str) -> Number:
    """Dies as by the kernel's out-of-memory killer, the first time."""
    if not Path(marker).exists():
        Path(marker).write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return x


@task()
def makes_do(x: Number) -> Number:
    """Does with less in its last try."""
    if not last_try():
        raise MemoryError("not enough memory on the device")
    return x


@task(isolate=True)
def killed_beside_its_child(x: Number, *, child_file: str) -> Number:
    """Forks a child that outlives it, and dies, the first time."""
    if not Path(child_file).exists():
        if (child := os.fork()) == 0:
            time.sleep(60)
            os._exit(0)
        Path(child_file).write_text(str(child))
        os.kill(os.getpid(), signal.SIGKILL)
    return x


@task(isolate=True)
def killed(x: Number) -> Number:
    os.kill(os.getpid(), signal.SIGKILL)
    return x


@task(isolate=True)
def slow_elsewhere(x: Number, *, pid_file: str) -> Number:
    """Counts in a process of its own, for a long time, and keeps its height."""
    Path(pid_file).write_text(str(os.getpid()))
    for i in range(400):
        time.sleep(0.05)
        save_checkpoint({"height": np.int64(i)})
        progress(i, 400)
    return x


@task(isolate=True)
def deaf(x: Number, *, pid_file: str) -> Number:
    """Works for a long time without a sign."""
    Path(pid_file).write_text(str(os.getpid()))
    time.sleep(60)
    return x


@task()
def crawl(x: Number, *, seconds: float) -> Number:
    """Works for so long, and says how far it is."""
    for i in range(20):
        progress(i, 20)
        time.sleep(seconds / 20)
    return x


@task()
def located(x: Number, *, seconds: float) -> Number:
    """Says in which process it is, and works for so long."""
    progress(0, 1, str(os.getpid()))
    time.sleep(seconds)
    return x


@task()
def loud(x: Number) -> Number:
    """Prints, as libraries do."""
    print("noise", flush=True)
    os.write(1, b"noise of native code\n")
    return x


@task()
def unsayable(x: Number) -> Number:
    """Raises what cannot be pickled."""
    raise ValueError("two is too much", lambda: x)


class Unmade(Exception):
    """Can be pickled, but not be made again from what its text is."""

    def __init__(self, first: str, second: str) -> None:
        super().__init__(f"{first} {second}")


@task()
def unmade(x: Number) -> Number:
    """Raises what cannot be read back."""
    raise Unmade("two is", "too much")


@task()
def raising(x: Number, *, error: str) -> Number:
    """Raises a built-in exception."""
    raise getattr(builtins, error)("two is too much")


@task()
def yielded(*, count: int) -> tuple[Number, ...]:
    """A generator, in which nothing runs before someone asks for its items."""
    for n in range(count):
        warn(f"item {n}")
        yield number(n)


@task()
def nap(x: Number) -> Number:
    time.sleep(0.05)
    return x
