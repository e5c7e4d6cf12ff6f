"""What fails with a task and what goes on, and what is kept of work half done."""

from __future__ import annotations

import errno
import itertools
import os
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import ss_flow_toy as toy
from toy_runs import ran, run, value

from ss_flow import engine
from ss_flow.cache.errors import StoreFailure
from ss_flow.engine import Request, run_flows
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.graph import each, expand, labelled, otherwise, pick, stored
from ss_flow.resolution import Failure
from ss_flow.running import Surroundings, load_checkpoint, running, save_checkpoint
from ss_flow.runs import latest_runs
from ss_flow.task import task


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


def test_a_task_that_aborts_fails_alone_and_says_how(store):
    report = run(store, lambda: {"end": toy.abort(toy.source(values=(1.0,))[0])})
    assert isinstance(report.values["end"], Failure)
    assert "SIGABRT" in str(report.values["end"].error)


class Mute(Exception):
    def __str__(self):
        raise ValueError


@task()
def muted(x: toy.Number) -> toy.Number:
    raise Mute


def test_an_error_that_cannot_be_told_fails_its_node_alone(store):
    report = run(store, lambda: {"x": muted(toy.source(values=(1.0,))[0])})
    assert [type(failure.error) for failure in report.failures] == [Mute]


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


def test_of_a_damaged_checkpoint_nothing_is_taken_and_nothing_is_raised(tmp_path):
    place, kept = tmp_path / "kept.npz", {"height": np.array(3), "values": np.arange(5.0)}
    with running(Surroundings(checkpoint=place)):
        save_checkpoint(kept)
        content = place.read_bytes()
        for position, wrong in itertools.product(range(len(content)), (0, 1, 0xFF)):
            place.write_bytes(content[:position] + bytes([content[position] ^ wrong]) + content[position + 1 :])
            found = load_checkpoint()
            assert found is None or all(np.array_equal(found[name], kept[name]) for name in kept)
            assert found is not None or wrong


def test_a_checkpoint_that_cannot_be_taken_away_fails_no_task(store):
    (store.root / "checkpoints").touch()
    assert value(store, run(store, lambda: {"start": toy.source(values=(1.0,))[0]}).values["start"]) == 1.0


def test_a_store_that_was_moved_away_is_not_there_again_for_a_checkpoint(tmp_path):
    with running(Surroundings(checkpoint=tmp_path / "moved" / "checkpoints" / "kept.npz")):
        save_checkpoint({"x": np.ones(2)})
    assert not (tmp_path / "moved").exists()


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


def test_an_interrupt_is_told_though_a_flow_that_ends_meanwhile_cannot_be_written(store):
    class Interrupt(Reporter):
        def event(self, kind, **details):
            if kind == "started" and details["item"] == "last":
                raise KeyboardInterrupt

    def flow(item):
        with labelled(item):
            return {"end": toy.nap(stored("number", store.put(toy.number(len(item)))))}

    def refuse(report):
        raise InputError("the output cannot be written.")

    requests = [Request(partial(flow, n), n, reporter=Interrupt(), done=refuse) for n in ("a", "bb", "last")]
    with pytest.raises(KeyboardInterrupt):
        run_flows(requests, store, jobs=3)
    for scene, kind in (("a", "finished"), ("bb", "finished"), ("last", "taken")):
        (kept,) = latest_runs(store.runs, scene)
        events = [event["event"] for event in kept.events()]
        assert events[-1] == "run ended" and kind in events


def test_a_store_that_can_only_be_read_ends_the_run_with_one_sentence(store, monkeypatch):
    run(store, toy.flow)
    refused = OSError(errno.EROFS, os.strerror(errno.EROFS))
    monkeypatch.setattr(Path, "touch", lambda *_, **__: (_ for _ in ()).throw(refused))
    assert set(ran(run(store, toy.flow, recorded=False))) == set()
    monkeypatch.setattr(engine, "start_run", lambda *_: (_ for _ in ()).throw(refused))
    with pytest.raises(StoreFailure, match="cannot be written: Read-only file system"):
        run(store, toy.flow)
