"""A finished run in other formats."""

from __future__ import annotations

import errno
import json
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_runs import bytes_of, ss_flow

from ss_flow.cache.store import Store
from ss_flow.flows.cli.export import file_name
from ss_flow.tasks.capture.names import view_names
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.read_ply import read_columns, read_gaussians


def ids_of(tiny) -> list[int]:
    entries = json.loads((tiny.out / "instances.json").read_text())["instances"]
    return [entry["id"] for entry in entries if entry["file"]]


def export(tiny, *more):
    return ss_flow("export", tiny.out, "--cache", tiny.store, *more)


def test_the_labelled_scene_is_that_of_the_output_folder(tiny, tmp_path):
    answer = export(tiny, "--format", "labelled-ply", "--out", tmp_path / "a.ply")
    assert answer.code == 0, answer.err
    assert (tmp_path / "a.ply").read_bytes() == (tiny.out / "scene_labeled.ply").read_bytes()


def test_chosen_instances_by_id_and_by_name_are_all_that_the_file_holds(tiny, tmp_path):
    entries = json.loads((tiny.out / "instances.json").read_text())["instances"]
    first, second = [entry for entry in entries if entry["num_gaussians"]][:2]
    chosen = ["--instance", str(first["id"]), "--instance", second["name"]]
    answer = export(tiny, "--format", "labelled-ply", *chosen, "--out", tmp_path / "a.ply", "--json")
    assert answer.document()["files"][0]["instances"] == sorted([first["id"], second["id"]])
    found = read_gaussians(tmp_path / "a.ply").instance_id
    assert set(found.tolist()) == {first["id"], second["id"]}
    assert len(found) == first["num_gaussians"] + second["num_gaussians"]


@pytest.mark.parametrize("format", ["compressed-ply", "splat", "spz", "gltf", "usda"])
def test_every_format_writes_one_file_and_the_same_bytes_again(tiny, tmp_path, format):
    answers = [export(tiny, "--format", format, "--out", tmp_path / f"{i}", "--json") for i in range(2)]
    assert [answer.code for answer in answers] == [0, 0]
    assert answers[0].document()["files"][0]["bytes"] == (tmp_path / "0").stat().st_size > 0
    assert (tmp_path / "0").read_bytes() == (tmp_path / "1").read_bytes()


def test_each_gives_a_folder_with_a_file_an_instance_and_a_list_of_them(tiny, tmp_path):
    out = tmp_path / "objects"
    assert export(tiny, "--format", "spz", "--each", "--out", out).code == 0
    listed = json.loads((out / "export.json").read_text())["files"]
    assert [file["instances"] for file in listed] == [[i] for i in ids_of(tiny)]
    assert sorted(bytes_of(out)) == sorted(["export.json", *(file["file"] for file in listed)])
    assert export(tiny, "--format", "splat", "--each", "--out", out).code == 0  # in the place of the earlier one
    assert {file.suffix for file in out.iterdir()} == {".json", ".splat"}


def test_meshes_come_as_a_folder_of_objects_and_as_one_scene(tiny, tmp_path):
    answer = export(tiny, "--format", "mesh-ply", "--out", tmp_path / "meshes", "--json")
    assert answer.code == 0, answer.err
    assert [file["instances"][0] for file in answer.document()["files"]] == ids_of(tiny)
    assert all((tmp_path / "meshes" / f["file"]).read_bytes().startswith(b"ply\n") for f in answer.document()["files"])
    assert export(tiny, "--format", "mesh-glb", "--out", tmp_path / "a.glb").code == 0
    assert (tmp_path / "a.glb").read_bytes()[:4] == b"glTF"


