from __future__ import annotations

import errno
import json
import os
import random
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import ss_flow_toy as toy
from aged_store import age_all

from ss_flow import engine, keys, runs, scheduler
from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.store import Store
from ss_flow.closure import Closure, closure_of
from ss_flow.engine import Request, run_flow, run_flows
from ss_flow.events import Reporter
from ss_flow.execute import Invocation
from ss_flow.explain import first_difference, nearest
from ss_flow.graph import INDEX, Flow, each, expand, gather, labelled, otherwise, pick, stored
from ss_flow.jobs import Job, Tokens
from ss_flow.keys import Keys
from ss_flow.resolution import Failure
from ss_flow.running import Surroundings, running, save_checkpoint
from ss_flow.runs import latest_runs
from ss_flow.task import Resources, task
from ss_flow.telemetry import trace


def run(store, build, **kwargs):
    return run_flow(build, store, scene="toy", header={}, **kwargs)


def ran(report):
    return [n["label"] for n in report.nodes if n["event"] == "finished"]


def value(store, digest):
    return float(store.get(digest).value[0])


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_a_flow_gives_the_same_result_on_every_executor(store, executor):
    report = run(store, toy.flow, executor=executor)
    assert value(store, report.values["total"]) == 14.0
    assert [value(store, d) for d in report.values["squares"]] == [1.0, 4.0, 9.0]


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_a_sequence_is_read_item_by_item(store, executor):
    def flow():
        return {"total": toy.streamed_total(toy.source(values=(1.0, 2.0, 3.0)))}

    report = run(store, flow, executor=executor)
    assert value(store, report.values["total"]) == (1 + 2 + 3) + (1 + 3) + 3


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_a_bundle_is_taken_apart_into_inputs_and_put_together_for_the_task(store, executor):
    def flow(last: float = 3.0):
        xs = toy.source(values=(1.0, 2.0, last))
        return {"total": toy.shifted_total(toy.Pair(xs[0], [xs[1], xs[0]]), xs[0], by=0.5)}

    report = run(store, flow, executor=executor)
    assert value(store, report.values["total"]) == 1 + 2 + 1 + 1 + 0.5
    inputs = store.action(report.nodes[-1]["key"]).components["inputs"]
    assert list(inputs) == ["pair.one", "pair.rest", "more"]
    assert "shifted_total" not in ran(run(store, lambda: flow(last=4.0), executor=executor))
    assert float(toy.shifted_total(toy.Pair(toy.number(1), [toy.number(2)]), toy.number(3), by=0.0).value[0]) == 6


def test_who_gets_some_of_a_list_does_not_depend_on_the_others(store):
    def flow(*values: float):
        xs = toy.source(values=values)
        return {"total": toy.total(pick(xs, [2, 0]))}

    assert value(store, run(store, lambda: flow(1.0, 2.0, 4.0)).values["total"]) == 5
    assert ran(run(store, lambda: flow(1.0, 3.0, 4.0, 8.0))) == ["ss_flow_toy.source"]


def test_an_event_names_the_steps_that_its_inputs_come_from(store):
    def flow():
        squares = each(toy.source(values=(1.0, 2.0)), build=toy.square)
        return {"total": toy.total(pick(squares, [1])), "half": toy.half(squares[0])}

    told = {node["label"]: set(node["inputs"].values()) for node in run(store, flow).nodes if "inputs" in node}
    assert told["ss_flow_toy.total"] == told["ss_flow_toy.half"] == {"ss_flow_toy.square"}
    assert told["ss_flow_toy.square[0]"] == {"ss_flow_toy.source"}


def test_each_hands_out_positions(store):
    def flow():
        return {"clipped": each(toy.source(values=(5.0, 5.0)), INDEX, build=lambda x, i: toy.clip(x, limit=float(i)))}

    report = run(store, flow)
    assert [value(store, digest) for digest in report.values["clipped"]] == [0.0, 1.0]


