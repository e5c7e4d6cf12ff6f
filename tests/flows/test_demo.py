"""`ss-flow demo`: a room is built once, run, and measured."""

from __future__ import annotations

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
