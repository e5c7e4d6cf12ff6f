"""The report of a finished run, written anew."""

from __future__ import annotations

import cv2
import pytest
from browser import browser_page, needs_browser
from tiny_runs import run_tiny, ss_flow


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


def test_another_run_is_compared_with_in_the_report(warm, tmp_path):
    file, other = warm.out / "report.html", tmp_path / "other"
    setting = "splat.merge.global_iterations"
    assert run_tiny(warm.scene, warm.store, "--set", f"{setting}=10", out=other).code == 0
    answer = ss_flow("report", warm.out, "--beside", other)
    assert answer.code == 0, answer.err
    html = file.read_text()
    section = html[html.index("Compared with other") : html.index("<h2>Views</h2>")]
    assert f"<code>{setting}</code></td><td>10</td><td>20</td>" in section
    assert "(after Split)" not in section and "figures are the same in both" in section, "nothing else was changed"
    assert "agree with a mean IoU of" in section
    again = run_tiny(warm.scene, warm.store, out=warm.out)
    assert again.computed() == {} and file.read_text() == html, "a run that changes nothing leaves it"
    assert ss_flow("report", warm.out).code == 0 and "Compared with" not in file.read_text()
    answer = ss_flow("report", warm.out, "--beside", tmp_path / "nowhere")
    assert answer.code == 2 and answer.err.count("\n") == 1


@needs_browser
def test_a_browser_shows_every_picture_asks_for_nothing_and_complains_of_nothing(warm):
    pytest.importorskip("websockets", reason="needs the extra `view`, whose websockets drive the browser")
    file = warm.out / "report.html"
    with browser_page(900, 700) as page:
        page.open(file.as_uri())
        page.wait_for("document.title.includes('Split') && document.readyState === 'complete'")
        page.evaluate("document.querySelectorAll('details').forEach(folded => { folded.open = true })")
        page.evaluate("[...document.images].forEach(picture => { picture.loading = 'eager' })")
        page.wait_for("[...document.images].every(picture => picture.complete)")
        widths = page.evaluate("[...document.images].map(picture => picture.naturalWidth)")
        assert len(widths) > 10 and all(widths)
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "nothing sticks out"
        assert [address for address in page.requests if not address.startswith("data:")] == [file.as_uri()]
        assert page.complaints == []
