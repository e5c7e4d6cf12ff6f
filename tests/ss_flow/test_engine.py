"""What a run of a flow computes, what it finds, and what it says meanwhile."""

from __future__ import annotations

import json
import os
import shutil
import threading

import pytest
import ss_flow_toy as toy
from toy_runs import ran, run, value

from ss_flow.cache.store import Store
from ss_flow.events import Reporter
from ss_flow.graph import each, pick


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_a_flow_gives_the_same_result_on_every_executor(store, executor):
    report = run(store, toy.flow, executor=executor)
    assert value(store, report.values["total"]) == 14.0
    assert [value(store, d) for d in report.values["squares"]] == [1.0, 4.0, 9.0]


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_a_bundle_is_taken_apart_into_inputs_and_put_together_for_the_task(store, executor):
    def flow(last: float = 3.0):
        xs = toy.source(values=(1.0, 2.0, last))
        return {"total": toy.shifted_total(toy.Pair(xs[0], [xs[1], xs[0]]), xs[0], by=0.5)}

    report = run(store, flow, executor=executor)
    assert value(store, report.values["total"]) == 1 + 2 + 1 + 1 + 0.5
    inputs = store.action(report.nodes[-1]["key"]).components["inputs"]
    assert list(inputs) == ["pair.one", "pair.rest", "more"]
    assert ran(run(store, lambda: flow(last=4.0), executor=executor)) == ["ss_flow_toy.source"]
    assert float(toy.shifted_total(toy.Pair(toy.number(1), [toy.number(2)]), toy.number(3), by=0.0).value[0]) == 6


def test_an_event_names_the_steps_that_its_inputs_come_from(store):
    def flow():
        squares = each(toy.source(values=(1.0, 2.0)), build=toy.square)
        return {"total": toy.total(pick(squares, [1])), "half": toy.half(squares[0])}

    told = {node["label"]: set(node["inputs"].values()) for node in run(store, flow).nodes if "inputs" in node}
    assert told["ss_flow_toy.total"] == told["ss_flow_toy.half"] == {"ss_flow_toy.square"}
    assert told["ss_flow_toy.square[0]"] == {"ss_flow_toy.source"}


def test_a_second_run_computes_nothing(store):
    run(store, toy.flow)
    again = run(store, toy.flow)
    assert ran(again) == []
    assert len(again.nodes) == 8


def test_a_changed_parameter_recomputes_only_what_depends_on_it(store):
    run(store, toy.flow)
    expected = {*(f"ss_flow_toy.clip[n{i}]" for i in range(3)), "ss_flow_toy.total"}
    assert set(ran(run(store, lambda: toy.flow(limit=5.0)))) == expected


def test_a_recomputation_with_an_equal_result_stops_there(store):
    run(store, toy.flow)
    report = run(store, lambda: toy.flow(limit=50.0))
    assert sorted(ran(report)) == [f"ss_flow_toy.clip[n{i}]" for i in range(3)]


def test_a_changed_item_recomputes_only_its_own_branch(store):
    run(store, toy.flow)
    report = run(store, lambda: toy.flow(values=(1.0, 2.0, 5.0)))
    assert ran(report) == ["ss_flow_toy.source", "ss_flow_toy.square[n2]", "ss_flow_toy.clip[n2]", "ss_flow_toy.total"]


def test_until_runs_only_what_the_named_output_needs(store):
    report = run(store, toy.flow, until="squares")
    assert "ss_flow_toy.total" not in ran(report)
    assert list(report.values) == ["squares"]


def test_a_dry_run_names_what_would_run_and_computes_nothing(store):
    run(store, toy.flow)
    half = store.root / "tmp" / ("ab" * 16)
    half.write_text("x")
    os.utime(half, (0, 0))
    report = run(store, lambda: toy.flow(limit=5.0), dry=True)
    assert half.exists()
    would = [n for n in report.nodes if n["event"] == "would run"]
    assert {n["label"] for n in would} == {f"ss_flow_toy.clip[n{i}]" for i in range(3)}
    assert would[0]["why"] == "parameter limit 100.0 -> 5.0"
    assert ran(report) == []


def test_a_flow_may_grow_as_long_as_its_results_say_so(store):
    report = run(store, lambda: {"end": toy.halving(toy.source(values=(20.0,))[0])})
    assert value(store, report.values["end"]) == 0.625
    assert len(ran(report)) == 6


def test_an_isolated_task_runs_in_a_process_of_its_own(store):
    report = run(store, lambda: {"pid": toy.own_process(toy.source(values=(1.0,))[0])})
    assert value(store, report.values["pid"]) != os.getpid()


def test_the_same_key_is_computed_once_for_all_its_nodes(store):
    def build():
        numbers = toy.source(values=(3.0, 3.0))
        return {"squares": each(numbers, build=toy.square)}

    report = run(store, build)
    assert len(ran(report)) == 2  # the source, and one square
    assert len(report.values["squares"]) == 2


def test_two_runs_at_once_compute_every_key_once(tmp_path):
    class Count(Reporter):
        started = 0

        def event(self, kind, **details):
            Count.started += kind == "started"

    reports = []
    stores = [Store(tmp_path / "store") for _ in range(2)]
    threads = [threading.Thread(target=lambda s=s: reports.append(run(s, toy.flow, reporter=Count()))) for s in stores]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert Count.started == 8
    assert reports[0].values == reports[1].values


def test_progress_of_a_task_reaches_the_reporter(store):
    heard = []

    class Listen(Reporter):
        def progressed(self, label, done, total, note):
            heard.append((label, done, total, note))

    run(store, toy.flow, reporter=Listen())
    assert heard == [("ss_flow_toy.total", 1, 1, "adding")]


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_a_task_that_changes_what_it_is_given_changes_it_for_no_other(store, executor):
    def build():
        table = toy.table()
        return {"count": toy.counted(table, toy.spoilt(table))}

    report = run(store, build, executor=executor)
    assert store.get(report.values["count"]).value[0] == 11


def test_a_result_gone_from_the_store_is_computed_again(store):
    report = run(store, toy.flow)
    shutil.rmtree(store.object_path(report.values["total"]))
    again = run(store, toy.flow)
    assert ran(again) == ["ss_flow_toy.total"]
    assert again.values == report.values
    assert json.loads(json.dumps(again.nodes[-1]))["why"] == "its result is no longer in the store"