def test_positions_alone_have_no_length_and_are_refused_at_the_call(store):
    with pytest.raises(TypeError, match="INDEX alone says no length"):
        run(store, lambda: {"all": each(INDEX, build=lambda i: toy.number(i))})


def test_an_item_that_is_lost_while_a_sequence_is_read_is_computed_again(store):
    first = run(store, lambda: {"xs": toy.source(values=(1.0, 2.0, 3.0))})
    path = store.object_path(first.values["xs"][1])
    damaged = next(path.rglob("c.*"), None) or next(p for p in path.rglob("*") if p.is_file())
    damaged.write_bytes(b"")
    report = run(Store(store.root), lambda: {"total": toy.streamed_total(toy.source(values=(1.0, 2.0, 3.0)))})
    assert value(store, report.values["total"]) == 13.0


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


def test_a_failed_item_fails_what_depends_on_it_and_nothing_else(store):
    def build():
        numbers = toy.source(values=(4.0, -1.0))
        return {"total": toy.total(each(numbers, build=toy.half)), "square": toy.square(numbers[1])}

    report = run(store, build)
    assert isinstance(report.values["total"], Failure)
    assert value(store, report.values["square"]) == 1.0
    assert [f.label for f in report.failures] == ["ss_flow_toy.half[1]"]
    (follows,) = (node for node in report.nodes if node["event"] == "skipped")
    assert (follows["label"], follows["because"]) == ("ss_flow_toy.total", "ss_flow_toy.half[1]")


def test_what_is_picked_of_a_list_that_failed_fails_as_it_did(store):
    def build():
        halves = each(toy.source(values=(4.0, -1.0)), build=toy.half)
        return {"one": toy.square(halves[0]), "some": toy.total(pick(halves, [0]))}

    report = run(store, build)
    assert {report.values[name].label for name in ("one", "some")} == {"ss_flow_toy.half[1]"}
    assert [failure.label for failure in report.failures] == ["ss_flow_toy.half[1]"]


def test_with_on_error_skip_the_run_goes_on_without_the_failed_item(store):
    def build():
        return {"total": toy.total(each(toy.source(values=(4.0, -1.0)), build=toy.half, on_error="skip"))}

    report = run(store, build)
    assert value(store, report.values["total"]) == 2.0
    assert len(report.failures) == 1


def test_when_every_item_failed_the_list_failed(store):
    def build():
        return {"total": toy.total(each(toy.source(values=(-4.0, -1.0)), build=toy.half, on_error="skip"))}

    assert isinstance(run(store, build).values["total"], Failure)


def test_what_stands_in_for_a_failed_node_is_computed_only_where_it_failed(store):
    def build():
        good, bad = (toy.source(values=(v,))[0] for v in (4.0, -1.0))
        spare = toy.source(values=(9.0,))[0]
        return {
            "good": otherwise(toy.half(good), lambda: toy.square(spare)),
            "bad": otherwise(toy.half(bad), lambda: toy.square(spare)),
        }

    report = run(store, build)
    assert [value(store, report.values[name]) for name in ("good", "bad")] == [2.0, 81.0]
    assert [failure.label for failure in report.failures] == ["ss_flow_toy.half"]
    assert sum(node["step"] == "ss_flow_toy.square" for node in report.nodes) == 1


def test_a_dry_run_replaces_nothing_and_leaves_nothing_out(store):
    def build():
        known = toy.half(toy.source(values=(4.0,))[0])
        both = each(toy.source(values=(4.0, 6.0)), build=toy.half, on_error="skip")
        return {"known": known, "total": toy.total(both), "spared": otherwise(toy.half(known), lambda: known)}

    run(store, lambda: {"known": build()["known"], "source": toy.source(values=(4.0, 6.0))})
    report = run(store, build, dry=True)
    would = [node["label"] for node in report.nodes if node["event"] == "would run"]
    assert would == ["ss_flow_toy.half", "ss_flow_toy.half[1]"]
    assert isinstance(report.values["total"], Failure)
    assert isinstance(report.values["spared"], Failure)


