"""Jobs that wait for their turn, and the tokens that say how many may run."""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, replace

from ss_flow.execute import Invocation
from ss_flow.graph import Call
from ss_flow.task import Resources

KINDS = ("cores", "memory_mb", "gpus")


@dataclass
class Job:
    """One key to compute, for one or more nodes."""

    invocation: Invocation
    nodes: list[Call]
    why: str
    priority: tuple[int, int]
    """Lower goes first."""

    @property
    def key(self) -> str:
        return self.invocation.key


class Tokens:
    """What the machine has, and what running jobs hold of it."""

    def __init__(self, capacity: Resources) -> None:
        self._capacity = capacity
        self._held: dict[str, float] = dict.fromkeys(KINDS, 0)
        self._running: dict[str, Job] = {}

    def fit(self, job: Job) -> bool:
        """Whether a job may start now; what needs more than the machine has runs alone."""
        if not self._running:
            return True
        if job.invocation.alone or any(other.invocation.alone for other in self._running.values()):
            return False
        wanted = job.invocation.resources
        return all(
            self._held[kind] + self._counted(wanted, kind) <= getattr(self._capacity, kind) + 1e-9 for kind in KINDS
        )

    def take(self, job: Job, *, waiting: int) -> None:
        """Start a job. Of the cores that are free it gets a fair share, up to its `most_cores`.

        waiting: how many other jobs are ready, with which it shares.
        """
        wanted = job.invocation.resources
        share = int(self._capacity.cores - self._held["cores"]) // (waiting + 1)
        cores = max(wanted.cores, min(wanted.most_cores, share))
        job.invocation = replace(job.invocation, resources=replace(wanted, cores=cores))
        self._running[job.key] = job
        for kind in KINDS:
            self._held[kind] += self._counted(job.invocation.resources, kind)

    def give_back(self, job: Job) -> None:
        del self._running[job.key]
        for kind in KINDS:
            self._held[kind] -= self._counted(job.invocation.resources, kind)

    def _counted(self, wanted: Resources, kind: str) -> float:
        if kind == "gpus" and not self._capacity.gpus:
            return 0
        amount: float = getattr(wanted, kind)
        return amount


class Queue:
    """Jobs by priority, those of equal resources in one row: who does not fit holds up only its own row."""

    def __init__(self) -> None:
        self._rows: dict[tuple[Resources, bool], list[tuple[tuple[int, int], int, Job]]] = {}
        self._order = itertools.count()
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def push(self, job: Job) -> None:
        row = self._rows.setdefault((job.invocation.resources, job.invocation.alone), [])
        heapq.heappush(row, (job.priority, next(self._order), job))
        self._length += 1

    def pop(self, tokens: Tokens) -> Job | None:
        """The first job that may start now."""
        heads = [row for row in self._rows.values() if row and tokens.fit(row[0][2])]
        if not heads:
            return None
        self._length -= 1
        return heapq.heappop(min(heads))[2]
