"""The report of a finished run, written anew."""

from __future__ import annotations

import cv2
from tiny_runs import ss_flow


def test_the_report_is_written_again_as_it_was_and_nothing_is_drawn(warm, monkeypatch):
    monkeypatch.setattr(cv2, "imencode", None)
    file = warm.out / "report.html"
    before = file.read_bytes()
    file.unlink()
    answer = ss_flow("report", warm.out)
    assert answer.code == 0 and answer.out.replace("\n", "") == str(file)
    assert file.read_bytes() == before


def test_results_that_are_gone_are_named(warm, tmp_path):
    answer = ss_flow("report", warm.out, "--cache", tmp_path / "nowhere")
    assert answer.code == 2 and "nowhere" in answer.err
    for file in sorted((warm.store / "objects").rglob("*"), reverse=True):
        file.unlink() if file.is_file() else file.rmdir()
    answer = ss_flow("report", warm.out, "--cache", warm.store)
    assert answer.code == 2 and "no longer holds" in answer.err