def test_an_isolated_task_runs_in_a_process_of_its_own(store):
    import os

    report = run(store, lambda: {"pid": toy.own_process(toy.source(values=(1.0,))[0])})
    assert value(store, report.values["pid"]) != os.getpid()


def test_a_task_that_aborts_fails_alone_and_says_how(store):
    report = run(store, lambda: {"end": toy.abort(toy.source(values=(1.0,))[0])})
    assert isinstance(report.values["end"], Failure)
    assert "SIGABRT" in str(report.values["end"].error)


@pytest.mark.parametrize(
    ("ready", "shares"), [(1, [8]), (2, [4, 4]), (3, [2, 3, 3]), (5, [1, 1, 2, 2, 2]), (8, [1] * 8)]
)
def test_jobs_that_are_ready_at_once_share_the_cores_fairly(ready, shares):
    tokens = Tokens(Resources(cores=8, memory_mb=1000))
    wanted = Resources(cores=1, most_cores=8, memory_mb=1)
    given = []
    for place in range(ready):
        job = Job(Invocation(str(place), "", "", {}, {}, {}, wanted, False, ""), [], "", (0, 0))
        tokens.take(job, waiting=ready - 1 - place)
        given.append(job.invocation.resources.cores)
    assert given == shares


def test_the_last_task_that_waits_gets_the_cores_that_nobody_wants(store):
    def flow():
        one, two, three = (toy.source(values=(v,))[0] for v in (1.0, 2.0, 3.0))
        return {"alone": toy.given_cores(one)}, {"first": toy.given_cores(two), "last": toy.given_cores(three)}

    alone = run(store, lambda: flow()[0], jobs=3)
    assert value(store, alone.values["alone"]) == 3
    both = run(store, lambda: flow()[1], jobs=3)
    assert sorted(value(store, d) for d in both.values.values()) == [1, 2]


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_half_done_work_is_kept_until_the_task_is_done(store, tmp_path, executor):
    falls_at = tmp_path / "falls_at"
    falls_at.write_text("3")

    def flow():
        return {"start": toy.climb(toy.source(values=(1.0,))[0], top=5, falls_at=str(falls_at))}

    failed = run(store, flow, executor=executor)
    assert isinstance(failed.values["start"], Failure)
    falls_at.unlink()
    assert value(store, run(store, flow, executor=executor).values["start"]) == 3
    assert not list((store.root / "checkpoints").iterdir())


def test_a_damaged_checkpoint_is_as_good_as_none(store, tmp_path):
    falls_at = tmp_path / "falls_at"
    falls_at.write_text("3")

    def flow():
        return {"start": toy.climb(toy.source(values=(1.0,))[0], top=5, falls_at=str(falls_at))}

    run(store, flow)
    (kept,) = (store.root / "checkpoints").iterdir()
    content = bytearray(kept.read_bytes())
    content[60] ^= 1
    kept.write_bytes(bytes(content))
    falls_at.unlink()
    assert value(store, run(store, flow).values["start"]) == 0


def test_a_store_that_was_moved_away_is_not_there_again_for_a_checkpoint(tmp_path):
    with running(Surroundings(checkpoint=tmp_path / "moved" / "checkpoints" / "kept.npz")):
        save_checkpoint({"x": np.ones(2)})
    assert not (tmp_path / "moved").exists()


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


def test_an_interrupted_run_keeps_what_was_finished_and_ends_its_claims(store):
    class Interrupt(Reporter):
        def event(self, kind, **details):
            if kind == "started" and "slow" in details["label"]:
                raise KeyboardInterrupt

    numbers = lambda: {"slow": toy.slow(toy.square(toy.source(values=(2.0,))[0]))}  # noqa: E731
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run(store, numbers, reporter=Interrupt())
    assert time.monotonic() - started < 5
    assert list((store.root / "claims").iterdir()) == []
    assert ran(run(store, lambda: {"square": toy.square(toy.source(values=(2.0,))[0])})) == []


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


