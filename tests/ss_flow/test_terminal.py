"""What a person hears of a run where there is no terminal."""

from __future__ import annotations

import io
import re
import time

import ss_flow_toy as toy
from rich.console import Console

from ss_flow.engine import run_flow
from ss_flow.graph import each
from ss_flow.terminal import Log


class Seen:
    """A log into a text."""

    def __init__(self, **options: float) -> None:
        self._stream = io.StringIO()
        self.log = Log(Console(file=self._stream, width=200), **options)

    def lines(self) -> list[str]:
        """What it said, without times, with single spaces."""
        self.log.close()
        return [" ".join(re.sub(r"[\d.]+ s\b", "", line).split()) for line in self._stream.getvalue().splitlines()]


def halves(values):
    return {"all": each(toy.source(values=values), build=toy.half, on_error="skip")}


def test_a_step_has_one_line_when_its_last_node_has_ended_and_none_where_all_was_there(store):
    first, again = Seen(), Seen()
    run_flow(lambda: halves((2.0, 3.0, 4.0)), store, scene="toy", reporter=first.log)
    assert first.lines() == ["done ss_flow_toy.source 1 of 1", "done ss_flow_toy.half 3 of 3"]
    run_flow(lambda: halves((2.0, 3.0, 4.0)), store, scene="toy", reporter=again.log)
    assert again.lines() == []


def test_of_a_step_that_was_there_in_part_or_failed_in_part_the_line_counts_all_that_is_there(store):
    run_flow(lambda: halves((2.0, 3.0)), store, scene="toy")
    seen = Seen()
    run_flow(lambda: halves((2.0, 3.0, 4.0, -1.0)), store, scene="toy", reporter=seen.log)
    assert sorted(seen.lines()) == [
        "done ss_flow_toy.half 3 of 4",
        "done ss_flow_toy.source 1 of 1",
        "failed ss_flow_toy.half[3]: ValueError: negative",
    ]


def test_an_interrupted_step_is_told_of_at_the_end():
    seen = Seen()
    for item in "01":
        seen.log.event("finished", label=f"half[{item}]", step="half", of=5, seconds=1.0)
        seen.log.pause()
    assert seen.lines() == ["done half 2 of 5"]


def test_results_that_are_found_again_after_damage_are_not_told_of_again():
    seen = Seen()
    seen.log.event("finished", label="half", step="half", of=1, seconds=1.0)
    seen.log.pause()
    seen.log.event("restarted", because="an object is damaged")
    seen.log.event("hit", label="half", step="half", of=1)
    seen.log.pause()
    assert seen.lines() == ["done half 1 of 1", "again an object is damaged"]


def test_a_long_node_says_that_it_lives_and_how_far_it_is():
    seen = Seen(every=0.05)
    seen.log.event("started", label="slow[a]")
    seen.log.progressed("slow[a]", 3, 200, "level 2")
    time.sleep(0.4)
    seen.log.event("finished", label="slow[a]", step="slow", of=1, seconds=0.4)
    lines = seen.lines()
    assert lines[0] == "runs slow[a], 3 of 200 (level 2), so far"
    assert lines.count(lines[0]) >= 2 and lines[-1] == "done slow 1 of 1"
