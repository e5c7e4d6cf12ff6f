"""Processor seconds of a run by step, as a table: how often, reading and storing, the step itself, share of the whole.

    OMP_NUM_THREADS=1 python tests/bench/bench_steps.py CAPTURE --cache STORE --out FOLDER [--preset fast] ...

Takes what `ss-flow run` takes and runs one call at a time, so that what the process spends in the meantime is the
call's. Steps with a process of their own (COLMAP) are not in the table. The rest are imports, keys, records and the
folder that is written.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from unittest.mock import patch

from ss_flow.cache.store import Action, Store
from ss_flow.execute import Invocation, execute
from ss_flow.flows.cli.main import main
from ss_flow.running import Listener
from ss_flow.task import Task


def table(arguments: list[str]) -> None:
    """Run and print."""
    calls: dict[str, int] = defaultdict(int)
    whole: dict[str, float] = defaultdict(float)
    inside: dict[str, float] = defaultdict(float)
    compute = Task.run

    def timed_run(self: Task[..., object], *given: object) -> object:
        begun = time.process_time()
        result = compute(self, *given)  # type: ignore[arg-type]
        inside[self.name] += time.process_time() - begun
        return result

    def timed(invocation: Invocation, store: Store, listener: Listener) -> Action:
        begun = time.process_time()
        action = execute(invocation, store, listener)
        calls[action.step] += 1
        whole[action.step] += time.process_time() - begun
        return action

    with patch("ss_flow.executors.local.execute", timed), patch.object(Task, "run", timed_run):
        code = main(["run", *arguments, "--jobs", "1"])
    total = time.process_time()
    print("\n| step | calls | read and stored, s | itself, s | of the run |\n|---|---|---|---|---|")
    for step in sorted(whole, key=lambda name: -whole[name]):
        around = whole[step] - inside[step]
        print(f"| {step} | {calls[step]} | {around:.2f} | {inside[step]:.2f} | {100 * whole[step] / total:.1f} % |")
    print(f"| the rest | | | {total - sum(whole.values()):.2f} | |\n| all | | | {total:.1f} | |")
    sys.exit(code)


if __name__ == "__main__":
    table(sys.argv[1:])