def test_a_record_does_not_grow_with_the_lists_that_go_in_and_a_list_is_kept_once(store):
    def totals(count):
        numbers = toy.source(values=tuple(float(i) for i in range(count)))
        with labelled("plain"):
            plain = toy.total(numbers)
        with labelled("streamed"):
            return {"plain": plain, "streamed": toy.streamed_total(numbers)}

    sizes = []
    for count in (3, 300):
        report = run(store, lambda count=count: totals(count))
        keys = [n["key"] for n in report.nodes if n["step"] != "ss_flow_toy.source"]
        sizes.append([store.action_path(key).stat().st_size for key in keys])
        inputs = {store.action(key).components["inputs"]["xs"] for key in keys}
        (digest_of_list,) = inputs
        source = next(n for n in report.nodes if n["step"] == "ss_flow_toy.source")
        assert store.part(digest_of_list) == source["outputs"] and len(source["outputs"]) == count
        sizes[-1].sort()
    assert all(abs(few - many) < 20 for few, many in zip(*sizes, strict=True)), sizes


def test_lists_that_differ_only_in_order_or_length_have_other_keys():
    keys = Keys()
    lists = [("aa", "bb"), ("bb", "aa"), ("aa",), ("aa", "bb", "bb"), ("aabb",), ()]
    assert len({keys.key(toy.total, {"xs": each_list}, {}) for each_list in lists}) == len(lists)
    assert keys.key(toy.total, {"xs": ("aa",)}, {}) != keys.key(toy.total, {"xs": "aa"}, {})


@dataclass(frozen=True)
class Linear:
    slope: float = 1.0


@dataclass(frozen=True)
class Square(Linear):
    pass


@dataclass(frozen=True)
class Nothing:
    pass


@dataclass(frozen=True)
class Holder:
    one: Linear | Nothing
    many: tuple[Linear, ...] = ()


@task()
def modelled(
    *,
    base: Linear = Linear(),
    union: Linear | Holder | None = None,
    several: tuple[Linear, ...] | None = None,
    empty: Nothing | None = None,
) -> Linear:
    return Linear()


def test_the_class_of_a_parameter_counts_where_its_declared_type_does_not_tell_it():
    given = [
        {},
        {"base": Square()},
        {"union": Linear()},
        {"union": Square()},
        {"union": Holder(Linear())},
        {"union": Holder(Square())},
        {"union": Holder(Nothing())},
        {"union": Holder(Nothing(), (Linear(),))},
        {"union": Holder(Nothing(), (Square(),))},
        {"several": (Linear(),)},
        {"several": (Square(),)},
        {"empty": Nothing()},
    ]
    assert len({Keys().key(modelled, {}, one) for one in given}) == len(given)
    parts = [Keys().components(modelled, {}, one)["parameters"] for one in ({"base": Linear()}, {"base": Square()})]
    code = digest(closure_of(Square).definitions)[:32]
    assert parts == [{"base.slope": 1.0}, {"base": f"{__name__}.Square (code {code})", "base.slope": 1.0}]
    assert Keys().components(modelled, {}, {"several": (Linear(2.0),)})["parameters"] == {"several.0.slope": 2.0}


def test_the_code_of_a_parameter_counts_where_its_declared_type_does_not_name_it(monkeypatch):
    given = ({"base": Linear()}, {"union": Linear()}, {"base": Square()})
    before = [Keys().key(modelled, {}, one) for one in given]
    edited = Closure({"Square": "edited"}, frozenset(), {})
    monkeypatch.setattr(keys, "closure_of", lambda of: edited if of is Square else closure_of(of))
    assert [Keys().key(modelled, {}, one) == key for one, key in zip(given, before, strict=True)] == [True, True, False]


def test_a_parameter_that_two_tasks_share_has_the_same_keys_whoever_comes_first():
    shared = Linear(2.0)
    calls = [{"base": shared}, {"union": shared}]
    one, other = Keys(), Keys()
    found = {one.key(modelled, {}, call) for call in calls} | {other.key(modelled, {}, call) for call in calls[::-1]}
    assert len(found) == 2


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


