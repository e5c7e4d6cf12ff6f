"""`ss-flow batch`: several small rooms, some of which fail."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from pathlib import Path

import pytest
from rich.console import Console
from tiny_runs import SHORT, Called, bytes_of, run_tiny, ss_flow, write_room

from ss_flow.cache.store import Store
from ss_flow.events import Reporter
from ss_flow.flows import deliver as deliver_module
from ss_flow.flows.cli import batch as batch_module
from ss_flow.flows.cli.batch import folder_names
from ss_flow.flows.cli.prepare import Prefixed
from ss_flow.flows.generated import RoomParams
from ss_flow.tasks.splat import reconstruct as reconstruct_module
from ss_flow.terminal import Lines

DEN = RoomParams(objects=1, views=4, width=64, height=48, held_out=0)


@pytest.fixture(scope="module")
def den(tmp_path_factory) -> Path:
    """A second, smaller capture; not to be changed."""
    return write_room(tmp_path_factory.mktemp("capture") / "den", params=DEN)


def batch_tiny(store: Path, out: Path, *arguments: str | Path) -> Called:
    """`ss-flow batch --json` with short trainings."""
    options = ["--out", out, "--cache", store, "--preset", "fast", "--json"]
    return ss_flow("batch", *arguments, *options, *SHORT)


def by_name(called: Called) -> dict[str, dict]:
    return {Path(row["scene"]).name: row for row in called.document()}


def refused(called: Called, says: str) -> None:
    assert called.code == 2, called
    assert called.out == "" and called.err.count("\n") == 1 and says in called.err, called.err


def test_a_batch_gives_the_bytes_of_single_runs_and_a_bad_scene_fails_alone(tiny, den, tmp_path):
    broken = shutil.copytree(den, tmp_path / "broken")
    (broken / "depth/0001.png").write_text("hello")
    alone = run_tiny(den, tmp_path / "store-of-one", out=tmp_path / "alone")
    out, store = tmp_path / "batch", tmp_path / "store"
    called = batch_tiny(store, out, tiny.scene, broken, tmp_path / "nowhere", den)
    assert called.code == 3
    rows = called.document()
    assert [Path(row["scene"]).name for row in rows] == ["room", "broken", "nowhere", "den"]
    assert [row["status"] for row in rows] == ["ok", "failed", "failed", "ok"]
    assert json.loads((out / "batch.json").read_text()) == rows
    assert sorted(path.name for path in out.iterdir()) == ["batch.json", "den", "room"]
    for name, single in (("room", tiny.out), ("den", tmp_path / "alone")):
        ours, theirs = bytes_of(out / name), bytes_of(single)
        assert set(ours) == set(theirs)
        assert {file for file in ours if ours[file] != theirs[file]} <= {"run.json", "report.html"}
    room, _, nowhere, other = rows
    assert room["out"] == str(out / "room") and room["error"] is None
    for row, single in ((room, tiny.called), (other, alone)):
        assert row["hits"] + row["misses"] == len(single.document()["nodes"])
    assert room["metrics"]["split.miou"] == tiny.called.document()["metrics"]["split"]["miou"]
    assert "broken/depth/0001.png" in rows[1]["error"] and "does not exist" in nowhere["error"]
    # Each scene has a run of its own, ...
    assert ss_flow("status", tiny.scene, "--cache", store).out.startswith(f"{tiny.scene}: done, started")
    assert (
        ss_flow("why", "dense", den, "--cache", store).out
        == "split.dense: computed for the first time for this scene\n"
    )
    # ... and once the damage is mended, only that one is run.
    shutil.copy(den / "depth/0001.png", broken / "depth/0001.png")
    runs = len(list((store / "roots/runs").iterdir()))
    mended = batch_tiny(store, out, tiny.scene, broken, tmp_path / "nowhere", den, "--retry-failed")
    assert mended.code == 3
    assert [row["status"] for row in mended.document()] == ["ok", "ok", "failed", "ok"]
    assert len(list((store / "roots/runs").iterdir())) == runs + 1
    assert mended.document()[0] == room
    assert bytes_of(out / "broken")["scene.ply"] == bytes_of(out / "den")["scene.ply"]


def test_scenes_that_share_steps_compute_them_once(den, tmp_path):
    copy = shutil.copytree(den, tmp_path / "copy")
    called = batch_tiny(tmp_path / "store", tmp_path / "batch", den, copy, "--until", "dense")
    assert called.code == 0
    rows = called.document()
    steps = sum(row["hits"] + row["misses"] for row in rows)
    assert sum(row["misses"] for row in rows) == len(list(Store(tmp_path / "store").actions())) == steps / 2
    assert [row["out"] for row in rows] == [None, None]
    assert list((tmp_path / "batch").iterdir()) == [tmp_path / "batch/batch.json"]


def test_scenes_are_named_by_path_pattern_or_list_and_each_runs_once(den, tmp_path, monkeypatch):
    for name in ("a", "b", "c"):
        shutil.copytree(den, tmp_path / "scans" / name)
    (tmp_path / "scans/list.txt").write_text("\ufeff# my scans\n\nc\n  b  \n")
    monkeypatch.chdir(tmp_path)
    dry = ["--dry-run", "--until", "ingest"]
    plan = batch_tiny(
        tmp_path / "store", tmp_path / "batch", "scans/[ab]/", "scans/a", "--list", "scans/list.txt", *dry
    )
    assert [row["scene"] for row in plan.document()] == [str(tmp_path / "scans" / name) for name in "abc"]
    assert plan.document()[0]["would_run"] == [{"label": "capture.ingest", "why": "never computed for this scene"}]
    words = ss_flow("batch", "scans/a", "nowhere", "--cache", tmp_path / "store", *dry)
    assert words.code == 0
    assert f"{tmp_path / 'scans/a'}: 0 results are there, at least 1 would be computed, first capture" in words.out
    assert f"cannot run {tmp_path / 'nowhere'}: " in words.out
    assert not (tmp_path / "batch").exists() and not (tmp_path / "ss-flow-out").exists()


def test_a_batch_that_has_nothing_to_run_is_refused_with_one_sentence(den, tmp_path):
    store, out, file = tmp_path / "store", tmp_path / "batch", tmp_path / "list.txt"
    file.write_text("# nothing\n")
    refused(batch_tiny(store, out), "there is no scene to run")
    refused(batch_tiny(store, out, "--list", file), "there is no scene to run")
    refused(batch_tiny(store, out, "--list", tmp_path / "none.txt"), "none.txt cannot be read")
    refused(batch_tiny(store, out, tmp_path / "*/color"), "nothing matches")
    refused(batch_tiny(store, out, tmp_path / "x"), "x does not exist")
    refused(batch_tiny(store, out, tmp_path / "x", tmp_path / "y"), "no scene can be opened; of the first: ")
    refused(batch_tiny(store, out, den, "--until", "densest"), "names no step")
    refused(batch_tiny(store, out, den, "--set", "tau_lable=1"), "did you mean")
    refused(batch_tiny(store, file, den), "is not a writable folder")
    refused(batch_tiny(store, den.parent, den), "something else than an earlier result")
    refused(batch_tiny(store, out, den, "--memory", "lots"), "'lots' is not a size")
    assert not out.exists()
    (out / "x").mkdir(parents=True)
    (out / "batch.json").write_text("{")
    refused(batch_tiny(store, out, den, "--retry-failed"), "batch.json is damaged")
    assert (out / "batch.json").read_text() == "{"


def test_a_scene_that_lost_an_instance_is_degraded(den, tmp_path, monkeypatch):
    real = reconstruct_module._from_points

    def begin(instance, params):
        if instance.instance_id == 1:
            raise ArithmeticError("it went wrong")
        return real(instance, params)

    monkeypatch.setattr(reconstruct_module, "_from_points", begin)
    called = batch_tiny(tmp_path / "store", tmp_path / "batch", den, "--executor", "threads")
    assert called.code == 3
    (row,) = called.document()
    assert (row["status"], row["out"]) == ("degraded", str(tmp_path / "batch/den"))
    assert row["error"] == "splat.reconstruct[1]: ArithmeticError: it went wrong"
    assert (tmp_path / "batch/den/run.json").is_file()


def test_a_scene_that_cannot_be_written_fails_and_the_others_are_delivered(warm, den, tmp_path, monkeypatch):
    real = deliver_module.write_all

    def write(folder, store, document, *more, **options):
        if "den" in document["scene"]:
            raise OSError("the disk is full")
        real(folder, store, document, *more, **options)

    monkeypatch.setattr(deliver_module, "write_all", write)
    called = batch_tiny(warm.store, tmp_path / "batch", warm.scene, den)
    assert called.code == 3
    rows = by_name(called)
    assert (rows["den"]["status"], rows["den"]["out"]) == ("failed", None)
    told = f"the output {tmp_path / 'batch/den'} cannot be written: the disk is full; what was computed is kept"
    assert rows["den"]["error"].startswith(told) and rows["den"]["misses"] > 0
    assert rows["room"]["status"] == "ok" and (tmp_path / "batch/room/scene.ply").is_file()
    assert not list((tmp_path / "batch").glob("*den*"))


def test_an_interrupted_batch_keeps_the_scenes_that_had_ended(warm, den, tmp_path, monkeypatch):
    class Interrupt(Reporter):
        def event(self, kind, **details):
            if kind == "finished" and "dense" in details["label"]:
                raise KeyboardInterrupt

    out = tmp_path / "batch"
    with monkeypatch.context() as patch:
        patch.setattr(batch_module, "display", lambda out: contextlib.nullcontext(Interrupt()))
        assert batch_tiny(warm.store, out, warm.scene, den).code == 130
    (row,) = json.loads((out / "batch.json").read_text())
    assert (row["scene"], row["status"]) == (str(warm.scene), "ok")
    assert (out / "room/scene.ply").is_file() and not (out / "den").exists()
    stamp = (out / "room/run.json").stat().st_mtime_ns
    again = batch_tiny(warm.store, out, warm.scene, den, "--retry-failed")
    assert again.code == 0
    assert by_name(again)["den"]["hits"] > 0
    assert (out / "room/run.json").stat().st_mtime_ns == stamp
    whole = batch_tiny(warm.store, out, warm.scene, den, "--retry-failed")  # nothing is left to do
    assert (whole.code, whole.document()) == (0, again.document())


@pytest.mark.parametrize("before", [["--until", "dense"], ["--set", "masks.share=0"], []])
def test_a_scene_that_ended_otherwise_than_is_asked_now_or_whose_results_are_gone_is_run(warm, tmp_path, before):
    out = tmp_path / "batch"
    assert batch_tiny(warm.store, out, warm.scene, *before).code == 0
    same = batch_tiny(warm.store, out, warm.scene, *before, "--retry-failed")
    assert "1 of 1 scenes have ended already" in same.err
    if not before:
        shutil.rmtree(out / "room")
    again = batch_tiny(warm.store, out, warm.scene, "--retry-failed")
    assert again.code == 0 and "have ended already" not in again.err
    assert json.loads((out / "room/run.json").read_text())["params"]["splat.masks.share"] > 0


def test_a_scene_that_is_run_alone_leaves_the_rows_of_the_others(warm, den, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = batch_tiny(warm.store, Path("batch"), warm.scene, den).document()
    assert [row["out"] for row in first] == [str(tmp_path / "batch" / name) for name in ("room", "den")]
    monkeypatch.chdir(tmp_path / "batch")
    alone = batch_tiny(warm.store, Path(), den).document()
    assert [row["scene"] for row in alone] == [str(den)]
    record = tmp_path / "batch/batch.json"
    assert json.loads(record.read_text()) == [first[0], *alone]
    assert batch_tiny(warm.store, Path(), warm.scene, den, "--retry-failed").document() == [first[0], *alone]
    shutil.rmtree(tmp_path / "batch/room")
    assert batch_tiny(warm.store, Path(), den).document() == json.loads(record.read_text())


def test_rows_of_scenes_that_have_no_folder_here_are_left_out_of_a_new_record(warm, tmp_path):
    out = tmp_path / "batch"
    out.mkdir()
    (out / "batch.json").write_text(json.dumps([{"scene": "/elsewhere", "status": "ok"}]))
    called = batch_tiny(warm.store, out, warm.scene)
    assert called.code == 0
    assert [row["scene"] for row in json.loads((out / "batch.json").read_text())] == [str(warm.scene)]


def test_words_for_people_tell_of_each_scene_and_of_all(warm, tmp_path):
    options = ["--out", tmp_path / "batch", "--cache", warm.store, "--preset", "fast"]
    told = ss_flow("batch", warm.scene, tmp_path / "nowhere", *options, *SHORT)
    assert told.code == 3
    lines = told.out.splitlines()
    assert any(line.startswith(f"failed {tmp_path / 'nowhere'}: ") for line in lines)
    assert f"ok {warm.scene}: see {tmp_path / 'batch/room'}" in lines
    assert [line.split()[:2] for line in lines[-2:]] == [["room", "ok"], ["nowhere", "failed"]]


def test_a_step_that_needs_more_memory_than_the_run_may_use_is_refused(warm, den, tmp_path):
    called = batch_tiny(warm.store, tmp_path / "batch", warm.scene, den, "--memory", "100MB")
    rows = by_name(called)
    assert (called.code, rows["room"]["status"]) == (3, "ok")  # what is there needs no memory
    assert rows["den"]["error"].endswith(" MB of memory, but the run may use 95 MB.")


@pytest.mark.parametrize(
    ("scenes", "names"),
    [
        (["/x/room", "/x/den"], ["room", "den"]),
        (["/x/room", "/y/room", "/y/den"], ["x-room", "y-room", "den"]),
        (["/a/1/images", "/b/1/images", "/b/2/images"], ["a-1-images", "b-1-images", "2-images"]),
        (["/x/room.mp4", "/x/room.sens"], ["room.mp4", "room.sens"]),
        (["/x/v.1", "/x/v.2"], ["v.1", "v.2"]),
        (["/x/room", "/room"], ["x-room", "room"]),
        (["/x-room", "/x/room", "/y/room"], ["x-room", "room-2", "y-room"]),
        (["/x/kitchen/transforms.json", "/x/office/transforms.json"], ["kitchen", "office"]),
        (["/x/room/transforms.json", "/y/room/transforms.json"], ["x-room", "y-room"]),
        (["/x/room/transforms.json", "/x/room"], ["room-2", "room-3"]),
    ],
)
def test_scenes_of_one_name_get_folders_of_their_own(scenes, names):
    found = folder_names(map(Path, scenes))
    assert len(set(found.values())) == len(scenes)
    assert [found[Path(scene)] for scene in scenes] == names


def test_a_step_of_a_later_scene_has_its_line_when_it_has_ended_and_not_when_all_has():
    stream = io.StringIO()
    with contextlib.closing(Lines(Console(file=stream, width=200))) as screen:
        later = Prefixed(screen, "den", leading=False)
        later.event("finished", label="half", step="half", of=1, seconds=1.0)
        later.pause()
        assert "done   den half" in stream.getvalue()
