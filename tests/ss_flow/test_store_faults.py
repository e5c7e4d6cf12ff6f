"""Stores whose disk is full, that vanish, or that several runs share."""

from __future__ import annotations

import json
import os
import random
import threading
from pathlib import Path

import pytest
from fresh_stores import computed, run
from toy_programs import claims, start

from ss_flow.cache import codec
from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.store import Store
from ss_flow.events import Record, Reporter
from ss_flow.runs import latest_runs


def test_a_disk_that_is_full_now_and_then_costs_runs_but_no_result(store, monkeypatch):
    expected = run(Store(store.root.parent / "fresh")).values
    write, chance = codec.write, random.Random(0)

    def sometimes_full(value, folder):
        if chance.random() < 0.4:
            raise OSError(28, "No space left on device")
        write(value, folder)

    monkeypatch.setattr(codec, "write", sometimes_full)
    refusals, report = 0, None
    while report is None and refusals < 40:
        try:
            report = run(store)
        except StoreFailure as failure:
            refusals += 1
            assert "No space left on device" in str(failure)
            assert list((store.root / "claims").iterdir()) == list((store.root / "tmp").iterdir()) == []
    assert report is not None
    assert report.values == expected
    assert refusals


def test_a_store_that_vanishes_ends_the_run_with_one_sentence(store):
    import shutil

    class Vanish(Reporter):
        def event(self, kind, **details):
            if kind == "finished":
                shutil.rmtree(store.root, ignore_errors=True)

    with pytest.raises(StoreFailure, match="it has vanished"):
        run(store, reporter=Vanish())


def test_a_store_on_a_path_with_spaces_and_unicode_works_on_every_executor(tmp_path):
    store = Store(tmp_path / "ein Örtchen für 数据")
    values = [run(store, executor=executor).values for executor in ("processes", "threads")]
    assert values[0] == values[1]


CLAIMS_EXPIRE_AT_ONCE = """
import ss_flow.cache.claims as claims
claims.EXPIRY_SECONDS, claims._lives = 0.0, lambda pid, started: False
"""


@pytest.mark.parametrize("before", ["", CLAIMS_EXPIRE_AT_ONCE], ids=["claims hold", "claims expire"])
def test_several_processes_at_once_share_the_work_of_one_flow(store, before):
    many = "toy.total(toy.each(toy.source(values=tuple(map(float, range(40)))), build=toy.nap))"
    several = [start(store, many, before=before) for _ in range(4)]
    assert [process.communicate()[1] for process in several] == [""] * 4
    finished = [
        event["key"]
        for found in latest_runs(store.root / "roots" / "runs")
        for event in found.events()
        if event["event"] == "finished"
    ]
    assert len(set(finished)) == 42
    if not before:
        assert len(finished) == 42
    assert claims(store) == os.listdir(store.root / "tmp") == []


def test_two_threads_may_run_flows_at_once_on_one_store(store):
    reports = []
    threads = [threading.Thread(target=lambda: reports.append(run(store))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({json.dumps(report.values) for report in reports}) == 1
    assert sum(len(computed(report)) for report in reports) == 8


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_the_event_log_names_the_store_when_the_disk_is_full(store):
    log = Record(Path("/dev/full"), store.root)
    with pytest.raises(StoreFailure, match=f"store {store.root} cannot be written: No space left"):
        log.event("started", label="x")