def test_a_store_that_can_only_be_read_ends_the_run_with_one_sentence(store, monkeypatch):
    run(store, toy.flow)
    refused = OSError(errno.EROFS, os.strerror(errno.EROFS))
    monkeypatch.setattr(Path, "touch", lambda *_, **__: (_ for _ in ()).throw(refused))
    assert set(ran(run(store, toy.flow, recorded=False))) == set()
    monkeypatch.setattr(engine, "start_run", lambda *_: (_ for _ in ()).throw(refused))
    with pytest.raises(StoreFailure, match="cannot be written: Read-only file system"):
        run(store, toy.flow)


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


@pytest.mark.parametrize("executor", ["mixed", "threads", "processes"])
def test_a_task_that_changes_what_it_is_given_changes_it_for_no_other(store, executor):
    def build():
        table = toy.table()
        return {"count": toy.counted(table, toy.spoilt(table))}

    report = run(store, build, executor=executor)
    assert store.get(report.values["count"]).value[0] == 11


def test_a_result_gone_from_the_store_is_computed_again(store):
    import shutil

    report = run(store, toy.flow)
    shutil.rmtree(store.object_path(report.values["total"]))
    again = run(store, toy.flow)
    assert ran(again) == ["ss_flow_toy.total"]
    assert again.values == report.values
    assert json.loads(json.dumps(again.nodes[-1]))["why"] == "its result is no longer in the store"


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


class Mute(Exception):
    def __str__(self):
        raise ValueError


@task()
def muted(x: toy.Number) -> toy.Number:
    raise Mute


def test_an_error_that_cannot_be_told_fails_its_node_alone(store):
    report = run(store, lambda: {"x": muted(toy.source(values=(1.0,))[0])})
    assert [type(failure.error) for failure in report.failures] == [Mute]


def test_a_numpy_scalar_counts_as_the_number_that_it_is(store):
    first = run(store, lambda: toy.flow(limit=5.0))
    assert ran(run(store, lambda: toy.flow(limit=np.float64(5.0)))) == []
    assert ran(run(store, lambda: toy.flow(values=(np.float64(1.0), 2, np.float32(3.0)))))
    assert first.failures == []


@pytest.mark.parametrize("value", [np.zeros(2), b"bytes", {"a": (1, np.zeros(2))}, {1: 2}, 1j])
def test_a_parameter_that_is_not_plain_data_is_refused_before_anything_is_computed(value):
    with pytest.raises(TypeError, match="the parameter limit holds a"):
        Keys().key(toy.clip, {"x": "aa"}, {"limit": value})


def test_an_unknown_executor_is_refused_in_one_sentence(store):
    from ss_flow.errors import InputError

    with pytest.raises(InputError, match="threads, processes"):
        run(store, toy.flow, executor="mesos")


@pytest.mark.parametrize("name", ["jobs", "memory_mb", "gpus"])
def test_a_negative_number_is_refused_in_one_sentence(store, name):
    from ss_flow.errors import InputError

    with pytest.raises(InputError, match=f"{name} is -1; it must be 0 or more"):
        run(store, toy.flow, **{name: -1})


def test_an_input_that_is_no_node_is_refused():
    flow = Flow()
    with flow.building(), pytest.raises(TypeError, match="must be a node"):
        gather([1.0])


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (
            lambda xs: each(xs, toy.source(values=(1.0,)), build=lambda x, y: toy.square(x)),
            "lists of different lengths",
        ),
        (lambda xs: each(xs, build=lambda x: toy.total((3.0,))), "must be a node"),
        (lambda xs: toy.square(xs[7]), "not among the 2 items"),
        (lambda xs: toy.total(pick(xs, [0, 7])), "not among the 2 items"),
        (lambda xs: each(toy.square(xs[0]), build=toy.square), "is a single artifact"),
        (lambda xs: toy.square(toy.square(xs[0])[0]), "is a single artifact"),
        (lambda xs: expand(xs[0], lambda x: None), "must be a node, not NoneType"),
        (lambda xs: expand(xs[0], lambda x: xs["a"]), "chosen by its number, not by a str"),
    ],
    ids=["lengths", "no node", "item", "pick", "each of one", "item of one", "nothing", "name"],
)
def test_a_node_that_cannot_be_expanded_fails_and_the_other_flows_go_on(store, bad, said):
    flows = [lambda: {"x": bad(toy.source(values=(1.0, 2.0)))}, toy.flow]
    failed, good = engine.run_flows([engine.Request(flow, "toy") for flow in flows], store)
    (failure,) = failed.failures
    assert said in str(failure.error) and failed.values["x"] is failure
    assert good.failures == [] and value(store, good.values["total"]) == 14.0