def test_coco_says_what_the_masks_show_in_the_pixels_of_the_photos(tiny, tmp_path):
    answer = export(tiny, "--format", "coco", "--out", tmp_path / "a.json")
    assert answer.code == 0, answer.err
    document = json.loads((tmp_path / "a.json").read_text())
    photos = sorted((tiny.scene / "color").iterdir())
    assert [image["file_name"] for image in document["images"]] == [photo.name for photo in photos]
    seen = 0
    for image, photo in zip(document["images"], photos, strict=True):
        ids = cv2.imread(str(tiny.out / "masks" / f"{photo.stem}.png"), cv2.IMREAD_UNCHANGED)
        assert cv2.imread(str(photo)).shape[:2] == (image["height"], image["width"]) == ids.shape
        own = [a for a in document["annotations"] if a["image_id"] == image["id"]]
        assert sorted(a["instance_id"] for a in own) == sorted(set(np.unique(ids).tolist()) & set(ids_of(tiny)))
        for annotation in own:
            mask = ids == annotation["instance_id"]
            counts = annotation["segmentation"]["counts"]
            runs = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
            np.testing.assert_array_equal(runs.reshape(ids.shape[::-1]).T, mask)
            x, y, width, height = annotation["bbox"]
            assert mask[y : y + height, x : x + width].sum() == annotation["area"] == mask.sum()
            seen += 1
    assert seen > 4


def test_coco_holds_instances_that_are_in_masks_only_and_crumbs_when_they_are_named(warm, tmp_path):
    file = warm.out / "instances.json"
    document = json.loads(file.read_text())
    bare, crumb, *rest = document["instances"]
    for entry, is_crumb in ((bare, False), (crumb, True)):
        entry.update(file=None, num_gaussians=0, weak=is_crumb, crumb=is_crumb)
    file.write_text(json.dumps(document))
    whole, named = tmp_path / "whole.json", tmp_path / "named.json"
    assert export(warm, "--format", "coco", "--out", whole).code == 0
    annotated = {a["instance_id"] for a in json.loads(whole.read_text())["annotations"]}
    assert annotated == {bare["id"], *(entry["id"] for entry in rest if not entry["crumb"])}
    answer = export(
        warm, "--format", "coco", "--instance", crumb["name"], "--instance", str(bare["id"]), "--out", named
    )
    assert answer.code == 0, answer.err
    assert {a["instance_id"] for a in json.loads(named.read_text())["annotations"]} == {bare["id"], crumb["id"]}
    answer = export(warm, "--format", "ply", "--instance", str(bare["id"]), "--out", tmp_path / "a.ply")
    assert answer.code == 2 and "has no Gaussians" in answer.err


def test_coco_names_photos_of_a_rig_by_the_folders_that_tell_them_from_each_other():
    called = ("cam_1/left/0001.jpg", "cam_1/right/0001.jpg", "cam_2/0001.jpg")
    photos = [Path("/a/images") / name for name in called]
    views = view_names(photos)
    assert tuple(file_name(views[photo], photo) for photo in photos) == called
    alone = Path("/a/left/left_0001.jpg")
    assert file_name(view_names([alone])[alone], alone) == "left_0001.jpg"


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are UTF-8 there")
def test_masks_whose_path_is_no_text_are_read(warm, tmp_path):
    out = warm.out.rename(tmp_path / "out\udcff")
    answer = ss_flow("export", out, "--cache", warm.store, "--format", "coco", "--out", tmp_path / "a.json")
    assert answer.code == 0, answer.err
    assert json.loads((tmp_path / "a.json").read_text())["annotations"]
    assert ss_flow("diff", out, out, "--json").code == 0


def test_coco_can_be_given_to_a_run_as_its_masks(tiny, tmp_path):
    export(tiny, "--format", "coco", "--out", tmp_path / "a.json")
    asked = ["--masks", tmp_path / "a.json", "--until", "segment", "--preset", "fast", "--json"]
    answer = ss_flow("run", tiny.scene, *asked, "--cache", tmp_path / "store")
    assert answer.code == 0, answer.err


@pytest.mark.parametrize("format", ["colmap", "nerfstudio"])
def test_photos_and_cameras_come_out_as_a_capture_with_the_same_cameras(tiny, tmp_path, format):
    answer = export(tiny, "--format", format, "--out", tmp_path / "a", "--json")
    assert answer.code == 0, answer.err
    read, given = open_scene(tmp_path / "a"), open_scene(tiny.scene)
    assert read.kind == format and read.names == given.names
    np.testing.assert_allclose(read.poses, given.poses, atol=1e-6)
    for ours, theirs in zip(read.lenses, given.lenses, strict=True):
        assert (ours.width, ours.height, ours.pinhole) == (96, 72, True)
        np.testing.assert_allclose((ours.fx, ours.fy, ours.cx, ours.cy), (theirs.fx, theirs.fy, theirs.cx, theirs.cy))
    again = export(tiny, "--format", format, "--out", tmp_path / "a")
    assert again.code == 0, again.err


