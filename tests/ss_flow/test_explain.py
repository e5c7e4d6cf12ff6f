"""Why a task runs: what changed since the call that differs from it least."""

from __future__ import annotations

from pathlib import Path

import pytest
import ss_flow_toy as toy
from toy_runs import run

from ss_flow import scheduler
from ss_flow.closure import Closure
from ss_flow.explain import first_difference, nearest
from ss_flow.graph import each, pick
from ss_flow.runs import latest_runs


def test_why_names_the_first_changed_part_and_runs_are_kept_in_order(store):
    run(store, toy.flow)
    report = run(store, lambda: toy.flow(limit=5.0))
    why = {n["label"]: n["why"] for n in report.nodes if n["event"] == "finished"}
    assert why["ss_flow_toy.clip[n2]"] == "parameter limit 100.0 -> 5.0"
    assert why["ss_flow_toy.total"] == "input xs changed (1 of 3 items: n2)"
    latest = next(latest_runs(store.root / "roots" / "runs", "toy"))
    assert next(latest.events())["event"] == "run started"


def test_why_looks_back_past_any_number_of_runs_that_did_not_reach_the_step(store):
    run(store, toy.flow)
    for _ in range(8):
        run(store, toy.flow, until="squares")
    report = run(store, lambda: toy.flow(limit=5.0))
    assert next(n["why"] for n in report.nodes if n["label"].endswith("clip[n2]")) == "parameter limit 100.0 -> 5.0"


def why_total(report) -> str:
    return next(n["why"] for n in report.nodes if n["label"] == "ss_flow_toy.total")


def squares_of(*values):
    names = [f"n{i}" for i in range(len(values))]
    return {"total": toy.total(each(toy.source(values=values), build=toy.square, names=names))}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ((1.0, 2.0, 3.0, 5.0), "(1 of 4 items: n3)"),
        ((0.0, 2.0, 0.0, 4.0), "(2 of 4 items: n0, n2)"),
        ((9.0, 8.0, 7.0, 6.0), "(4 of 4 items)"),
        ((1.0, 2.0), "(4 -> 2 items)"),
    ],
)
def test_why_names_the_items_of_a_list_that_changed(store, values, said):
    run(store, lambda: squares_of(1.0, 2.0, 3.0, 4.0))
    assert why_total(run(store, lambda: squares_of(*values))) == f"input xs changed {said}"


def test_why_numbers_the_items_of_a_list_that_have_no_names(store):
    run(store, lambda: {"total": toy.total(toy.source(values=(1.0, 2.0, 3.0)))})
    report = run(store, lambda: {"total": toy.total(toy.source(values=(1.0, 2.0, 4.0)))})
    assert why_total(report) == "input xs changed (1 of 3 items: 2)"


def test_why_names_the_items_of_a_part_of_a_list_as_the_whole_does(store):
    def flow(*values):
        names = [f"n{i}" for i in range(len(values))]
        squares = each(toy.source(values=values), build=toy.square, names=names)
        return {"total": toy.total(pick(squares, [1, 3]))}

    run(store, lambda: flow(1.0, 2.0, 3.0, 4.0))
    report = run(store, lambda: flow(1.0, 2.0, 3.0, 5.0))
    assert why_total(report) == "input xs changed (1 of 2 items: n3)"


def test_why_knows_no_items_when_the_store_has_lost_the_list(store):
    run(store, lambda: squares_of(1.0, 2.0))
    for part in store.parts():
        store.drop_part(part.name)
    assert why_total(run(store, lambda: squares_of(1.0, 3.0))) == "input xs changed"


@pytest.mark.parametrize("harm", [Path.unlink, lambda part: part.write_text('{"toy.other": "00"}')])
def test_why_names_no_definition_when_the_store_has_lost_which_there_were(store, monkeypatch, harm):
    run(store, toy.flow)
    for part in (store.root / "parts").iterdir():
        harm(part)
    edited = Closure({"toy.helper": "11"}, frozenset(), {})
    monkeypatch.setattr(scheduler, "kept_closure", lambda function, folder: edited)
    would = [node["why"] for node in run(store, toy.flow, dry=True).nodes if node["event"] == "would run"]
    assert set(would) == {"its code changed; which part of it is no longer known"}


def test_what_changed_is_not_known_where_the_record_of_the_last_time_is_gone(store):
    run(store, toy.flow)
    for entry in list(store.actions()):
        store.forget(entry.name)
    why = {n["step"]: n["why"] for n in run(store, lambda: toy.flow(limit=5.0)).nodes if n["event"] == "finished"}
    assert why["ss_flow_toy.source"] == "its result is no longer in the store"
    assert why["ss_flow_toy.clip"].startswith("what changed is not known")


