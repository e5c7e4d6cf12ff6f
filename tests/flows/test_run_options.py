"""What the options of a run become for the engine."""

from __future__ import annotations

import pytest

from ss_flow.flows.cli import prepare
from ss_flow.flows.cli.prepare import RunOptions


@pytest.fixture
def on_gpu(monkeypatch):
    """Have tasks compute on a GPU with memory for five processes."""
    monkeypatch.setattr(prepare, "device_here", lambda: "cuda")
    monkeypatch.setattr(prepare, "processes_with_room", lambda: 5)


def test_on_a_gpu_no_more_processes_compute_than_it_has_memory_for(on_gpu):
    engine = RunOptions().engine()
    assert (engine["executor"], engine["processes"], engine["gpus"]) == ("mixed", 4, 1)  # this one is the fifth


def test_without_a_gpu_nothing_bounds_them(monkeypatch):
    monkeypatch.setattr(prepare, "device_here", lambda: "cpu")
    monkeypatch.setattr(prepare, "lacks_cuda", lambda: "there is none")
    engine = RunOptions().engine()
    assert (engine["executor"], engine["processes"], engine["gpus"]) == ("mixed", None, 0)


def test_who_names_an_executor_gets_it(on_gpu):
    assert RunOptions(executor="threads").engine()["executor"] == "threads"
