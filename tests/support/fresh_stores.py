"""Runs of toy flows, each on a store that is opened anew, and damage to what they leave there."""

from __future__ import annotations

import ss_flow_toy as toy

from ss_flow.cache.store import Store
from ss_flow.engine import Request, run_flow, run_flows


def run(store, build=toy.flow, **options):
    return run_flow(build, Store(store.root), scene="toy", **options)


def read_by(done, store, build=toy.flow):
    """Run, and have the results read by `done`."""
    return run_flows([Request(build, "toy", done=done)], Store(store.root))[0]


def computed(report):
    return sorted(n["label"] for n in report.nodes if n["event"] == "finished")


def flip(store, object_digest, byte=-1):
    """Flip one bit in the values of a stored object."""
    chunk = next(store.object_path(object_digest).glob("*/c*"))
    content = bytearray(chunk.read_bytes())
    content[byte] ^= 1
    chunk.write_bytes(content)


def one(build):
    """A flow over one number."""
    return lambda: {"out": build(toy.source(values=(2.0,))[0])}
