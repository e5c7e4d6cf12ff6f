"""Nothing is computed twice, and everything that a change touches is computed again."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import SHORT, bytes_of, run_tiny, ss_flow, start_tiny, write_room

from ss_flow import closure
from ss_flow.cache import file_digests
from ss_flow.cache.files import stamp
from ss_flow.flows.generated import RoomParams
from ss_flow.flows.results import read_run

BEFORE_PROPAGATE = {
    "capture.ingest",
    "capture.cameras",
    "capture.sensor_depth",
    "capture.registration",
    "capture.ready_masks",
    "capture.ground_truth",
    "split.dense",
    "split.visibility",
}
HEAVY = ("torch", "cv2", "open3d", "onnxruntime", "onnx", "scipy", "pycolmap", "zarr", "matplotlib", "networkx")


def test_a_second_run_computes_nothing_and_leaves_every_file_as_it_is(warm):
    before = bytes_of(warm.out)
    again = run_tiny(warm.scene, warm.store, out=warm.out)
    assert again.code == 0
    assert again.computed() == {}
    assert again.results() == warm.called.results()
    assert again.document() == read_run(warm.out)
    after = bytes_of(warm.out)
    assert {name for name in before | after if before.get(name) != after.get(name)} == {"run.json"}


def test_a_run_of_hits_loads_no_heavy_library(warm):
    code = (
        "import sys; from ss_flow.flows.cli.main import main; code = main(sys.argv[1:]);"
        f"print(code, [m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
    )
    options = ["--out", str(warm.out), "--cache", str(warm.store), "--preset", "fast", "--json", *SHORT]
    done = subprocess.run(
        [sys.executable, "-c", code, "run", str(warm.scene), *options], capture_output=True, text=True
    )
    assert done.stderr.strip().splitlines()[-1] == "0 []"


def test_another_granularity_computes_the_cut_and_nothing_before_it(warm):
    again = run_tiny(warm.scene, warm.store, "--set", "split.granularity=0.9")
    # Ready-made masks hold no wholes: the cut comes to the same, and nothing after it is computed either.
    assert again.code == 0 and again.computed() == {"split.cut": 1}


def test_an_output_folder_that_was_deleted_is_written_again_from_the_store(warm):
    before = bytes_of(warm.out)
    shutil.rmtree(warm.out)
    again = run_tiny(warm.scene, warm.store, out=warm.out)
    assert again.computed() == {}
    after = bytes_of(warm.out)
    assert set(after) == set(before)
    assert {n for n in before if before[n] != after[n]} <= {"run.json", "report.html"}


@pytest.mark.parametrize("name", ["instances.json", "report.html", "run.json", "scene.ply", "masks/0000.png"])
def test_an_output_folder_with_a_file_cut_off_or_gone_is_written_again(warm, name):
    before = bytes_of(warm.out)
    if name.endswith((".ply", ".png")):
        (warm.out / name).unlink()
    else:
        (warm.out / name).write_bytes(before[name][: len(before[name]) // 2])
    assert run_tiny(warm.scene, warm.store, out=warm.out).computed() == {}
    after = bytes_of(warm.out)
    assert set(after) == set(before) and after["report.html"].rstrip().endswith(b"</html>")
    assert {n for n in before if before[n] != after[n]} <= {"run.json", "report.html"}


def test_a_changed_threshold_of_propagation_computes_it_and_nothing_before_it(warm):
    again = run_tiny(warm.scene, warm.store, "--set", "split.tau_label=0.95", out=warm.out)
    assert again.computed()["split.propagate"] == 1
    assert not BEFORE_PROPAGATE & set(again.computed())
    assert not [step for step in again.computed() if step.startswith("capture.")]


@pytest.mark.parametrize(
    ("change", "steps"),
    [
        # No two objects of this room collide, so that no pair is merged.
        ("merge.iterations_per_view=3", set()),
        ("merge.max_iterations=7", set()),
        ("merge.objective.alpha_weight=0.25", set()),
        ("merge.collision_margin=0.1", set()),
        ("merge.crop.margin_px=8", set()),
        ("merge.global_mask_weight=0.5", {"splat.global_pass"}),
        ("propagate.in_turn.passes=2", set()),  # the votes are counted at once
        ("propagate.at_once.rate=0.5", {"split.propagate"}),
        ("registration.tau_clear=0.3", set()),  # it would not warn
        ("reconstruct.retrain_share=0.3", {"splat.retrain"}),
        ("reconstruct.warm_start=false", {"splat.retrain"}),
        ("refine.margin=0.5", set()),  # there is no segmenter that would be asked
        ("refine.min_support=0.5", {"splat.refine"}),
        ("describe.margin_px=4", set()),  # colour words see masks
        ("observe.clusters.min_samples=5", set()),  # all points are kept
        ("plan.voxel=5", set()),  # boxes are compared
    ],
)
def test_a_parameter_that_no_step_of_a_run_reads_computes_nothing(warm, change, steps):
    told = run_tiny(warm.scene, warm.store, "--dry-run", "--set", change)
    labels = {entry["label"] for entry in told.document()["would_run"]}
    assert told.code == 0 and {label.partition("[")[0] for label in labels} == steps


def test_a_change_that_gives_an_equal_result_stops_there(warm):
    again = run_tiny(warm.scene, warm.store, "--set", "propagate.at_once.min_points=6", out=warm.out)
    assert again.computed() == {"split.propagate": 1}
    assert again.results() == warm.called.results()


def test_a_tolerance_that_only_split_reads_computes_nothing_of_splat_where_views_see_the_same(warm):
    again = run_tiny(warm.scene, warm.store, "--set", "split.visibility.deviations=99.99", out=warm.out)
    assert again.computed() == {"split.visibility": 5}


def test_why_names_the_parameter_and_the_chain_from_it(warm):
    again = run_tiny(warm.scene, warm.store, "--set", "visibility.tau_depth=0.05", out=warm.out)
    assert again.computed()["split.visibility"] == 5
    told = ss_flow("why", "propagate", "--cache", warm.store).out
    assert told.startswith("split.propagate: input visibility changed (5 of 5 items)")
    assert "split.visibility: parameter tau_depth 0.02 -> 0.05" in told
    for step in ("reconstruct[1]", "global_pass"):
        told = ss_flow("why", step, "--cache", warm.store).out
        assert told.startswith(f"splat.{step}: parameter visibility.tau_depth 0.02 -> 0.05")
    reused = ss_flow("why", "dense", "--cache", warm.store).out
    assert reused.strip() == "split.dense: reused; nothing that it depends on changed"


def test_the_search_threshold_changes_nothing_in_a_run_and_only_the_answer_of_a_search(warm):
    again = run_tiny(warm.scene, warm.store, "--set", "semantics.tau_corr=0.5", out=warm.out)
    assert again.computed() == {}
    assert read_run(warm.out)["params"]["semantics.query.tau_corr"] == 0.5
    report = (warm.out / "report.html").read_text(encoding="utf-8")
    assert re.search(r"semantics\.query\.tau_corr\D*0\.5\D", report)

    def ask(*more):
        assert ss_flow("query", warm.out, "red", *more, "--json").code == 0
        return len(list((warm.store / "actions").rglob("*.json")))

    actions = ask()
    assert ask() == actions
    assert ask("--tau-corr", "0.637") == actions + 1  # the answer; what it is made of, the similarities, stays


def test_what_the_encoder_is_shown_changes_the_descriptors_and_nothing_before_them(warm):
    again = run_tiny(warm.scene, warm.store, "--set", "semantics.masks=rendered", out=warm.out)
    instances = again.computed()["splat.rendered"]
    assert instances > 1
    assert set(again.computed()) <= {"splat.rendered", "semantics.describe", "semantics.name"}
    assert 0 < again.computed()["semantics.describe"] < instances  # the background keeps its masks


def test_a_search_reads_the_prompt_of_the_run(warm):
    assert ss_flow("query", warm.out, "mug").code == 2  # names no colour
    run_tiny(warm.scene, warm.store, "--set", "query.prompt=a red {text}", out=warm.out)
    assert ss_flow("query", warm.out, "mug").code == 0


def test_a_prompt_without_a_place_for_the_text_is_refused_before_the_run(warm):
    refused = ss_flow("run", warm.scene, "--cache", warm.store, "--set", "query.prompt=an image", "--dry-run")
    assert refused.code == 2 and "'an image' has no {text} in it" in refused.err


def test_a_changed_photo_is_segmented_again_and_no_other(tmp_path):
    scene, store = write_room(tmp_path / "room", masks=None), tmp_path / "store"
    first = run_tiny(scene, store, "--until", "segment")
    assert first.computed()["split.segment_rgbd"] == 5
    photo = scene / "color/0002.jpg"
    repainted(photo)
    again = run_tiny(scene, store, "--until", "segment")
    assert again.code == 0, again.err
    segmented = [n for n in again.document()["nodes"] if n["step"] == "split.segment_rgbd"]
    assert [n["item"] for n in segmented if not n["hit"]] == ["0002"]
    told = ss_flow("why", "segment_rgbd", "--cache", store).out
    assert told.startswith("split.segment_rgbd[0002]: input frame changed")
    assert "capture.ingest: parameter photos.2" in told
    for file in scene.rglob("0004.*"):
        file.unlink()
    assert "split.segment_rgbd" not in run_tiny(scene, store, "--until", "segment").computed()


def repainted(photo: Path) -> None:
    import cv2

    image = cv2.imread(str(photo))
    image[:20, :20] = 255 - image[:20, :20]
    photo.write_bytes(cv2.imencode(".jpg", image)[1].tobytes())


def test_a_photo_that_was_only_touched_or_moved_computes_nothing(warm, tmp_path):
    scene = shutil.copytree(warm.scene, tmp_path / "elsewhere")
    for photo in (scene / "color").iterdir():
        os.utime(photo, (1, 1))
    assert run_tiny(scene, warm.store, out=tmp_path / "b").computed() == {}


@pytest.fixture
def edited(monkeypatch):
    """Have the closure read a module with an edit, as if it had been saved between two runs."""
    read = Path.read_bytes

    def edit(module: str, old: str, new: str) -> None:
        def read_edited(path: Path) -> bytes:
            content = read(path)
            if not path.as_posix().endswith(module):
                return content
            assert old.encode() in content, f"{module} no longer holds {old!r}"
            return content.replace(old.encode(), new.encode())

        monkeypatch.setattr(Path, "read_bytes", read_edited)
        closure.forget()

    yield edit
    monkeypatch.undo()
    closure.forget()


def test_an_edited_comment_or_docstring_of_a_task_computes_nothing(warm, edited):
    edited("tasks/split/propagate.py", '"""How masks of single views', '"""In other words: how masks')
    assert run_tiny(warm.scene, warm.store, out=warm.out).computed() == {}
    edited("tasks/split/propagate.py", "\nfrom dataclasses", "\n# A remark.\nfrom dataclasses")
    assert run_tiny(warm.scene, warm.store, out=warm.out).computed() == {}


def test_an_edited_helper_computes_its_task_again_and_stops_where_the_result_is_the_same(warm, edited):
    edited("tasks/split/votes/smoothing.py", "_REACH = 3.0", "_REACH = 6.0 / 2")
    again = run_tiny(warm.scene, warm.store, out=warm.out)
    assert again.computed() == {"split.propagate": 1, "split.hierarchy": 1}
    told = ss_flow("why", "propagate", "--cache", warm.store).out
    assert told.strip() == "split.propagate: code of tasks.split.votes.smoothing._REACH changed"


def test_a_task_that_is_retuned_but_not_rewritten_keeps_its_results(warm, edited):
    edited("tasks/splat/reconstruct.py", "memory_mb=1500", "memory_mb=1600")
    assert run_tiny(warm.scene, warm.store, out=warm.out).computed() == {}


@pytest.mark.parametrize(
    "how",
    [("--jobs", "1"), ("--jobs", "2"), *(("--jobs", "2", "--executor", name) for name in ("threads", "processes"))],
    ids=str,
)
def test_the_results_do_not_depend_on_how_many_tasks_run_at_once_or_where(tiny, tmp_path, how):
    other = run_tiny(tiny.scene, tmp_path / "store", *how, out=tmp_path / "out")
    assert other.code == 0, other.err
    assert other.results() == tiny.called.results()


def test_a_killed_run_goes_on_from_what_it_had_finished(tiny, tmp_path):
    store, out = tmp_path / "store", tmp_path / "out"
    process = start_tiny(tiny.scene, store, "--jobs", "1", out=out)
    log = wait_for(lambda: next(store.glob("roots/runs/*/events.jsonl"), None))
    wait_for(lambda: '"started", "label": "splat.reconstruct' in log.read_text())
    process.send_signal(signal.SIGKILL)
    process.communicate()
    finished = set(re.findall(r'"event": "finished", "label": "([^"]+)"', log.read_text()))
    assert {"capture.ingest", "split.propagate"} <= finished
    assert not out.exists()
    state = ss_flow("status", "--cache", store).out
    assert "running, or killed" in state
    again = run_tiny(tiny.scene, store, out=out)
    assert again.code == 0, again.err
    made_again = {
        f"{n['step']}[{n['item']}]" if n["item"] else n["step"] for n in again.document()["nodes"] if not n["hit"]
    }
    assert made_again and not made_again & finished
    assert again.results() == tiny.called.results()


def wait_for(condition, seconds: float = 90.0):
    """What a condition gives, once it gives something."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.02)
    raise TimeoutError("the run did not get that far")


