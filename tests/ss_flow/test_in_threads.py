"""One function of many items, by the threads that a task has."""

from __future__ import annotations

import threading

import pytest

from ss_flow.running import Surroundings, cores, in_threads, progress, running, warn


def test_results_come_in_the_order_of_the_items_whatever_the_threads():
    for threads in (1, 3):
        with running(Surroundings(cores=threads)):
            assert list(in_threads(lambda x: x * x, range(50))) == [x * x for x in range(50)]
            assert list(in_threads(str, ())) == []


def test_as_many_calls_as_cores_run_at_once():
    meet = threading.Barrier(3, timeout=30)
    with running(Surroundings(cores=3)):
        assert len(list(in_threads(lambda _: meet.wait(), range(6)))) == 6


def test_no_more_items_are_taken_than_can_be_worked_on():
    taken = []

    def items():
        for item in range(100):
            taken.append(item)
            yield item

    with running(Surroundings(cores=2)):
        results = in_threads(lambda x: x, items())
        assert next(results) == 0
        assert len(taken) <= 3
        results.close()


def test_a_thread_has_one_core_is_not_heard_and_warns_for_its_task():
    heard, warned = [], []

    def one(item):
        progress(item, 4)
        warn(f"item {item // 2}")
        return cores()

    with running(Surroundings(listener=lambda *of: heard.append(of), cores=2, warned=warned)):
        assert list(in_threads(one, range(4))) == [1] * 4
    assert sorted(warned) == ["item 0", "item 1"]
    assert not heard


def test_what_one_item_raises_ends_all():
    done = []

    def one(item):
        if item == 2:
            raise ValueError("item 2")
        done.append(item)

    with running(Surroundings(cores=2)), pytest.raises(ValueError, match="item 2"):
        list(in_threads(one, range(100)))
    assert len(done) < 100
