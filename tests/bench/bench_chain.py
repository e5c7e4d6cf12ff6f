"""The longest chain of a run's calls, each of which waits for the one before: what is left on any number of cores.

    OMP_NUM_THREADS=1 python tests/bench/bench_chain.py run CAPTURE --cache STORE --out FOLDER [--preset fast] ...

Takes what `ss-flow` takes after it, and runs one call at a time, so that what the process spends in the meantime is the
call's; of a step with a process of its own (COLMAP) it is the time. What an expansion adds waits for what it expands.
From an empty store; a call that is there already took nothing.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

from ss_flow.cache.store import Action, Store
from ss_flow.execute import Invocation, execute
from ss_flow.flows.cli.main import main
from ss_flow.graph import Call, Node
from ss_flow.resolution import Resolution
from ss_flow.running import Listener
from ss_flow.scheduler import Scheduler

Chain = tuple[float, tuple[tuple[str, float], ...]]
"""Seconds, and those of each call by its label."""


def table(arguments: list[str]) -> None:
    """Run and print."""
    spent: dict[str, float] = {}
    chains: dict[Node, Chain] = {}
    floors: dict[Node, Chain] = {}
    seconds: dict[Node, float] = defaultdict(float)
    settle, replace, finish = Resolution.settle, Resolution._replace, Scheduler._finish

    def timed(invocation: Invocation, store: Store, listener: Listener) -> Action:
        begun = time.process_time()
        action = execute(invocation, store, listener)
        spent[action.key] = time.process_time() - begun
        return action

    def timed_finish(self: Scheduler, node: Call, action: Action, kind: str, why: str = "") -> None:
        if kind == "finished":
            seconds[node] = spent.get(action.key, action.seconds)
        finish(self, node, action, kind, why)

    def longest(self: Resolution, node: Node) -> Chain:
        sources = [*node.waits_for(), *([self._expanded[node]] if node in self._expanded else [])]
        before = (*(chains[source] for source in sources), floors.get(node, (0.0, ())))
        return max(before, key=lambda chain: chain[0])

    def timed_settle(self: Resolution, node: Node, value: Any) -> None:
        so_far, calls = longest(self, node)
        own = seconds.get(node, 0.0)
        chains[node] = (so_far + own, (*calls, (node.label, own))) if own else (so_far, calls)
        settle(self, node, value)

    def timed_replace(self: Resolution, node: Node, build: Callable[[], Node]) -> None:
        known, floor = len(self._unresolved), longest(self, node)
        replace(self, node, build)
        floors.update(dict.fromkeys(list(self._unresolved)[known:], floor))

    with (
        patch("ss_flow.executors.local.execute", timed),
        patch.object(Scheduler, "_finish", timed_finish),
        patch.object(Resolution, "settle", timed_settle),
        patch.object(Resolution, "_replace", timed_replace),
    ):
        code = main([*arguments, "--jobs", "1"])
    total = time.process_time()
    length, calls = max(chains.values(), key=lambda chain: chain[0])
    in_calls = sum(seconds.values())
    print(f"\ncalls {in_calls:.1f} s, of the process {total:.1f} s; the longest chain {length:.1f} s:")
    print("\n| call | s |\n|---|---|")
    for label, own in calls:
        if own > length / 100:
            print(f"| {label} | {own:.2f} |")
    sys.exit(code)


if __name__ == "__main__":
    table(sys.argv[1:])
