"""What a person hears and sees of a run, with a terminal and without."""

from __future__ import annotations

import io
import re
import time

import pytest
import ss_flow_toy as toy
from rich.console import Console

from ss_flow.engine import run_flow
from ss_flow.graph import each
from ss_flow.terminal import Lines, Terminal


class Seen:
    """A log into a text."""

    def __init__(self, **options: float) -> None:
        self._stream = io.StringIO()
        self.log = Lines(Console(file=self._stream, width=200), **options)

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


def test_that_another_process_computes_a_step_is_told_once():
    seen = Seen()
    for item in "01":
        seen.log.event("waiting", label=f"half[{item}]", step="half", of=2, because="another process is computing it")
    assert seen.lines() == ["waits half[0]: another process is computing it"]


def test_a_step_of_many_short_nodes_says_how_far_it_is():
    seen = Seen(every=0.1)
    for item in "0123456789":
        seen.log.event("started", label=f"quick[{item}]", step="quick", of=20)
        time.sleep(0.04)
        seen.log.event("finished", label=f"quick[{item}]", step="quick", of=20, seconds=0.04)
    lines = seen.lines()
    told = [line for line in lines if line.startswith("runs")]
    assert told and all(re.fullmatch(r"runs quick, \d of 20, so far", line) for line in told)
    assert lines[-1] == "done quick 10 of 20"


def test_a_long_node_says_that_it_lives_and_how_far_it_is():
    seen = Seen(every=0.05)
    seen.log.event("started", label="slow[a]", step="slow", of=1)
    seen.log.progressed("slow[a]", 3, 200, "level 2")
    time.sleep(0.4)
    seen.log.event("finished", label="slow[a]", step="slow", of=1, seconds=0.4)
    lines = seen.lines()
    assert lines[0] == "runs slow[a], 3 of 200 (level 2), so far"
    assert lines.count(lines[0]) >= 2 and lines[-1] == "done slow 1 of 1"


@pytest.fixture
def screen(monkeypatch):
    """A display on a terminal of 80 x 24 whose clock stands still; call it for the lines that it shows."""
    console = Console(file=io.StringIO(), width=80, height=24, force_terminal=True, color_system=None)
    display = Terminal(console, every=3600.0)
    clock = {"now": display._begun}
    monkeypatch.setattr("ss_flow.terminal.time.monotonic", lambda: clock["now"])

    def lines(seconds):
        clock["now"] += seconds
        paper = Console(file=io.StringIO(), width=80, color_system=None)
        paper.print(display.picture())
        return [" ".join(re.sub("[━╸╺]", "", line).split()) for line in paper.file.getvalue().splitlines()]

    lines.event, lines.progressed = display.event, display.progressed
    yield lines
    display.close()


def test_three_hundred_nodes_take_one_line_of_the_display_with_the_time_that_is_left(screen):
    for item in range(100):
        screen.event("started", label=f"train[{item}]", step="train", of=300, known=340)
        screen.event("finished", label=f"train[{item}]", step="train", of=300, known=340, seconds=3.0)
    for item in (100, 101):
        screen.event("started", label=f"train[{item}]", step="train", of=300, known=340)
    # 198 wait for 3 s each, two run for 3 s: 600 s of work, two at a time.
    assert screen(0.0) == [
        "all steps 100 of 340 0:00:00 at least 0:05:00 left",
        "train 100 of 300 0:05:00 left 100, 101",
    ]
    assert screen(2.0)[1] == "train 100 of 300 0:04:58 left 100, 101"


def test_a_step_of_one_node_shows_what_it_says_of_itself(screen):
    screen.event("started", label="sfm", step="sfm", of=1, known=9)
    assert screen(10.0)[1] == "sfm"
    screen.progressed("sfm", 5, 20, "photos")
    assert screen(0.0) == ["all steps 0 of 9 0:00:10 at least 0:00:30 left", "sfm 5 of 20 0:00:30 left photos"]


def test_what_was_found_in_the_store_says_nothing_of_the_time_that_is_left(screen):
    screen.event("hit", label="train[0]", step="train", of=3, known=3)
    screen.event("started", label="train[1]", step="train", of=3, known=3)
    assert screen(5.0) == ["all steps 1 of 3 0:00:05", "train 1 of 3 1"]


def test_the_display_stays_on_the_screen_with_many_steps_and_long_names(screen):
    for number in range(30):
        for item in range(20):
            label = f"a_step_with_a_long_name.{number}[{item}]"
            screen.event("started", label=label, step=label.partition("[")[0], of=100_000, known=3_000_000)
    lines = screen(36_000.0)
    assert len(lines) == 10 and lines[-1] == "and 22 more steps"
    assert lines[0].startswith("all steps 0 of 3000000 10:00:00")


def test_a_step_leaves_one_line_on_a_terminal_and_short_ones_none():
    stream = io.StringIO()
    display = Terminal(Console(file=stream, width=80, force_terminal=True, color_system=None), every=3600.0)
    for step, seconds in (("long", 0.6), ("short", 0.1)):
        for item in "abc":
            display.event("finished", label=f"{step}[{item}]", step=step, of=3, known=6, seconds=seconds)
            display.pause()
    display.close()
    text = stream.getvalue()
    assert text.count("done") == 1 and re.search(r"done   long +3 of 3 +1\.8 s", text)