def test_a_scene_whose_object_is_gone_from_the_store_is_computed_again(warm):
    scene = warm.called.results()["scene"]
    shutil.rmtree(warm.store / "objects" / scene[:2] / scene)
    again = run_tiny(warm.scene, warm.store, out=warm.out)
    assert again.computed() == {"splat.global_pass": 1}
    assert again.results()["scene"] == scene


def test_a_change_that_size_and_time_hide_is_found_and_by_verify_where_nothing_tells_of_it(tmp_path, monkeypatch):
    scene, store = write_room(tmp_path / "room"), tmp_path / "store"
    depth = scene / "depth/0001.png"
    values = read_depth(depth)
    write_depth_uncompressed(depth, values)
    before = depth.stat()
    assert run_tiny(scene, store, "--until", "depth").code == 0
    first_steps = {"capture.sensor_depth": 1, "capture.registration": 1, "capture.depth_scale": 1}

    def change() -> None:
        values[0, 0] += 1
        write_depth_uncompressed(depth, values)
        os.utime(depth, ns=(before.st_atime_ns, before.st_mtime_ns))
        assert depth.stat().st_size == before.st_size

    change()
    assert run_tiny(scene, store, "--until", "depth").computed() == first_steps
    # As if the clock stood still: the time of the inode's change is the same, too.
    monkeypatch.setattr(file_digests, "stamp", lambda path: (*stamp(path)[:3], 0))
    assert run_tiny(scene, store, "--until", "depth").computed() == {}  # read once more, and remembered so
    change()
    assert run_tiny(scene, store, "--until", "depth").computed() == {}
    assert run_tiny(scene, store, "--until", "depth", "--verify").computed() == first_steps


