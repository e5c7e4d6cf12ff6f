"""`ss-flow view` of one cached result, and what it writes instead of serving."""

from __future__ import annotations

import re

import pytest
from tiny_runs import run_tiny, ss_flow

from ss_flow.cache.store import Store
from ss_flow.flows.cli import view
from ss_flow.flows.view.artifact import around_of, placed, show
from ss_flow.flows.view.drawing import Around
from ss_flow.flows.view.looking import start_view
from ss_flow.runs import latest_runs


@pytest.fixture(scope="module", autouse=True)
def latest(tiny, tmp_path_factory: pytest.TempPathFactory) -> None:
    """The run once more: those of other tests may have pushed it out of the store's list of runs."""
    again = tmp_path_factory.mktemp("again")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SS_FLOW_MODELS", "")
        patch.setenv("HOME", str(again))
        called = run_tiny(tiny.scene, tiny.store, out=again / "out")
    assert called.code == 0 and not called.computed(), called.err


@pytest.fixture(scope="module")
def around(latest: None, tiny) -> Around:
    store = Store(tiny.store)
    return around_of(store, next(latest_runs(store.runs)))


def test_what_surrounds_an_artifact_is_that_of_the_runs_own_results(around, tiny):
    results, store = tiny.called.results(), Store(tiny.store)
    assert [frame.name for frame in around.frames] == [f"{k:04d}" for k in range(5)]
    assert around.cameras is store.get(results["cameras"]) or len(around.cameras) == 5
    assert len(around.points.points) == len(store.get(results["dense"]).points)


def test_an_artifact_is_drawn_and_looked_at_from_the_first_view(around, tiny):
    viser = pytest.importorskip("viser", reason="needs the extra `view`")
    scene = Store(tiny.store).get(tiny.called.results()["scene"])
    assert placed([scene], around) and not placed([scene], Around())
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        show(server, [scene], around)
        assert len(server.scene.get_handle_by_name("/artifact").buffer) == len(scene)
        first = start_view(around.cameras, around.points.points)
        assert tuple(server.initial_camera.position) == pytest.approx(tuple(first.position))
    finally:
        server.stop()


@pytest.mark.parametrize("what", ["propagate", "masks", "name", "metrics_split", "describe"])
def test_any_result_becomes_a_page(what, tiny, tmp_path):
    file = tmp_path / "it.html"
    done = ss_flow("view", what, "--html", file, "--cache", tiny.store)
    assert (done.code, done.out) == (0, f"{file}\n"), done.err
    html = file.read_text()
    assert "made by " in html and "data:image/" in html and "<th" in html
    assert str(tiny.store) not in html and not re.search(r"\bhttps?://", html)


def test_a_result_without_a_place_is_told_as_cache_show_tells_it(tiny):
    told = ss_flow("cache", "show", "name", "--cache", tiny.store).out
    assert ss_flow("view", "name", "--cache", tiny.store).out == told
    digest = tiny.called.results()["names"]
    assert ss_flow("view", digest[:12], "--cache", tiny.store).out == told


def test_a_page_of_a_run_is_written_without_the_viewers_package(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(view, "find_spec", lambda name: None)
    done = ss_flow("view", tiny.out, "--html", tmp_path / "room.html")
    assert done.code == 0 and done.out == f"{tmp_path / 'room.html'} ({done.out.split('(')[1]}", done.err
    served = ss_flow("view", tiny.out)
    assert served.code == 2 and "pip install 'ss-flow[view]'" in served.err and served.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["nothing"], "is neither a step of the latest runs nor a digest"),
        (["propagate", "--html", "/nowhere/it.html"], "--html must name a file in a folder that exists"),
        (["propagate", "--rerun", "it.rrd"], "take the output folder of a run, and propagate is none"),
        (["some/folder"], "some/folder is not the output folder of a run"),
        (["propagate", "--port", "70000"], "--port 70000 is out of range"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_sentence(arguments, problem, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = ss_flow("view", *arguments, "--cache", tiny.store)
    assert done.code == 2 and problem in done.err and done.err.count("\n") == 1, done.err
