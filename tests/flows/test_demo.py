"""`ss-flow demo`: a room is built once, run, and measured."""

from __future__ import annotations

import json

from tiny_runs import ss_flow


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
    assert "holds something else than a demo scene" in called.err
    assert (tmp_path / "demo/scene/holiday.jpg").read_text() == "mine"


def test_the_demo_refuses_an_output_below_a_file_before_it_builds_anything(tmp_path):
    (tmp_path / "f").write_text("x")
    called = ss_flow("demo", "--out", tmp_path / "f", "--cache", tmp_path / "store")
    assert called.code == 2
    assert "f is not a writable folder" in called.err