@pytest.mark.parametrize(
    ("then", "now", "said"),
    [
        (1, 1.0, "1 -> 1.0"),
        (-0.0, 0.0, "-0.0 -> 0.0"),
        (True, 1, "True -> 1"),
        (1, "1", "1 -> '1'"),
        ({"a": 1}, {"a": 1.0}, "{'a': 1} -> "),
    ],
)
def test_values_that_only_python_takes_for_equal_are_told_apart(then, now, said):
    parts = {"task": {}, "code": {}, "packages": {}, "environment": {}, "inputs": {}}
    changed = first_difference({**parts, "parameters": {"x": then}}, {**parts, "parameters": {"x": now}})
    assert changed.startswith(f"parameter x {said}")
    same = {**parts, "parameters": {"x": float("nan"), "y": {"a": 1, "b": 2}}}
    assert first_difference(same, {**parts, "parameters": {"y": {"b": 2, "a": 1}, "x": float("nan")}}) == ""


def test_why_tells_what_changed_from_cause_to_effect():
    names = ("parameters", "code", "packages", "environment", "inputs")
    then, now = ({"task": n, **{name: {f"a_{name}": n} for name in names}} for n in (1, 2))
    said = []
    for name in ("task", *names):
        said.append(first_difference(then, now))
        then[name] = now[name]
    assert said == [
        "the format of keys changed",
        "parameter a_parameters 1 -> 2",
        "code of a_code changed",
        "package a_packages 1 -> 2",
        "a_environment of this machine 1 -> 2",
        "input a_inputs changed",
    ]
    assert first_difference(then, now) == ""
    without = {**then, "parameters": {}}
    assert first_difference(without, then) == "parameter a_parameters (absent) -> 2"
    assert first_difference(then, without) == "parameter a_parameters 2 -> (absent)"
    assert first_difference({**then, "code": {}}, then) == "code of a_code is new or gone"


def test_a_definition_that_has_fields_is_said_to_have_changed_in_fields_or_code():
    parts = {"task": {}, "parameters": {}, "packages": {}, "environment": {}, "inputs": {}}
    for name, what in (("Number", "fields or code"), ("square", "code"), ("helper", "code")):
        before, now = ({**parts, "code": {f"ss_flow_toy.{name}": digest}} for digest in "ab")
        assert first_difference(before, now) == f"{what} of ss_flow_toy.{name} changed"


def test_of_calls_that_differ_in_one_parameter_the_nearest_has_the_same_code():
    now = {"code": "a", "parameters": {"x": 1}, "packages": {}, "environment": {}, "inputs": {}}
    other, same_code = ({**now, "parameters": {"x": 2}, "code": code} for code in "ba")
    assert nearest([other, same_code], now) is same_code


def test_of_long_values_why_shows_where_they_differ():
    parts = {"task": {}, "code": {}, "packages": {}, "environment": {}, "inputs": {}}
    then, now = list(range(1000)), [*range(990), 1, *range(991, 1000)]
    changed = first_difference({**parts, "parameters": {"x": then}}, {**parts, "parameters": {"x": now}})
    old, new = changed.removeprefix("parameter x ").split(" -> ")
    assert "989, 990, 991" in old and "989, 1, 991" in new and max(len(old), len(new)) <= 60
    whole = ["a" * 59 + end for end in "bc"]
    changed = first_difference(*({**parts, "parameters": {"x": text}} for text in whole))
    assert changed == f"parameter x {whole[0]} -> {whole[1]}"


def test_why_compares_a_call_with_that_one_of_its_label_that_it_differs_from_least(store):
    def flow(limit):
        xs = toy.source(values=(1.0, 2.0, 3.0))
        return {"a": toy.clip(xs[0], limit=limit), "b": toy.clip(xs[1], limit=limit), "c": toy.clip(xs[2], limit=7.0)}

    run(store, lambda: flow(3.0))
    report = run(store, lambda: flow(4.0))
    assert {n["why"] for n in report.nodes if n["event"] == "finished"} == {"parameter limit 3.0 -> 4.0"}

    def other(value):
        xs = toy.source(values=(1.0, value))
        return {"a": toy.clip(xs[0], limit=5.0), "b": toy.clip(xs[1], limit=6.0)}

    run(store, lambda: other(2.0))
    report = run(store, lambda: other(3.0))
    assert [n["why"] for n in report.nodes if n["step"] == "ss_flow_toy.clip" and "why" in n] == ["input x changed"]
