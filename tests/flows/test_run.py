"""What a run gives, and how it ends when something fails."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import sys
from pathlib import Path

import capture_folders as made
import cv2
import numpy as np
import pytest
from tiny_runs import SHORT, run_tiny, ss_flow, write_room

from ss_flow.cache.store import Store
from ss_flow.flows.cli import run as run_module
from ss_flow.flows.generated import RoomParams
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver import ply
from ss_flow.tasks.gaussians.read_ply import read_columns
from ss_flow.tasks.splat import reconstruct as reconstruct_module

STANDARD = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
LABELS = ["instance_id", "instance_conf", "part_id"]
VIEWS = [f"{k:04d}" for k in range(5)]


def test_a_run_writes_what_the_readme_lists_and_nothing_else(tiny):
    assert sorted(path.name for path in tiny.out.iterdir()) == [
        "cloud_labeled.ply",
        "instances",
        "instances.json",
        "masks",
        "masks_split",
        "report.html",
        "run.json",
        "scene.ply",
        "scene_labeled.ply",
    ]
    assert not list(tiny.out.parent.glob(".out.*"))


def test_by_default_the_output_is_named_after_the_folder_the_file_or_a_transforms_jsons_folder(tmp_path, monkeypatch):
    made.photos(tmp_path / "room 2024.05.01")
    made.nerfstudio(tmp_path / "kitchen")
    made.video(tmp_path / "walk.avi", count=2)
    places: list[Path] = []
    monkeypatch.setattr(run_module, "run_scene", lambda scene, out, *others, **options: places.append(out))
    for capture in ("room 2024.05.01", "kitchen", "kitchen/transforms.json", "walk.avi"):
        run_module.Run(tmp_path / capture).run()
    assert [str(place) for place in places] == [
        "ss-flow-out/room 2024.05.01",
        *["ss-flow-out/kitchen"] * 2,
        "ss-flow-out/walk",
    ]


def test_a_stride_thins_a_video_too(tmp_path):
    video, store = made.video(tmp_path / "walk.avi"), tmp_path / "store"
    until = ("--until", "video_frames", "--set", "capture.video.max_frames=10", "capture.video.min_sharpness=0")
    counts = []
    for further in ((), ("--set", "capture.stride=2"), ("--set", "capture.stride=2", "capture.video.stride=8")):
        called = run_tiny(video, store, *until, *further)
        counts.append(len(called.results()["video_frames"]))
    assert counts == [10, 5, 3]


def test_the_scene_is_a_standard_splat_and_the_labelled_one_has_the_same_rows(tiny):
    plain, labelled = (read_columns(tiny.out / name) for name in ("scene.ply", "scene_labeled.ply"))
    names = list(plain.dtype.names)
    assert names[: len(STANDARD)] == STANDARD
    assert list(labelled.dtype.names) == [*names, *LABELS]
    np.testing.assert_array_equal(labelled[names], plain)


def test_every_instance_has_a_file_an_entry_and_its_rows_of_the_scene(tiny):
    document = json.loads((tiny.out / "instances.json").read_text())
    ids = [entry["id"] for entry in document["instances"] if entry["file"]]
    files = {int(path.stem): path for path in (tiny.out / "instances").iterdir()}
    scene = read_columns(tiny.out / "scene_labeled.ply")
    assert sorted(files) == ids == sorted(set(scene["instance_id"].tolist()) - {0})
    assert len(ids) >= 4  # table, shelf, sofa and two things, of which one is seen in few views
    for instance_id, path in files.items():
        rows = read_columns(path)
        assert set(rows["instance_id"].tolist()) == {instance_id}
        np.testing.assert_array_equal(rows["x"], scene["x"][scene["instance_id"] == instance_id])


@pytest.mark.parametrize("stage", ["masks_split", "masks"])
def test_the_masks_are_id_images_named_and_sized_like_the_photos(stage, tiny):
    assert sorted(path.stem for path in (tiny.out / stage).iterdir()) == VIEWS
    entries = json.loads((tiny.out / "instances.json").read_text())["instances"]
    known = {0} | {entry["id"] for entry in entries}
    for view in VIEWS:
        ids = cv2.imread(str(tiny.out / stage / f"{view}.png"), cv2.IMREAD_UNCHANGED)
        assert (ids.dtype, ids.shape) == (np.uint16, (72, 96))
        assert set(np.unique(ids).tolist()) <= known


def test_with_true_masks_every_object_keeps_its_pixels(tiny):
    for view in VIEWS:
        truth = cv2.imread(str(tiny.scene / "instance" / f"{view}.png"), cv2.IMREAD_UNCHANGED)
        ids = cv2.imread(str(tiny.out / "masks_split" / f"{view}.png"), cv2.IMREAD_UNCHANGED)
        for number in np.unique(truth[truth > 0]):
            own, count = np.unique(ids[truth == number], return_counts=True)
            assert own[count.argmax()] > 0
            assert count.max() > 0.9 * count.sum()


def test_the_labelled_cloud_has_labels_of_the_scene(tiny):
    cloud = read_columns(tiny.out / "cloud_labeled.ply")
    assert {"x", "y", "z", "red", "green", "blue", "instance_id"} <= set(cloud.dtype.names)
    assert set(cloud["instance_id"].tolist()) - {0}


def test_run_json_holds_what_was_asked_what_was_done_and_what_was_measured(tiny):
    document = json.loads((tiny.out / "run.json").read_text())
    assert document["status"] == "ok" and document["failures"] == []
    assert Path(document["scene"]) == tiny.scene
    assert document["params"]["split.propagate.tau_label"] == 0.7
    assert document["params"]["splat.reconstruct.max_iterations"] == 20
    assert document["models"] == {
        "segmenter": "ready-made masks",
        "encoder": "colour words (no network)",
        "monodepth": None,
        "patches": None,
        "perception": None,
    }
    assert set(document["metrics"]) == {"split", "refined", "splat"}
    assert document["metrics"]["split"]["miou"] > 0.9
    nodes = document["nodes"]
    assert {"step", "item", "key", "outputs", "hit", "seconds", "peak_rss_mb"} <= nodes[0].keys()
    assert sorted(n["item"] for n in nodes if n["step"] == "split.visibility") == VIEWS
    assert all(n["peak_rss_mb"] > 0 and n["seconds"] >= 0 for n in nodes)


def test_run_json_names_the_capture_so_that_it_is_found_from_elsewhere(warm, tmp_path, monkeypatch):
    (tmp_path / "link").symlink_to(warm.scene)
    (tmp_path / "splat.ply").write_bytes((warm.out / "scene.ply").read_bytes())
    monkeypatch.chdir(tmp_path)
    assert run_tiny(Path("link"), warm.store, out=Path("out")).document()["scene"] == str(tmp_path / "link")
    labelled = run_tiny(Path("link"), warm.store, "--scene", "splat.ply", "--until", "ingest").document()
    assert labelled["given_scene"] == str(tmp_path / "splat.ply")
    monkeypatch.chdir(warm.scene)
    photos = sorted(photo.name for photo in (warm.scene / "color").iterdir())
    assert ss_flow("export", warm.out, "--format", "coco", "--out", tmp_path / "a.json").code == 0
    assert [image["file_name"] for image in json.loads((tmp_path / "a.json").read_text())["images"]] == photos


def test_with_json_stdout_holds_one_document_and_it_is_run_json(first_run):
    on_disk = json.loads((first_run.out / "run.json").read_text())
    printed = first_run.called.document()
    assert {k: v for k, v in on_disk.items() if k != "delivered"} == {
        k: v for k, v in printed.items() if k != "delivered"
    }


def test_the_report_names_the_scene_and_stands_alone(tiny):
    html = (tiny.out / "report.html").read_text()
    assert "room" in html
    assert "data:image/" in html
    assert 'src="http' not in html and 'href="http' not in html


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are UTF-8 there")
def test_a_capture_whose_path_is_no_text_is_delivered_and_edited(warm, tmp_path):
    scene = shutil.copytree(warm.scene, tmp_path / "sc\udcff")
    called = run_tiny(scene, warm.store, out=warm.out)
    assert called.code == 0 and called.document()["scene"] == str(scene)
    (tmp_path / "script.json").write_text('{"operations": [{"op": "remove", "instances": [1]}]}')
    assert ss_flow("edit", warm.out, tmp_path / "script.json", "--out", tmp_path / "edited").code == 0
    for out in (warm.out, tmp_path / "edited"):
        assert "sc\\udcff" in (out / "report.html").read_text(encoding="utf-8")


def test_photos_that_are_scaled_down_on_the_way_in_give_masks_of_their_own_size(tiny, tmp_path):
    called = run_tiny(tiny.scene, tmp_path / "store", "--set", "ingest.max_side=48", out=tmp_path / "out")
    assert called.code == 0, called.err
    ids = cv2.imread(str(tmp_path / "out/masks/0000.png"), cv2.IMREAD_UNCHANGED)
    assert ids.shape == (72, 96)
    assert len(np.unique(ids)) > 2


def test_views_kept_back_are_measured_and_the_photo_whose_colours_the_scene_has_is_named(tmp_path):
    room = write_room(tmp_path / "room", params=RoomParams(objects=1, views=4, width=64, height=48, held_out=2))
    for photo in sorted((room / "color").iterdir())[::2]:
        cv2.imwrite(str(photo), cv2.imread(str(photo)) // 2)
    called = run_tiny(room, tmp_path / "store", out=tmp_path / "out")
    assert called.code == 0, called.err
    assert called.document()["reference_photo"] in {path.stem for path in (room / "color").iterdir()}
    assert any("change from photo to photo" in said["text"] for said in called.document()["warnings"])
    measured = called.document()["metrics"]["novel_view"]
    assert 5 < measured["psnr"] < 60 and measured["psnr"] < measured["psnr_colour_fitted"]
    assert 5 < measured["psnr_neighbour_colours"] < measured["psnr_colour_fitted"] + 0.1
    assert "lpips" not in measured and "not measured (no network)" in (tmp_path / "out/report.html").read_text()


def test_a_new_result_takes_the_place_of_the_old_one_whole(warm):
    (warm.out / "instances/0099.ply").write_text("of an older run")
    document = json.loads((warm.out / "run.json").read_text())
    document["files"]["instances/0099.ply"] = 15
    (warm.out / "run.json").write_text(json.dumps(document))
    called = run_tiny(warm.scene, warm.store, "--set", "merge.global_iterations=5", out=warm.out)
    assert called.code == 0
    assert not (warm.out / "instances/0099.ply").exists()
    assert not list(warm.out.parent.glob(".out.*"))


def test_words_for_people_tell_what_was_measured_and_made(warm):
    told = ss_flow(
        "run", warm.scene, "--out", warm.out, "--cache", warm.store, "--preset", "fast", "--until", "masks_split"
    )
    assert told.code == 0
    assert "results computed" in told.out and "reused" in told.out
    assert told.err == ""
    assert told.out.endswith(
        "--until masks_split stops before the output (`ss-flow cache show masks_split` shows the result): "
        f"{warm.out} is not written\n"
    )


def test_until_stops_there_and_writes_no_output(tiny, tmp_path):
    called = run_tiny(tiny.scene, tmp_path / "store", "--until", "dense", out=tmp_path / "out")
    assert called.code == 0
    steps = {n["step"] for n in called.document()["nodes"]}
    of_poses = {"capture.cameras", "capture.pose_pairs", "capture.pose_fit"}
    of_depth = {"capture.sensor_depth", "capture.registration", "capture.depth_scale", "capture.unit"}
    assert steps == {"capture.ingest", *of_poses, *of_depth, "capture.colours", "split.dense"}
    assert not (tmp_path / "out").exists()


def test_until_takes_every_name_that_status_shows(warm, tmp_path):
    ran = tmp_path / "ran"
    run_tiny(warm.scene, warm.store, out=tmp_path / "latest")  # other tests may have edited its result since
    steps = json.loads(ss_flow("status", "--json", "--cache", warm.store).out)["steps"]
    assert len(steps) > 25
    for step in (*steps, "split.visibility[0003]", "masks_split"):
        called = run_tiny(warm.scene, warm.store, "--until", step, out=ran)
        assert called.code == 0, called.err
        nodes = called.document()["nodes"]
        assert all(node["hit"] for node in nodes)
        of_step = [node for node in nodes if node["step"] == step.partition("[")[0]]
        assert len(of_step) == steps.get(step, {"expected": 5 if "[" in step else 0})["expected"], step
        if step in ("split.visibility", "split.dense"):
            assert "split.propagate" not in {node["step"] for node in nodes}
    assert not ran.exists()


def test_a_dry_run_tells_what_would_run_and_runs_nothing(warm, tmp_path):
    actions = sorted((warm.store / "actions").rglob("*.json"))
    runs = sorted((warm.store / "roots/runs").iterdir())
    told = run_tiny(warm.scene, warm.store, "--dry-run", "--set", "tau_label=0.95", out=tmp_path / "new")
    assert told.code == 0
    assert told.document() == {"would_run": [{"label": "split.propagate", "why": "parameter tau_label 0.7 -> 0.95"}]}
    words = ss_flow(
        "run", warm.scene, "--cache", warm.store, "--preset", "fast", "--dry-run", "--out", tmp_path / "new"
    )
    assert "would run split.dense: parameter max_points" in words.out
    assert "would follow split.propagate" in words.out
    assert sorted((warm.store / "actions").rglob("*.json")) == actions
    assert sorted((warm.store / "roots/runs").iterdir()) == runs
    assert not (tmp_path / "new").exists()


def test_a_dry_run_tells_of_many_nodes_of_a_step_once(warm, tmp_path):
    more = ["--preset", "fast", *SHORT, "--dry-run", "--set", "split.visibility.tau_depth=0.5"]
    words = ss_flow("run", warm.scene, "--cache", warm.store, *more, "--out", tmp_path / "new").out
    (line,) = (line for line in words.splitlines() if line.startswith("would run split.visibility"))
    assert re.fullmatch(r"would run split\.visibility \d+ times: parameter tau_depth .* -> 0\.5", line)


@pytest.fixture
def failing(monkeypatch):
    """Have the training of some instances fail, in runs that start no process of their own."""
    real = reconstruct_module._from_points

    def fail(which) -> None:
        def begin(instance, params) -> Gaussians:
            if which(instance.instance_id):
                raise ArithmeticError(f"instance [{instance.instance_id}] went wrong")
            return real(instance, params)

        monkeypatch.setattr(reconstruct_module, "_from_points", begin)

    return fail


def test_when_one_instance_fails_the_others_are_delivered_and_the_run_is_degraded(tiny, failing, tmp_path):
    failing(lambda instance_id: instance_id == 2)
    called = run_tiny(tiny.scene, tmp_path / "store", "--executor", "threads", out=tmp_path / "out")
    assert called.code == 3, called.err
    document = called.document()
    assert document["status"] == "degraded"
    assert document["failures"] == [
        {"label": "splat.reconstruct[2]", "error": "ArithmeticError: instance [2] went wrong"}
    ]
    entries = json.loads((tmp_path / "out/instances.json").read_text())["instances"]
    assert 2 not in [entry["id"] for entry in entries] and len(entries) >= 3
    assert not (tmp_path / "out/instances/0002.ply").exists()
    assert 2 not in read_columns(tmp_path / "out/scene_labeled.ply")["instance_id"]
    assert "degraded" in (tmp_path / "out/report.html").read_text()
    words = ss_flow("status", "--cache", tmp_path / "store").out
    assert "done, 1 failed" in words
    failing(lambda instance_id: False)
    mended = run_tiny(tiny.scene, tmp_path / "store", out=tmp_path / "out")
    assert (mended.code, mended.document()["status"]) == (0, "ok")
    assert mended.results() == tiny.called.results()


def test_a_pair_and_a_last_pass_that_fail_leave_the_union_and_the_run_is_degraded(warm, monkeypatch):
    def fail(*_, **__):
        raise ArithmeticError("diverged")

    for module in ("merge", "global_pass"):
        monkeypatch.setattr(f"ss_flow.tasks.splat.{module}.train", fail)
    all_collide = ["--set", "plan.overlap=voxel", "--set", "plan.voxel=20", "--set", "merge.rates.color=0.03"]
    called = run_tiny(warm.scene, warm.store, *all_collide, "--executor", "threads", out=warm.out)
    assert called.code == 3, called.err
    document = called.document()
    failed = {failure["label"].partition("[")[0] for failure in document["failures"]}
    assert failed == {"splat.merge_pair", "splat.global_pass"}
    scene = Store(warm.store).get(document["results"]["scene"])
    groups = [Store(warm.store).get(digest) for digest in warm.called.results()["merge"]]
    assert {*scene.instance_id.tolist()} == {i for group in groups for i in group.instance_id.tolist()}
    assert (warm.out / "scene.ply").exists()


def test_when_a_step_that_all_need_fails_the_run_fails_and_the_earlier_result_stays(warm, monkeypatch):
    def fail(*_):
        raise ArithmeticError("nothing fits")

    monkeypatch.setattr("ss_flow.tasks.splat.global_pass.concatenate", fail)
    before = {path.name: path.read_bytes() for path in warm.out.iterdir() if path.is_file()}
    called = run_tiny(warm.scene, warm.store, "--set", "reconstruct.min_iterations=13", out=warm.out)
    assert called.code == 1
    assert called.document()["status"] == "failed"
    assert called.document()["failures"] == [{"label": "splat.assemble", "error": "ArithmeticError: nothing fits"}]
    assert "failed splat.assemble: ArithmeticError: nothing fits" in called.err
    assert "Traceback" not in called.err
    assert {path.name: path.read_bytes() for path in warm.out.iterdir() if path.is_file()} == before


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EFBIG, errno.ENOENT])
def test_a_disk_that_does_not_take_the_output_gets_one_sentence_and_leaves_no_part(number, warm, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number), "scene.ply")

    monkeypatch.setattr(ply, "write_gaussians", refuse)
    called = run_tiny(warm.scene, warm.store, out=tmp_path / "new/out")
    told = f"the output {tmp_path / 'new/out'} cannot be written: {os.strerror(number)}; what was computed is kept"
    assert called.code == 1 and called.out == "" and not list((tmp_path / "new").iterdir())
    assert told in called.err and called.err.count("ss-flow:") == 1


def test_photos_whose_names_look_like_markup_are_told_as_they_are(room, tmp_path):
    scene = shutil.copytree(room, tmp_path / "[bold]room")
    called = ss_flow("run", scene, "--cache", tmp_path / "store", "--out", tmp_path / "[red]out", "--until", "cameras")
    assert called.code == 0
    told = ss_flow("status", "--cache", tmp_path / "store").out
    assert str(scene) in told
    refused = ss_flow("run", tmp_path / "[bold]nowhere", "--cache", tmp_path / "store")
    assert "[bold]nowhere does not exist" in refused.err