def read_depth(file: Path) -> np.ndarray:
    import cv2

    return cv2.imread(str(file), cv2.IMREAD_UNCHANGED)


def write_depth_uncompressed(file: Path, values: np.ndarray) -> None:
    import cv2

    file.write_bytes(cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 0])[1].tobytes())


def test_a_photo_more_leaves_the_depth_of_views_that_are_no_neighbours_of_its_own(tmp_path):
    views = RoomParams(objects=2, views=12, width=48, height=36, held_out=0)
    scene = write_room(tmp_path / "room", masks=None, params=views)
    later = {file: file.read_bytes() for file in scene.rglob("0006.*")}
    for file in later:
        file.unlink()
    options = ["--cache", tmp_path / "store", "--until", "depth", "--json", "--set", "capture.depth=mvs"]
    options += ["--set", "capture.neighbors.count=2", "--set", "capture.sweep.planes=8"]
    assert ss_flow("run", scene, *options).code == 0
    for file, content in later.items():
        file.write_bytes(content)
    computed = ss_flow("run", scene, *options).computed()
    # Its own, and those of the views that have it among their two neighbours; then the neighbours of these.
    assert computed["capture.sweep"] <= 5
    assert computed["capture.sweep"] < computed["capture.stereo"] <= 9


def test_what_goes_on_flat_changes_what_split_does_and_not_the_depth_itself(tmp_path):
    scene = write_room(tmp_path / "room", params=RoomParams(objects=2, views=22, width=64, height=48, held_out=0))
    options = ["--cache", tmp_path / "store", "--until", "visibility", "--json", "--set", "capture.depth=mvs"]
    options += ["--set", "capture.sweep.planes=24"]
    assert ss_flow("run", scene, *options).code == 0
    split = {"split.dense": 1, "split.visibility": 22, "split.visible_by_color": 22}
    none = ss_flow("run", scene, *options, "--set", "capture.planes.flat=0")
    assert none.computed() == split
    other = ss_flow("run", scene, *options, "--set", "capture.planes.flat=0.5")
    assert other.computed() == {"capture.planes": 22, **split}