def test_expand_gets_the_number_of_the_items_of_a_list(store):
    def flow():
        xs = toy.source(values=(1.0, 2.0))
        return {"x": expand(xs, lambda count: toy.clip(xs[0], limit=-float(count)))}

    assert value(store, run(store, flow).values["x"]) == -2.0


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: None, "a dict of nodes, not NoneType"),
        (lambda: {"x": [toy.source(values=(1.0,))]}, "the output x must be a node, not list"),
        (lambda: {"x": OF_ANOTHER_FLOW}, "the output x is a node of another flow"),
        (lambda: {"x": toy.square(OF_ANOTHER_FLOW)}, "the input x of ss_flow_toy.square is a node of another flow"),
        (lambda: {"x": toy.total((OF_ANOTHER_FLOW,))}, "is a node of another flow"),
        (lambda: {"x": toy.source(values=(1.0, {2}))}, "the parameter values holds a set"),
    ],
)
def test_a_mistake_in_a_flow_is_told_in_one_sentence(store, build, said):
    with pytest.raises(TypeError, match=said):
        run(store, build)


with Flow().building():
    OF_ANOTHER_FLOW = toy.source(values=(1.0,))


def test_a_task_declares_the_types_of_its_artifacts_and_of_its_result():
    def untyped(x, *, by=1):
        return x

    with pytest.raises(TypeError, match="the task t must declare the type of x, its result"):
        task(name="t")(untyped)


def test_a_type_that_only_type_checkers_import_is_told_with_the_task():
    def hidden(x: Linear) -> Linear:
        return x

    hidden.__annotations__["x"] = "NDArray"
    with Flow().building(), pytest.raises(TypeError, match="that the task t declares is not there at run time"):
        task(name="t")(hidden)(None)


def test_only_a_node_has_items_to_pick():
    with Flow().building(), pytest.raises(TypeError, match="not a list"):
        pick([1, 2], [0])


def test_a_report_tells_one_output_from_a_list_and_from_a_failure(store):
    report = run(store, lambda: {"xs": (xs := toy.source(values=(1.0, 2.0))), "x": xs[0], "far": xs[5]})
    assert report.all("xs") == report.values["xs"] and report.one("x") == report.all("xs")[0]
    for ask, name, error in (
        (report.one, "xs", TypeError),
        (report.all, "x", TypeError),
        (report.one, "far", IndexError),
    ):
        with pytest.raises(error):
            ask(name)


def test_a_task_names_its_arguments_one_by_one():
    def several(*xs: Linear) -> Linear:
        return xs[0]

    def only(x: Linear, /) -> Linear:
        return x

    def more(**options: float) -> Linear:
        return Linear(options["slope"])

    for function in (several, only, more):
        with pytest.raises(TypeError, match="the task t must name its arguments one by one"):
            task(name="t")(function)


def test_the_distributions_that_a_task_uses_are_a_tuple_and_no_text():
    with pytest.raises(TypeError, match=r'uses=\("open3d",\)'):
        task(uses="open3d")


