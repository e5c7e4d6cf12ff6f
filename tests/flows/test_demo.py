"""`ss-flow demo`: a room is built once, run, and measured."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from tiny_runs import bytes_of, ss_flow

from ss_flow.errors import InputError
from ss_flow.flows.demo import CaptureFile, _write


def test_the_demo_builds_a_room_and_measures_the_result(tmp_path):
    arguments = ["--objects", "1", "--views", "3", "--masks", "truth", "--until", "masks_split", "--json"]
    first = ss_flow("demo", "--out", tmp_path / "demo", "--cache", tmp_path / "store", *arguments)
    assert first.code == 0, first.err
    assert sorted(path.name for path in (tmp_path / "demo/scene/color").iterdir())[0] == "0000.jpg"
    stamp = (tmp_path / "demo/scene/recipe.json").stat().st_mtime_ns
    again = ss_flow("demo", "--out", tmp_path / "demo", "--cache", tmp_path / "store", *arguments)
    assert again.computed() == {}
    assert (tmp_path / "demo/scene/recipe.json").stat().st_mtime_ns == stamp
    other = ss_flow("demo", "--out", tmp_path / "demo", "--cache", tmp_path / "store", "--seed", "1", *arguments)
    assert other.code == 0 and other.computed()["capture.ingest"] == 1


def test_a_room_is_photographed_once_whatever_the_folder(tmp_path, monkeypatch):
    room = ["--objects", "1", "--views", "3", "--masks", "truth", "--until", "cameras", "--cache", tmp_path / "store"]
    assert ss_flow("demo", "--out", tmp_path / "a", *room).code == 0
    monkeypatch.setattr("ss_flow.flows.demo.generate", lambda params: pytest.fail("photographed again"))
    assert ss_flow("demo", "--out", tmp_path / "b", *room).code == 0
    files = bytes_of(tmp_path / "a/scene")
    assert files == bytes_of(tmp_path / "b/scene") and len(files) > 20
    shutil.rmtree(tmp_path / "a/scene")
    assert ss_flow("demo", "--out", tmp_path / "a", *room).code == 0
    assert bytes_of(tmp_path / "a/scene") == files


def test_a_damaged_photo_in_the_store_is_taken_anew(tmp_path):
    room = ["--objects", "1", "--views", "3", "--until", "cameras", "--cache", tmp_path / "store"]
    assert ss_flow("demo", "--out", tmp_path / "a", *room).code == 0
    digest = json.loads((tmp_path / "a/scene/recipe.json").read_text())["files"][0]
    for file in (tmp_path / "store/objects" / digest[:2] / digest).rglob("*"):
        if file.is_file():
            file.write_bytes(b"damaged")
    assert ss_flow("demo", "--out", tmp_path / "b", *room).code == 0
    assert bytes_of(tmp_path / "a/scene") == bytes_of(tmp_path / "b/scene")


@pytest.mark.parametrize("name", ["../outside.txt", "/etc/outside.txt", "color/../../outside.txt"])
def test_a_photo_of_a_foreign_store_stays_in_the_folder(tmp_path, name):
    with pytest.raises(InputError, match="outside of it"):
        _write(CaptureFile(name, np.zeros(3, np.uint8)), tmp_path / "scene")
    assert not list(tmp_path.rglob("*.txt"))


def test_demo_run_sweep_and_batch_measure_one_scene_alike(tmp_path):
    until = ["--cache", tmp_path / "store", "--preset", "fast", "--until", "metrics_split", "--json"]
    room = ["--objects", "1", "--views", "3", "--masks", "degraded"]
    scene = tmp_path / "demo/scene"
    demo = ss_flow("demo", "--out", tmp_path / "demo", *room, *until).document()
    run = ss_flow("run", scene, *until)
    assert run.computed() == {} and run.document()["params"]["evaluate.zero_is_void"] is False
    batch = ss_flow("batch", scene, "--out", tmp_path / "batch", *until).document()
    sweep = ss_flow("sweep", scene, "--set", "tau_label=0.7,0.9", "--out", tmp_path / "swept", *until).document()
    measured = {f"split.{name}": value for name, value in demo["metrics"]["split"].items()}
    assert run.document()["metrics"] == demo["metrics"]
    assert batch[0]["metrics"] == sweep[0]["metrics"] == measured
    (scene / "instances.json").write_text(json.dumps({"1": "table"}))
    void = ss_flow("run", scene, *until).document()
    assert void["params"]["evaluate.zero_is_void"] is True
    assert void["metrics"]["split"]["pq"] != demo["metrics"]["split"]["pq"]
    asked = ss_flow("run", scene, "--set", "zero_is_void=false", *until).document()
    assert asked["metrics"] == demo["metrics"]


def test_the_demo_leaves_a_scene_folder_of_something_else_alone(tmp_path):
    (tmp_path / "demo/scene").mkdir(parents=True)
    (tmp_path / "demo/scene/holiday.jpg").write_text("mine")
    called = ss_flow("demo", "--out", tmp_path / "demo", "--cache", tmp_path / "store")
    assert called.code == 2
    assert "holds something else than a generated scene" in called.err
    assert (tmp_path / "demo/scene/holiday.jpg").read_text() == "mine"


def test_another_room_does_not_take_away_what_a_user_put_beside_the_photos(tmp_path):
    room = ["--objects", "1", "--views", "3", "--until", "cameras", "--cache", tmp_path / "store"]
    assert ss_flow("demo", "--out", tmp_path / "demo", *room).code == 0
    hints = tmp_path / "demo/scene/my_hints.json"
    hints.write_text("{}")
    other = ss_flow("demo", "--out", tmp_path / "demo", *room, "--seed", "1")
    assert other.code == 2 and "scene holds my_hints.json, which is no part of the room; move it away" in other.err
    assert hints.is_file() and (tmp_path / "demo/scene/recipe.json").is_file()
    hints.unlink()
    assert ss_flow("demo", "--out", tmp_path / "demo", *room, "--seed", "1").code == 0


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (["--preset", "quick"], "preset 'quick' is unknown"),
        (["--set", "tau_label=7"], "must be between 0 and 1"),
        (["--jobs", "-1"], "--jobs -1 is out of range"),
        (["--memory", "much"], "--memory"),
        (["--executor", "slurm"], "choose one of: mixed"),
        (["--seed", "-1"], "--seed -1 is out of range"),
    ],
)
def test_wrong_options_are_refused_before_a_room_is_photographed(wrong, says, tmp_path):
    for command in (["demo"], ["reproduce", "scannet", "--data", "generated"]):
        if command == ["demo"] or "--seed" not in wrong:
            called = ss_flow(*command, "--out", tmp_path / "demo", "--cache", tmp_path / "store", *wrong)
            assert called.code == 2 and says in called.err
    assert not (tmp_path / "demo").exists() and not list(tmp_path.glob("store/actions/*/*"))


@pytest.mark.parametrize(
    ("option", "value", "says"), [("--views", 0, "at least 2 views"), ("--objects", 1000, "holds 1")]
)
def test_a_dry_run_of_the_demo_refuses_a_room_that_cannot_be(option, value, says, tmp_path):
    called = ss_flow("demo", "--dry-run", option, value, "--out", tmp_path / "a", "--cache", tmp_path / "store")
    assert called.code == 2 and says in called.err


def test_a_dry_run_of_the_demo_writes_nothing(tmp_path):
    room = ["--objects", "1", "--views", "3", "--masks", "truth", "--cache", tmp_path / "store"]
    dry = ["--dry-run", "--out", tmp_path / "a", *room]
    told = ss_flow("demo", *dry)
    assert told.code == 0 and "would run demo.photographs" in told.out and not (tmp_path / "a").exists()
    assert not list(tmp_path.glob("store/actions/*/*"))
    assert ss_flow("demo", "--out", tmp_path / "a", "--until", "cameras", *room).code == 0
    assert "would run capture.ingest" in ss_flow("demo", *dry).out
    other = ss_flow("demo", *dry, "--seed", "1", "--json").document()["would_run"]
    assert [one["label"] for one in other] == ["demo.photographs"]
    assert not (tmp_path / "a/result").exists()


def test_the_demo_refuses_an_output_below_a_file_before_it_builds_anything(tmp_path):
    (tmp_path / "f").write_text("x")
    called = ss_flow("demo", "--out", tmp_path / "f", "--cache", tmp_path / "store")
    assert called.code == 2
    assert "f is not a writable folder" in called.err
