"""Editing a finished run from the command line."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import bytes_of, ss_flow

from ss_flow.cache.store import Store
from ss_flow.tasks.gaussians.read_ply import read_columns, read_gaussians
from ss_flow.tasks.geometry.cameras import up_of

SCENE_FILES = ("scene.ply", "scene_labeled.ply", "instances.json")
PICTURES = "edit.pictures.before_and_after"


def edit(warm, *operations: dict, out: str = "edited"):
    """`ss-flow edit --json` of the run with these operations; what it came to, and the folder."""
    place = warm.out.parent / out
    script = place.with_suffix(".json")
    script.parent.mkdir(exist_ok=True)
    script.write_text(json.dumps({"version": 1, "operations": list(operations)}))
    return ss_flow("edit", warm.out, script, "--out", place, "--cache", warm.store, "--json", "--jobs", "1"), place


def biggest(out: Path) -> int:
    entries = json.loads((out / "instances.json").read_text())["instances"]
    return max((e for e in entries if e["file"]), key=lambda e: e["num_gaussians"])["id"]


def test_an_empty_script_gives_the_same_scene(warm):
    called, place = edit(warm)
    assert called.code == 0, called.err
    for name in SCENE_FILES:
        assert (place / name).read_bytes() == (warm.out / name).read_bytes(), name
    assert bytes_of(place / "instances") == bytes_of(warm.out / "instances")


def test_dropping_the_last_operation_gives_the_bytes_before_and_computes_nothing(warm):
    own = biggest(warm.out)
    first, last = {"op": "recolour", "instances": own, "color": "#2040ff"}, {"op": "remove", "instances": own}
    _, alone = edit(warm, first, out="alone")
    called, _ = edit(warm, first, last)
    assert called.computed() == {"edit.remove": 1, "edit.holes": 1, PICTURES: 1}
    again, place = edit(warm, first)
    assert again.computed() == {}
    assert {n: (place / n).read_bytes() for n in SCENE_FILES} == {n: (alone / n).read_bytes() for n in SCENE_FILES}


def test_changing_the_last_operation_computes_only_that(warm):
    own = biggest(warm.out)
    turn = {"op": "transform", "instances": own, "rotate": {"axis": [0, 0, 1], "degrees": 30}}
    edit(warm, turn, {"op": "recolour", "instances": own, "color": [255, 0, 0]})
    called, _ = edit(warm, turn, {"op": "recolour", "instances": own, "color": [0, 255, 0]})
    assert called.computed() == {"edit.recolour": 1, PICTURES: 1}


def test_the_folder_tells_its_source_its_script_and_the_holes(warm):
    own = biggest(warm.out)
    operation = {"op": "remove", "instances": own, "fill": True, "comment": "in the way"}
    called, place = edit(warm, operation)
    document = json.loads((place / "run.json").read_text())
    assert document == called.document()
    assert document["edit"]["source"] == str(warm.out.resolve())
    assert document["edit"]["script"]["operations"] == [operation]
    (hole,) = document["edit"]["holes"]
    assert hole["operation"] == 1 and hole["instances"] == [own]
    removed = read_gaussians(warm.out / "scene_labeled.ply").instance_id == own
    left = len(removed) - removed.sum() - hole["cleared"] + document["edit"]["num_filled"]
    assert hole["cleared"] > 0 and len(read_gaussians(place / "scene_labeled.ply")) == left
    assert 0 <= hole["open_after_filling"] <= hole["unmeasured"] <= hole["pixels"]
    assert not (read_gaussians(place / "scene_labeled.ply").instance_id == own).any()
    columns = read_columns(place / "scene_labeled.ply")
    filled = columns["filled"].sum() if "filled" in columns.dtype.names else 0
    assert filled == document["edit"]["num_filled"]
    assert "before and after" in (place / "report.html").read_text()


def test_an_object_of_another_run_takes_the_place_of_one(warm, tmp_path):
    own = biggest(warm.out)
    other, _ = edit(warm, {"op": "recolour", "instances": own, "color": "#ff00ff"}, out="other")
    assert other.code == 0
    replacing = {"op": "replace", "instance": own, "run": "other", "by": own, "name": "the new one"}
    called, place = edit(warm, replacing)
    assert called.code == 0, called.err
    entries = {e["name"]: e for e in json.loads((place / "instances.json").read_text())["instances"]}
    new = read_gaussians(place / entries["the new one"]["file"])
    old = read_gaussians(place.parent / "other" / f"instances/{own:04d}.ply")
    np.testing.assert_allclose(new.means, old.means, atol=1e-5)
    np.testing.assert_array_equal(new.sh, old.sh)
    told = called.document()["edit"]["script"]["operations"]
    assert told == [replacing | {"run": str((place.parent / "other").resolve())}]
    again, _ = edit(warm, *told, out="elsewhere/edited")  # whose script stands in another folder
    assert again.computed() == {}


def test_an_object_of_a_run_with_other_axes_comes_upright(warm, tmp_path):
    own = biggest(warm.out)
    document = json.loads((warm.out / "run.json").read_text())
    store = Store(warm.store)
    cameras = store.get(document["results"]["cameras"])
    onto_its_side = np.eye(4)
    onto_its_side[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # the world turned by 90 degrees about x
    turned = replace(cameras, world_to_camera=cameras.world_to_camera @ onto_its_side)
    other = tmp_path / "other"
    shutil.copytree(warm.out, other)
    document["results"]["cameras"] = store.put(turned)
    (other / "run.json").write_text(json.dumps(document))
    called, place = edit(warm, {"op": "replace", "instance": own, "run": str(other), "by": own, "name": "new"})
    assert called.code == 0, called.err
    entries = {e["name"]: e for e in json.loads((place / "instances.json").read_text())["instances"]}
    new = read_gaussians(place / entries["new"]["file"]).means
    old = read_gaussians(other / f"instances/{own:04d}.ply").means
    here, there = (up_of(c.world_to_camera) for c in (cameras, turned))
    high = [(m - m.mean(axis=0)) @ up for m, up in ((new, here), (old, there))]
    scale = np.std(high[0]) / np.std(high[1])
    np.testing.assert_allclose(high[0], scale * high[1], atol=1e-4)


def test_an_object_of_a_run_whose_store_is_not_at_hand_is_placed_with_a_warning(warm, tmp_path):
    own, other = biggest(warm.out), tmp_path / "other"
    shutil.copytree(warm.out, other)
    document = json.loads((other / "run.json").read_text())
    (other / "run.json").write_text(json.dumps(document | {"store": "/nowhere"}))
    replacing = {"op": "replace", "instance": own, "run": "other", "by": own, "name": "new"}
    called, _ = edit(warm, replacing)
    assert called.document()["warnings"] == [], "the store of the edited run has its results"
    document["results"]["cameras"] = "ab" * 32
    (other / "run.json").write_text(json.dumps(document))
    called, place = edit(warm, replacing)
    (warning,) = called.document()["warnings"]
    assert warning["label"] == "replace[1]" and warning["text"].startswith("the cameras of other are in no store")
    assert warning["text"] in (place / "report.html").read_text()


@pytest.mark.parametrize("name", ["id", "name", "file", "parts", "crumb"])
def test_an_object_of_a_run_whose_instances_json_is_damaged_is_refused(warm, tmp_path, name):
    shutil.copytree(warm.out, tmp_path / "other")
    file = tmp_path / "other/instances.json"
    document = json.loads(file.read_text())
    for entry in document["instances"]:
        del entry[name]
    file.write_text(json.dumps(document))
    own = biggest(warm.out)
    called, place = edit(warm, {"op": "replace", "instance": own, "run": str(tmp_path / "other"), "by": own})
    assert called.code == 2 and not place.exists()
    assert "other/instances.json is damaged: an instance lacks what a run writes of it" in called.err


def test_a_bad_script_runs_nothing_and_writes_nothing(warm):
    called, place = edit(warm, {"op": "remove", "instances": "no such thing"})
    assert called.code == 2 and not place.exists() and called.out == ""
    assert "operation 1 (remove): instances is 'no such thing'" in called.err


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, "cannot be read"),
        ("{", "is not JSON"),
        ('{"operations": [{"op": "keep", "instances": 1, "instances": 2}]}', "'instances' stands twice in one object"),
        ("[]", "an edit script is a JSON object"),
        ("\ufeff[]", "an edit script is a JSON object"),  # the mark that editors on Windows put in front
    ],
)
def test_a_file_that_is_no_script_is_refused(tiny, tmp_path, text, sentence):
    script = tmp_path / "script.json"
    if text is not None:
        script.write_text(text)
    called = ss_flow("edit", tiny.out, script, "--out", tmp_path / "out", "--cache", tiny.store)
    assert called.code == 2 and sentence in called.err


def test_the_source_is_never_overwritten(warm):
    script = warm.out.parent / "script.json"
    script.write_text('{"operations": []}')
    before = bytes_of(warm.out)
    called = ss_flow("edit", warm.out, script, "--out", warm.out, "--cache", warm.store)
    assert called.code == 2 and "is the run that is edited; name another folder" in called.err
    assert bytes_of(warm.out) == before


def test_an_edited_run_is_edited_through_its_script(warm):
    _, place = edit(warm, {"op": "remove", "instances": biggest(warm.out)})
    called = ss_flow("edit", place, place.with_suffix(".json"), "--out", place.parent / "x", "--cache", warm.store)
    assert called.code == 2 and "add the operations to its script" in called.err
    asked = ss_flow("query", place, "red", "--cache", warm.store)
    assert asked.code == 2 and f"take its source, {warm.out.resolve()}." in asked.err


def test_of_an_edit_s_source_it_is_told_where_it_lies_now_and_whether_it_was_run_anew(warm, tmp_path):
    _, place = edit(warm)
    record = warm.out / "run.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"content": "ab" * 32}))
    anew = ss_flow("query", place, "red")
    assert f"take its source, {warm.out.resolve()}, which was run anew since, so that" in anew.err
    shutil.move(warm.out, tmp_path / "moved" / "out")
    assert f"{warm.out.resolve()}, which is no longer there." in ss_flow("query", place, "red").err
    place = shutil.move(place, tmp_path / "moved" / "edited")
    assert f"{tmp_path}/moved/out, which was run anew since" in ss_flow("query", place, "red").err


def test_an_edited_run_is_exported_but_for_what_its_photos_do_not_show(warm):
    gone = biggest(warm.out)
    _, place = edit(warm, {"op": "remove", "instances": gone})
    ply = place.parent / "edited.ply"
    called = ss_flow("export", place, "--format", "labelled-ply", "--out", ply, "--cache", warm.store)
    assert called.code == 0, called.err
    assert ply.read_bytes() == (place / "scene_labeled.ply").read_bytes()
    for format, lacking in (("coco", "masks"), ("colmap", "masks"), ("nerfstudio", "photos")):
        refused = ss_flow("export", place, "--format", format, "--out", place.parent / "x", "--cache", warm.store)
        assert refused.code == 2
        assert f"edited run, which has no {lacking} of its own; take its source, {warm.out.resolve()}." in refused.err


@pytest.mark.parametrize("protocol", ["views", "points", "objects"])
def test_an_edited_run_is_not_measured(warm, protocol):
    _, place = edit(warm)
    refused = ss_flow("eval", place, "--protocol", protocol, "--cache", warm.store)
    assert refused.code == 2 and "is an edited run, which has no" in refused.err
    assert f"of its own; take its source, {warm.out.resolve()}." in refused.err


def test_a_scene_that_the_store_no_longer_holds_is_refused(warm, tmp_path):
    script = tmp_path / "script.json"
    script.write_text('{"operations": []}')
    (tmp_path / "other").mkdir()
    called = ss_flow("edit", warm.out, script, "--out", tmp_path / "out", "--cache", tmp_path / "other")
    assert called.code == 2 and "no longer holds scene" in called.err


def test_the_page_s_lines_of_python_edit_a_run(warm, monkeypatch, capsys):
    page = (Path(__file__).parents[2] / "docs" / "editing.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL).group(1)
    own = biggest(warm.out)
    entries = json.loads((warm.out / "instances.json").read_text())["instances"]
    entry = next(e for e in entries if e["id"] == own)
    (warm.out.parent / "ss-flow-demo").mkdir()
    (warm.out.parent / "ss-flow-demo" / "result").symlink_to(warm.out)
    run = json.loads((warm.out / "run.json").read_text())
    (warm.out / "run.json").write_text(json.dumps(run | {"store": str(warm.store)}))
    monkeypatch.chdir(warm.out.parent)
    exec(compile(code.replace("red object", entry["name"]), "docs/editing.md", "exec"), {})
    assert f"({entry['num_gaussians']}, 3)" in capsys.readouterr().out
    assert set(read_gaussians(Path("only-red/scene_labeled.ply")).instance_id) == {own}
