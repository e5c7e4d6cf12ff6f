"""Runs of toy flows, and what they came to."""

from __future__ import annotations

from ss_flow.engine import run_flow


def run(store, build, **kwargs):
    return run_flow(build, store, scene="toy", header={}, **kwargs)


def ran(report):
    return [n["label"] for n in report.nodes if n["event"] == "finished"]


def value(store, digest):
    return float(store.get(digest).value[0])
