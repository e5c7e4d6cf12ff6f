"""Calls of toy tasks on an executor, and waiting for what they do."""

from __future__ import annotations

import time

import ss_flow_toy as toy

from ss_flow.execute import Invocation
from ss_flow.executors import open_executor
from ss_flow.keys import Keys

PATIENCE = 30.0


class Opened:
    """An executor, and what was heard of its calls."""

    def __init__(self, name, store, workers=2, processes=None):
        self.heard = []
        self.pool = open_executor(name, workers, store, lambda *sign: self.heard.append(sign), processes=processes)

    def run(self, invocation):
        return self.pool.submit(invocation).result(PATIENCE)

    def error(self, invocation):
        return self.pool.submit(invocation).exception(PATIENCE)


def call(store, task, *inputs, **parameters):
    """A call of a task on numbers."""
    given = dict(zip(task.signature.parameters, (store.put(toy.number(x)) for x in inputs), strict=False))
    keys = Keys()
    return Invocation(
        key=keys.key(task, given, parameters),
        label=task.name,
        task=f"{task.function.__module__}:{task.function.__qualname__}",
        inputs=given,
        parameters=parameters,
        components=keys.components(task, given, parameters),
        resources=task.resources,
        isolate=task.isolate,
        store=store.location,
    )


def wait_for(condition, seconds=PATIENCE):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def pid_in(path):
    """The process that said who it is in a file."""
    wait_for(lambda: path.exists() and path.read_text())
    return int(path.read_text())
