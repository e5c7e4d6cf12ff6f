"""Many values of a flow's parameters, run as one graph."""

from __future__ import annotations

import pytest
import ss_flow_toy as toy
from hypothesis import example, given
from hypothesis import strategies as st

from ss_flow.engine import Request, run_flow, run_flows
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.resolution import Failure
from ss_flow.runs import latest_runs
from ss_flow.sweep import grid, sweep, values_of, zipped


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0.5", ["0.5"]),
        ("1, 2,3", ["1", "2", "3"]),
        ("mvs,sensor", ["mvs", "sensor"]),
        ("0.5:0.9:5", ["0.5", "0.6", "0.7", "0.8", "0.9"]),
        ("3:1:3", ["3", "2", "1"]),
        ("-1:1:3", ["-1", "0", "1"]),
        ("0.001:0.1:3log", ["0.001", "0.01", "0.1"]),
        ("1:1000:4log", ["1", "10", "100", "1000"]),
        ("0:1:3,5", ["0", "0.5", "1", "5"]),
    ],
)
def test_a_text_lists_values_or_spreads_them_over_a_range(text, values):
    assert values_of(text) == values


def test_values_that_hold_commas_are_listed_with_another_separator():
    assert values_of("1,2;3", separator=";") == ["1,2", "3"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "has an empty value"),
        ("1,,2", "has an empty value"),
        ("1,", "has an empty value"),
        ("0:1:x", "is no range; write lo:hi:n"),
        ("a:b:3", "is no range; write lo:hi:n"),
        ("0:1:2.5", "is no range; write lo:hi:n"),
        ("0:1:1", "at least 2 values"),
        ("0:1:-3", "at least 2 values"),
        ("0:inf:3", "two finite ends"),
        ("0:1:99999999", "at most 10,000 values"),
        ("0:1:3log", "must be above 0"),
        ("-1:1:3log", "must be above 0"),
    ],
)
def test_a_bad_list_is_refused_with_one_sentence(text, says):
    with pytest.raises(InputError, match=says) as refused:
        values_of(text)
    assert str(refused.value).endswith(".") and "\n" not in str(refused.value)


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 30), st.booleans())
@example(100000.6640625, 100000.6640625, 4, False)  # half way between two numbers of 12 digits
def test_a_range_has_as_many_values_as_it_says_and_both_its_ends(low, high, count, log):
    values = [float(text) for text in values_of(f"{low!r}:{high!r}:{count}{'log' if log else ''}")]
    assert len(values) == count
    assert (values[0], values[-1]) == (pytest.approx(low, rel=1e-9), pytest.approx(high, rel=1e-9))
    assert values in (sorted(values), sorted(values, reverse=True))


def test_a_grid_has_every_combination_and_the_last_name_varies_fastest():
    assert grid({"a": [1, 2], "b": ["x", "y"]}) == [
        {"a": 1, "b": "x"},
        {"a": 1, "b": "y"},
        {"a": 2, "b": "x"},
        {"a": 2, "b": "y"},
    ]


def test_zipped_lists_go_together_and_must_be_equally_long():
    assert zipped({"a": [1, 2], "b": ["x", "y"]}) == [{"a": 1, "b": "x"}, {"a": 2, "b": "y"}]
    with pytest.raises(InputError, match=r"equally many, but a has 2, b has 1\.$"):
        zipped({"a": [1, 2], "b": ["x"]})


def total(store, row):
    return float(store.get(row.report.values["total"]).value[0])


def test_what_variants_share_is_computed_once_and_counts_for_the_first_of_them(store):
    rows = sweep(toy.flow, grid({"limit": [1.0, 2.0, 4.0]}), store, scene="toy")
    assert [dict(row.values) for row in rows] == [{"limit": 1.0}, {"limit": 2.0}, {"limit": 4.0}]
    assert [total(store, row) for row in rows] == [3.0, 5.0, 9.0]
    assert [(row.hits, row.misses) for row in rows] == [(0, 8), (4, 4), (4, 4)]
    assert sum(row.misses for row in rows) == len(list(store.actions()))
    assert rows[0].seconds == pytest.approx(sum(n["seconds"] for n in rows[0].report.nodes))


def test_a_second_sweep_computes_only_the_new_variants(store):
    sweep(toy.flow, grid({"limit": [1.0, 2.0]}), store, scene="toy")
    rows = sweep(toy.flow, grid({"limit": [1.0, 2.0, 4.0]}), store, scene="toy")
    assert [row.misses for row in rows] == [0, 0, 4]
    assert rows[0].seconds == rows[1].seconds == 0


def test_a_variant_that_fails_leaves_the_others_alone(store):
    def build(value):
        return {"total": toy.half(toy.source(values=(value,))[0])}

    good, bad = sweep(build, grid({"value": [4.0, -4.0]}), store, scene="toy")
    assert total(store, good) == 2.0
    assert isinstance(bad.report.values["total"], Failure)
    assert (bad.hits, bad.misses) == (0, 1)


def test_an_interrupted_sweep_goes_on_where_it_was(store):
    class Interrupt(Reporter):
        finished = 0

        def event(self, kind, **details):
            self.finished += kind == "finished"
            if self.finished == 6:
                raise KeyboardInterrupt

    variants = grid({"limit": [1.0, 2.0, 4.0]})
    interrupt = Interrupt()
    with pytest.raises(KeyboardInterrupt):
        run_flows([Request(lambda v=v: toy.flow(**v), "toy", reporter=interrupt) for v in variants], store, jobs=1)
    there = len(list(store.actions()))
    assert 6 <= there < 16
    rows = sweep(toy.flow, variants, store, scene="toy")
    assert sum(row.misses for row in rows) == 16 - there
    assert [total(store, row) for row in rows] == [3.0, 5.0, 9.0]


def test_a_variant_is_compared_with_its_scene_and_recorded_apart_from_it(store):
    run_flow(lambda: toy.flow(limit=100.0), store, scene="toy")
    rows = sweep(toy.flow, grid({"limit": [5.0]}), store, scene="toy")
    why = {node["label"]: node["why"] for node in rows[0].report.nodes if node["event"] == "finished"}
    assert why["ss_flow_toy.clip[n0]"] == "parameter limit 100.0 -> 5.0"
    runs = store.root / "roots" / "runs"
    assert [run.header.get("sweep") for run in latest_runs(runs, "toy")] == [None]
    assert [run.header["sweep"] for run in latest_runs(runs, "toy [limit=5.0]")] == [{"limit": "5.0"}]


def test_a_flow_of_which_nothing_is_told_is_not_told_of_pauses(store):
    class Count(Reporter):
        def __init__(self):
            self.pauses = 0

        def pause(self):
            self.pauses += 1

    def slowly():
        values = toy.source(values=(2.0,))
        return {"last": toy.square(toy.square(toy.square(values[0])))}

    first, second = Count(), Count()
    run_flows([Request(slowly, "one", reporter=first), Request(lambda: {}, "two", reporter=second)], store)
    assert first.pauses >= 4 and second.pauses == 0


def test_several_parameters_may_go_together(store):
    rows = sweep(toy.flow, zipped({"limit": [1.0, 2.0], "values": [(1.0,), (3.0,)]}), store, scene="growth")
    assert [total(store, row) for row in rows] == [1.0, 2.0]