def test_without_a_place_no_format_replaces_the_export_of_another(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = ("--instance", str(ids_of(tiny)[0]))
    asked = [("ply",), ("labelled-ply",), ("gltf",), ("mesh-glb", *one), ("mesh-obj", *one), ("mesh-ply", *one)]
    asked += [("colmap",), ("nerfstudio",), ("ply", "--each", *one)]
    places = []
    for format, *more in asked:
        answer = export(tiny, "--format", format, *more, "--json")
        assert answer.code == 0, answer.err
        places.append(answer.document()["out"].removeprefix(f"ss-flow-export/{tiny.out.name}"))
    of_one = f"-{ids_of(tiny)[0]:04d}"
    assert places[:4] == [".ply", "-labelled.ply", ".glb", f"{of_one}-mesh.glb"]
    assert places[4:] == [f"{of_one}-mesh-obj", f"{of_one}-mesh-ply", "-colmap", "-nerfstudio", f"{of_one}-ply"]


def test_without_a_place_chosen_instances_have_their_ids_in_the_name_and_leave_the_whole_scene(
    tiny, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert export(tiny, "--format", "splat").code == 0
    whole = bytes_of(tmp_path)
    ids = [0, *ids_of(tiny)]
    for count in (1, 3, 4):
        asked = [word for i in reversed(ids[:count]) for word in ("--instance", str(i))]
        answer = export(tiny, "--format", "splat", *asked, "--json")
        named = "selected" if count == 4 else "-".join(f"{i:04d}" for i in ids[:count])
        assert answer.document()["out"] == f"ss-flow-export/{tiny.out.name}-{named}.splat"
    assert len(bytes_of(tmp_path)) == 4 and bytes_of(tmp_path).items() > whole.items()


def test_a_small_file_is_told_in_thousands_of_bytes(tiny, tmp_path):
    told = export(tiny, "--format", "ply", "--instance", str(ids_of(tiny)[0]), "--out", tmp_path / "a.ply").out
    size = (tmp_path / "a.ply").stat().st_size
    assert size < 1e6 and f"1 file, {size / 1e3:.3g} kB)" in told


def test_a_glb_is_not_written_under_the_name_of_gltfs_other_form(tiny, tmp_path):
    answer = export(tiny, "--format", "gltf", "--out", tmp_path / "a.gltf")
    assert answer.code == 2 and "a file of gltf ends in .glb" in answer.err


def test_a_second_export_computes_nothing(tiny, tmp_path):
    one = str(ids_of(tiny)[0])
    export(tiny, "--format", "mesh-obj", "--instance", one, "--out", tmp_path / "a")
    again = export(tiny, "--format", "mesh-obj", "--instance", one, "--out", tmp_path / "b")
    assert "done" not in again.out + again.err
    assert bytes_of(tmp_path / "a") | bytes_of(tmp_path / "b") == bytes_of(tmp_path / "a")


def test_the_background_is_an_instance_when_it_is_asked_for(tiny, tmp_path):
    answer = export(tiny, "--format", "ply", "--instance", "0", "--out", tmp_path / "a.ply")
    assert answer.code == 0, answer.err
    rows = read_columns(tiny.out / "scene_labeled.ply")
    assert len(read_columns(tmp_path / "a.ply")) == np.count_nonzero(rows["instance_id"] == 0)


def with_scene(run, change) -> None:
    """Have the run's scene be another."""
    record = run.out / "run.json"
    document, store = json.loads(record.read_text()), Store(run.store)
    document["results"]["scene"] = store.put(change(store.get(document["results"]["scene"])))
    record.write_text(json.dumps(document))


@pytest.mark.parametrize("format", ["spz", "mesh-ply"])
def test_a_background_without_gaussians_is_not_written(warm, tmp_path, format):
    with_scene(warm, lambda scene: select(scene, scene.instance_id != 0))
    answer = export(warm, "--format", format, "--instance", "0", "--out", tmp_path / "a")
    assert answer.code == 2 and f"the background of {warm.out} has no Gaussians" in answer.err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("more", [["spz"], ["gltf", "--each"], ["mesh-glb"]])
def test_a_scene_without_gaussians_is_not_written(warm, tmp_path, more):
    with_scene(warm, lambda scene: select(scene, np.zeros(len(scene), bool)))
    answer = export(warm, "--format", *more, "--out", tmp_path / "a")
    assert answer.code == 2 and f"{warm.out} has no Gaussians" in answer.err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("more", [["spz", "--each"], ["mesh-obj"], ["mesh-glb"]])
def test_where_no_instance_has_a_file_nothing_is_written(warm, tmp_path, more):
    file = warm.out / "instances.json"
    document = json.loads(file.read_text())
    document["instances"] = [entry | {"file": None} for entry in document["instances"]]
    file.write_text(json.dumps(document))
    answer = export(warm, "--format", *more, "--out", tmp_path / "a")
    assert answer.code == 2 and f"no instance of {warm.out} has a file of its own" in answer.err
    assert not (tmp_path / "a").exists()


def test_where_all_instances_are_crumbs_no_coco_is_written(warm, tmp_path):
    file = warm.out / "instances.json"
    document = json.loads(file.read_text())
    document["instances"] = [entry | {"file": None, "crumb": True} for entry in document["instances"]]
    file.write_text(json.dumps(document))
    answer = export(warm, "--format", "coco", "--out", tmp_path / "a.json")
    assert answer.code == 2 and f"no instance of {warm.out} is more than a crumb" in answer.err
    assert not (tmp_path / "a.json").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--format", "ply", "--instance", "no such"], "is no instance of"),
        (["--format", "ply", "--holes", "closed"], "is for meshes"),
        (["--format", "ply", "--jobs", "-1"], "out of range"),
        (["--format", "colmap", "--instance", "1"], "holds photos and cameras"),
        (["--format", "coco", "--each"], "tells all instances in one file"),
        (["--format", "gltf"], "a.ply is named like another format; a file of gltf ends in .glb."),
    ],
)
def test_bad_usage_gets_one_sentence(tiny, tmp_path, more, said):
    answer = export(tiny, *more, "--out", tmp_path / "a.ply")
    assert answer.code == 2 and said in answer.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("format", "name"),
    [("ply", "scene.ply"), ("ply", "instances/0001.ply"), ("coco", "run.json"), ("ply", "masks/new.ply")],
)
def test_the_files_of_a_result_are_never_written_over(tiny, format, name):
    before = {path: path.stat().st_mtime_ns for path in tiny.out.rglob("*")}
    answer = export(tiny, "--format", format, "--out", tiny.out / name)
    assert answer.code == 2 and "it is part of a result; name another file with --out." in answer.err
    assert {path: path.stat().st_mtime_ns for path in tiny.out.rglob("*")} == before


def test_a_folder_of_something_else_stays_as_it_is(tiny, tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"x")
    answer = export(tiny, "--format", "mesh-ply", "--out", tmp_path)
    assert answer.code == 2 and "holds something else than an earlier export" in answer.err
    assert export(tiny, "--format", "ply", "--out", tmp_path).code == 2
    assert [file.name for file in tmp_path.iterdir()] == ["photo.jpg"]


def test_a_folder_that_is_no_result_is_said_to_be_none(tmp_path):
    answer = ss_flow("export", tmp_path, "--format", "ply")
    assert answer.code == 2 and "is not the output folder of a run" in answer.err


def test_a_full_disk_gets_one_sentence_and_leaves_no_part(tiny, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    answer = export(tiny, "--format", "ply", "--out", tmp_path / "a.ply")
    assert answer.code == 1 and not list(tmp_path.iterdir())
    assert "the output cannot be written: No space left on device; what was computed is kept" in answer.err
