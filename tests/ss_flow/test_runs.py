"""Records of runs: their folders, their order, and what becomes of damaged ones."""

from __future__ import annotations

import json
import random
import time
from pathlib import Path

import pytest
import ss_flow_toy as toy
from aged_store import age_all
from toy_runs import run

from ss_flow import runs
from ss_flow.engine import Request, run_flow, run_flows
from ss_flow.graph import stored
from ss_flow.runs import latest_runs
from ss_flow.telemetry import trace


@pytest.mark.parametrize("name", ["x" * 300, "\u5199" * 100, "\u00e9" * 100], ids=["long", "3 bytes", "2 bytes"])
def test_the_folder_of_a_run_has_a_name_that_file_systems_take(store, name):
    run_flow(lambda: {}, store, scene=f"/scenes/{name}")
    (found,) = latest_runs(store.runs)
    assert found.scene == f"/scenes/{name}"
    assert name[:30] in found.folder.name and len(found.folder.name.encode()) <= 130


@pytest.mark.parametrize(
    "content",
    [
        *("{}", "[]", "{", '"scene"', '{"scene": "toy"}', '{"scene": "toy", "started": "x"}'),
        *(f'{{"scene": "toy", "started": 1, "number": {number}}}' for number in ('"x"', "null", "1e999", "NaN")),
    ],
)
def test_a_run_whose_record_is_damaged_is_passed_over(store, content):
    first = run(store, toy.flow)
    folder = store.runs / "damaged"
    folder.mkdir()
    (folder / "run.json").write_text(content)
    assert run(store, toy.flow).values == first.values
    assert folder not in [one.folder for one in latest_runs(store.runs)]


def test_a_run_whose_clock_was_ahead_is_the_latest_only_until_the_next(store, monkeypatch):
    with monkeypatch.context() as ahead:
        ahead.setattr(runs.time, "time", lambda: 4e9)
        run(store, lambda: toy.flow(limit=5.0))
    for limit in (6.0, 7.0):
        run(store, lambda limit=limit: toy.flow(limit=limit))
    keys = [{node["key"] for node in one.nodes()} for one in latest_runs(store.runs, "toy")]
    again = run(store, lambda: toy.flow(limit=7.0))
    assert {node["key"] for node in again.nodes} == keys[0] and len(keys) == 3
    assert [one.header["started"] > 3e9 for one in latest_runs(store.runs)] == [False, False, False, True]


def test_runs_of_a_store_without_numbers_are_in_the_order_of_their_times_and_before_all_others(store):
    for started in (2, 3, 1):
        folder = store.runs / str(started)
        folder.mkdir(parents=True)
        (folder / "run.json").write_text(json.dumps({"scene": "toy", "started": started * 1e10}))
    run(store, toy.flow)
    assert [one.folder.name for one in latest_runs(store.runs)][1:] == ["3", "2", "1"]


def test_the_records_of_earlier_runs_are_read_once_for_all_flows(store, monkeypatch):
    requests = [Request(toy.flow, scene) for scene in ("one", "two", "three")]
    run_flows(requests, store)
    read, of_path = [], Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path, **how: read.append(path.name) or of_path(path, **how))
    run_flows(requests, store)
    assert read.count("run.json") == 3
    assert [one.place[0] for one in latest_runs(store.runs)] == [2, 2, 2, 1, 1, 1]


def test_a_damaged_event_log_keeps_no_later_run_from_its_work(store):
    values = run(store, toy.flow).values
    whole = next(latest_runs(store.runs))
    log = whole.folder / "events.jsonl"
    good, rng = log.read_bytes(), random.Random(0)
    for _ in range(200):
        damaged = bytearray(good)
        damaged[rng.randrange(len(good))] ^= 1 << rng.randrange(8)
        log.write_bytes(b"null\n[]\n{}\n" + damaged)
        assert 6 <= len(whole.nodes()) <= 8 and trace(whole)
        whole.results(), whole.taken()
    assert run(store, toy.flow).values == values


def test_folders_in_the_place_of_the_files_of_a_run_are_passed_over(store):
    run(store, toy.flow)
    made = next(latest_runs(store.runs))
    for name in ("events.jsonl", "run.json"):
        (made.folder / name).unlink()
        (made.folder / name).mkdir()
    assert made.nodes() == list(latest_runs(store.runs)) == []


def test_a_cut_last_line_of_the_event_log_is_left_out(store):
    run(store, toy.flow)
    latest = next(latest_runs(store.root / "roots" / "runs"))
    with (latest.folder / "events.jsonl").open("a") as stream:
        stream.write('{"event": "fini')
    assert len(latest.nodes()) == 8


def test_a_result_that_is_taken_from_another_run_counts_as_used_and_is_in_the_record_of_the_run(store):
    digests = run(store, toy.flow).values["squares"]
    age_all(store.root)

    def build():
        return {"total": toy.total(stored("earlier", digests)), "first": toy.square(stored("one", digests[0]))}

    run(store, build)
    (made, *_) = latest_runs(store.runs, "toy")
    assert made.taken() == set(digests)
    used = {entry.name: entry.used for entry in store.objects()}
    assert all(time.time() - used[name] < 600 for name in digests)
