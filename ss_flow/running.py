"""What a task may ask of whoever runs it: how many cores it has, to be heard, and to keep what is half done.

None of it changes a result, so none of it counts in a key. Outside a flow a task has one core, nobody listens, and
nothing is kept.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ss_flow.cache.canonical import digest

T = TypeVar("T")
R = TypeVar("R")
Listener = Callable[[int, int, str], None]
_DIGEST = "digest of the others"
"""In a checkpoint: the archive itself would not notice an array that is missing, or is none any more."""


@dataclass(frozen=True)
class Surroundings:
    """What the runner of a task gives it."""

    listener: Listener = lambda done, total, note: None
    cores: int = 1
    checkpoint: Path | None = None
    """Where the task's half-done work lies, if there is any."""
    warned: list[str] | None = None
    """Collects what the task warns of; None = Python's own warnings do."""
    last_try: bool = False
    """Whether memory ran out once, so that nothing runs beside the task now."""


_ALONE = Surroundings()
_surroundings: ContextVar[Surroundings] = ContextVar("surroundings", default=_ALONE)


@contextmanager
def running(surroundings: Surroundings) -> Iterator[None]:
    """Within this, the functions below speak of `surroundings`."""
    token = _surroundings.set(surroundings)
    try:
        yield
    finally:
        _surroundings.reset(token)


@contextmanager
def nothing_kept() -> Iterator[None]:
    """Within this no half-done work is kept or found: for the first, short part of a task whose second part keeps its
    own."""
    with running(replace(_surroundings.get(), checkpoint=None)):
        yield


@contextmanager
def counted(before: int, total: int) -> Iterator[None]:
    """Within this a task is `before` of `total` steps further than it says: for the parts of one that work in turn."""
    heard = _surroundings.get()

    def listener(done: int, _: int, note: str) -> None:
        heard.listener(before + done, total, note)

    with running(replace(heard, listener=listener)):
        yield


def progress(done: int, total: int, note: str = "") -> None:
    """Say how far a long task is; costs nothing where there is no listener. A cancelled task ends here."""
    _surroundings.get().listener(done, total, note)


def cores() -> int:
    """How many threads the task may use."""
    return _surroundings.get().cores


def in_threads(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """What a function makes of each item, in order, by as many threads as the task may use.

    Items are taken in the caller's thread, each when there is room for it. NumPy, SciPy and OpenCV let other threads
    run while they work. The function itself has one core there, and its own progress is not heard.
    """
    if cores() == 1:
        yield from map(function, items)
        return
    alone = replace(_surroundings.get(), listener=_ALONE.listener, cores=1)

    def one(item: T) -> R:
        with running(alone):
            return function(item)

    with ThreadPoolExecutor(cores(), "view") as pool:
        begun: deque[Future[R]] = deque()
        try:
            for item in items:
                begun.append(pool.submit(one, item))
                if len(begun) > cores():
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for late in begun:
                late.cancel()


def last_try() -> bool:
    """Whether the task fails if memory runs out once more."""
    return _surroundings.get().last_try


def warn(message: str) -> None:
    """Say something that whoever uses the result should know; it is kept in the record of the result."""
    warned = _surroundings.get().warned
    if warned is None:
        warnings.warn(message, stacklevel=2)
    elif message not in warned:
        warned.append(message)


def save_checkpoint(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Keep half-done work for the next try at the same key; it takes the place of what was kept before.

    A crash leaves the old checkpoint or the new one. The runner removes it when the task is done. Where it cannot be
    written, the old one stays.
    """
    path = _surroundings.get().checkpoint
    if path is None:
        return
    with contextlib.suppress(OSError):
        path.parent.mkdir(exist_ok=True)  # not those above: a store that was moved away would be there again
        with unfinished(path).open("wb") as stream:
            kept = {name: np.asarray(array) for name, array in arrays.items()}
            np.savez(stream, **kept, **{_DIGEST: np.array(digest(kept))})  # type: ignore[arg-type]
            stream.flush()
            os.fsync(stream.fileno())
        unfinished(path).replace(path)


def unfinished(path: Path) -> Path:
    """Where a checkpoint is written before it takes its name."""
    return path.with_suffix(".partial")


def remove_checkpoint(path: Path) -> None:
    """Take away what a task kept, when it is done; where that is not allowed, it stays until it is collected."""
    for file in (path, unfinished(path)):
        with contextlib.suppress(OSError):
            file.unlink()


def load_checkpoint() -> dict[str, NDArray[Any]] | None:
    """What an earlier try at the same key kept, if that is whole."""
    path = _surroundings.get().checkpoint
    if path is None:
        return None
    try:
        with np.load(path, allow_pickle=False) as stored:
            kept = {name: stored[name] for name in stored.files}
        return kept if str(kept.pop(_DIGEST)) == digest(kept) else None
    except Exception:  # whatever is raised of bytes that were damaged
        return None