def test_a_task_that_another_process_would_not_find_is_refused(store):
    @task(name="t.inner")
    def inner(*, slope: float) -> Linear:
        return Linear(slope)

    renamed = task(name="t.renamed")(toy.clip.function)
    for build in (lambda: inner(slope=1.0), lambda: renamed(toy.source(values=(1.0,))[0], limit=2.0)):
        with pytest.raises(TypeError, match=r"the task t\.\w+ must be declared at the top of its module"):
            run(store, lambda build=build: {"x": build()})


def test_an_artifact_at_hand_is_no_input_but_becomes_one_through_the_store(store):
    for at_hand in (toy.number(1.0), np.zeros(2), None):
        with pytest.raises(TypeError, match=r"the input x of ss_flow_toy\.clip is a \w+, no node; .* stored\("):
            run(store, lambda at_hand=at_hand: {"x": toy.clip(at_hand, limit=2.0)})
    report = run(store, lambda: {"x": toy.clip(stored("x", store.put(toy.number(3.0))), limit=2.0)})
    assert value(store, report.values["x"]) == 2.0


def test_a_call_has_parameters_of_its_own_as_its_key_sees_them():
    @task(name="t")
    def several(*, pair: tuple[int, ...], many: list[int], free: object) -> Linear:
        return Linear()

    given = {"pair": [1, np.int64(2)], "many": (1,), "free": {"b": [1], "a": np.float32(0.5)}}
    with Flow().building():
        kept = several(**given).parameters
    given["free"]["b"].append(2)
    assert repr(kept) == "{'pair': (1, 2), 'many': [1], 'free': {'a': 0.5, 'b': [1]}}"


def test_a_dataclass_of_parameters_has_lists_of_its_own_too():
    shared, changing = Holder(Linear(), (Linear(),)), Holder(Holder(Nothing(), ([1], 2)))
    with Flow().building():
        kept = [modelled(union=one).parameters["union"] for one in (shared, changing)]
    changing.one.many[0].append(2)
    assert kept[0] is shared and kept[1] == Holder(Holder(Nothing(), ([1], 2)))


def test_a_dataclass_that_can_be_changed_is_no_parameter():
    @dataclass
    class Loose:
        slope: float = 1.0

    with Flow().building(), pytest.raises(TypeError, match="union holds a Loose, no plain data and no frozen datac"):
        modelled(union=Loose())
    with Flow().building(), pytest.raises(TypeError, match="make it a FileRef"):
        modelled(union=Path("photo.jpg"))


def test_a_task_that_changes_its_parameters_changes_a_copy(store):
    nodes = []

    def build():
        nodes.append(toy.appended(rows=[1], by=2))
        return {"x": nodes[0]}

    assert value(store, run(store, build, executor="threads").values["x"]) == 2.0
    assert nodes[0].parameters == {"rows": [1], "by": 2}


def test_of_two_parameters_of_one_name_neither_hides_the_other():
    def parts(slope: float, within: float) -> dict:
        return Keys().components(toy.clip, {}, {"params": Linear(within), "slope": slope})["parameters"]

    assert parts(1.0, 2.0).items() >= {"params.slope": 2.0, "slope": 1.0}.items()


def test_a_node_cannot_be_gone_through_as_a_list():
    flow = Flow()
    with flow.building(), pytest.raises(TypeError, match="use `each`"):
        tuple(toy.source(values=(1.0,)))


def test_a_gpu_counts_where_the_driver_shows_one_unless_tasks_are_said_to_use_none(monkeypatch):
    monkeypatch.setattr(engine.glob, "glob", lambda pattern: ["/dev/nvidia0", "/dev/nvidia1"])
    assert [engine._this_machine(gpus).gpus for gpus in (None, 0, 1)] == [1, 0, 1]


def test_a_definition_that_has_fields_is_said_to_have_changed_in_fields_or_code():
    parts = {"task": {}, "parameters": {}, "packages": {}, "environment": {}, "inputs": {}}
    for name, what in (("Number", "fields or code"), ("square", "code"), ("helper", "code")):
        before, now = ({**parts, "code": {f"ss_flow_toy.{name}": digest}} for digest in "ab")
        assert first_difference(before, now) == f"{what} of ss_flow_toy.{name} changed"
