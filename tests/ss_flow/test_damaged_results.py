"""Results that were damaged in the store are made again, whoever finds it out."""

from __future__ import annotations

import random
from functools import partial

import pytest
import ss_flow_toy as toy
from fresh_stores import computed, flip, one, read_by, run

from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.store import Store
from ss_flow.engine import Request, run_flows
from ss_flow.errors import InputError
from ss_flow.graph import each
from ss_flow.runs import latest_runs


def test_a_damaged_input_is_made_again_before_it_is_used(store):
    squares = run(store).values["squares"]
    flip(store, squares[1])
    again = run(store, lambda: {"total": toy.total(toy.flow()["squares"]), "half": each_half()})
    fresh = run(
        Store(store.root.parent / "fresh"), lambda: {"total": toy.total(toy.flow()["squares"]), "half": each_half()}
    )
    assert again.values == fresh.values
    assert computed(again) == [
        "ss_flow_toy.half[0]",
        "ss_flow_toy.half[1]",
        "ss_flow_toy.half[2]",
        "ss_flow_toy.square[n1]",
    ]


def each_half():
    return each(toy.flow()["squares"], build=toy.half)


def test_a_damaged_result_that_decides_what_comes_next_is_made_again(store):
    def build():
        return {"end": toy.halving(toy.source(values=(10.0,))[0])}

    first = run(store, build)
    [number] = [n["outputs"][0] for n in first.nodes if n["step"] == "ss_flow_toy.source"]
    flip(store, number)
    again = run(store, build)
    assert again.values == first.values
    assert computed(again) == ["ss_flow_toy.source"]
    assert again.nodes[0]["why"] == "its result is no longer in the store"
    kinds = [event["event"] for event in next(latest_runs(store.root / "roots" / "runs")).events()]
    assert kinds.count("restarted") == 1


def test_bits_flipped_in_many_objects_change_no_result(store):
    first = run(store)
    objects = [entry.name for entry in store.objects()]
    for seed in range(5):
        for name in random.Random(seed).sample(objects, 3):
            if name in store:
                flip(store, name, byte=seed)
        again = run(store, lambda seed=seed: toy.flow(limit=50.0 + seed))
        assert again.values == first.values
        run(store)


def test_a_final_result_that_its_reader_finds_damaged_is_made_again_and_read_again(store):
    first = run(store)
    flip(store, first.values["squares"][2])
    flip(store, first.values["total"])
    read = []

    def done(report):
        reader = Store(store.root)
        read.append([reader.get(value) for value in (*report.values["squares"], report.values["total"])])

    again = read_by(done, store)
    assert again.values == first.values and len(read) == 1 and len(read[0]) == 4
    assert computed(again) == ["ss_flow_toy.square[n2]", "ss_flow_toy.total"]
    kinds = [event["event"] for event in next(latest_runs(store.root / "roots" / "runs")).events()]
    assert kinds.count("restarted") == 2 and kinds[-1] == "run ended"


def test_the_other_flows_are_read_once_when_a_result_of_one_is_made_again(store):
    run(store)
    flip(store, run(store).values["total"])
    read = []

    def done(scene, report):
        read.append((scene, Store(store.root).get(report.values["total"]) is not None))

    builds = {"other": lambda: toy.flow(limit=20.0), "toy": toy.flow}
    requests = [Request(build, scene, done=partial(done, scene)) for scene, build in builds.items()]
    reports = run_flows(requests, Store(store.root))
    assert sorted(read) == [("other", True), ("toy", True)]
    assert all(isinstance(report.values["total"], str) for report in reports)


@pytest.mark.parametrize(
    ("task", "results"), [(toy.square, 1), (toy.uncertain, 2)], ids=["the same result", "another result each time"]
)
def test_a_result_that_is_damaged_again_after_it_was_made_anew_ends_the_run(store, task, results):
    """As on a failing disk, also where a computation does not give the same bits twice."""
    tried = []

    def done(report):
        tried.append(report.values["out"])
        flip(store, report.values["out"])
        Store(store.root).get(report.values["out"])

    with pytest.raises(StoreFailure, match=r"was damaged .*, though it was made anew; is the disk failing"):
        read_by(done, store, one(task))
    assert len(tried) == 2 and len(set(tried)) == results
    last = list(next(latest_runs(store.root / "roots" / "runs")).events())[-1]
    assert (last["event"], last["interrupted"]) == ("run ended", True)


def test_a_reader_that_fails_leaves_the_record_of_a_run_that_ended(store):
    def done(report):
        raise InputError("no place to write to")

    with pytest.raises(InputError, match="no place"):
        read_by(done, store)
    ends = [e for e in next(latest_runs(store.root / "roots" / "runs")).events() if e["event"] == "run ended"]
    assert [(end["failed"], set(end["results"])) for end in ends] == [(0, {"squares", "total"})]
