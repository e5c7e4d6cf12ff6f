"""Care of the store: what goes and what stays, pins, room, damage."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from collections import Counter
from pathlib import Path

import pytest
import ss_flow_toy as toy
from aged_store import age_all
from tiny_runs import bytes_of, run_tiny, ss_flow

from ss_flow.cache.collect import collect
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows.cli.care import Wanted
from ss_flow.graph import stored
from ss_flow.runs import latest_runs
from ss_flow.sweep import grid, sweep
from ss_flow.tasks.words import size_in_words


def gc(store, *options):
    return ss_flow("cache", "gc", "--json", "--cache", store, *options)


def removed(called):
    """What a collection took, and how many of each."""
    assert called.code in (0, 3), called.err
    return {row["what"]: row["count"] for row in called.document()["removed"]}


def entries(store):
    """Keys of the actions, and digests of the objects."""
    opened = Store(store)
    return {e.name for e in opened.actions()}, {e.name for e in opened.objects()}


def named_by(store, keys):
    opened = Store(store)
    return {output for key in keys for output in opened.action(key, whole=False).outputs}


def keys_of(called):
    return {node["key"] for node in called.document()["nodes"]}


def again(tiny, *options):
    return run_tiny(tiny.scene, tiny.store, *options, out=tiny.out)


def test_what_runs_need_stays_and_a_run_after_a_collection_is_all_hits(warm):
    age_all(warm.store)
    before = bytes_of(warm.store)
    words = ss_flow("cache", "gc", "--cache", warm.store)
    assert (words.code, words.err) == (0, "")
    assert "total" in words.out and " results stay" in words.out
    assert removed(gc(warm.store)) == {}
    assert bytes_of(warm.store) == before
    assert again(warm).computed() == {}


def test_only_the_latest_runs_of_a_scene_are_kept_on_request(warm):
    latest = again(warm, "--set", "propagate.at_once.min_points=6")
    assert latest.computed() == {"split.propagate": 1}
    age_all(warm.store)
    assert removed(gc(warm.store, "--keep-runs", "2")) == {}
    told = gc(warm.store, "--keep-runs", "1", "--dry-run")
    assert len(list((warm.store / "roots/runs").iterdir())) == 2
    done = gc(warm.store, "--keep-runs", "1")
    assert removed(told) == removed(done) == {"split.propagate": 1, "records of runs": 1}
    assert told.document() | {"dry_run": False} == done.document()
    assert done.document()["scenes"] == [{"scene": str(warm.scene), "runs": 2, "runs_that_lose": 1}]
    keys, objects = entries(warm.store)
    assert keys == keys_of(latest) and objects == named_by(warm.store, keys)
    assert again(warm, "--set", "propagate.at_once.min_points=6").computed() == {}
    assert again(warm).computed() == {"split.propagate": 1}


def test_of_the_sweeps_of_a_scene_the_latest_are_kept_as_of_its_runs(tmp_path):
    store = Store(tmp_path / "store")
    run_flow(toy.flow, store, scene="one")
    for limits in ((1.0, 2.0), (3.0, 4.0)):
        sweep(toy.flow, grid({"limit": limits}), store, scene="one")
    age_all(store.root)
    assert removed(gc(store.root, "--keep-runs", "2", "--dry-run")) == {}
    assert removed(gc(store.root, "--keep-runs", "1"))["records of runs"] == 2
    assert sorted(run.scene for run in latest_runs(store.runs)) == ["one", "one [limit=3.0]", "one [limit=4.0]"]


def test_runs_that_came_to_no_result_or_stopped_early_drive_out_no_whole_one(tmp_path):
    store = Store(tmp_path / "store")
    whole = run_flow(toy.flow, store, scene="one")
    for limit in (1.0, 2.0):
        run_flow(lambda limit=limit: toy.flow(limit=limit), store, scene="one", until="squares")
        run_flow(lambda limit=limit: {"half": toy.half(toy.source(values=(-limit,))[0])}, store, scene="one")
    age_all(store.root)
    assert removed(gc(store.root, "--keep-runs", "1"))["records of runs"] == 3
    assert [run.is_whole() for run in latest_runs(store.runs)] == [False, True]
    assert set(entries(store.root)[1]) >= {*whole.all("squares"), whole.one("total")}


def test_nothing_young_goes_and_a_dry_run_changes_nothing(warm):
    before = bytes_of(warm.store)
    assert removed(gc(warm.store, "--keep-runs", "0", "--max-size", "0", "--older-than", "0s")) == {}
    assert bytes_of(warm.store) == before
    age_all(warm.store)
    told = gc(warm.store, "--keep-runs", "0", "--dry-run")
    assert bytes_of(warm.store) == before
    assert removed(told)["split.visibility"] == 5
    assert told.document()["left"] == {"count": 0, "bytes": 0}


def test_the_runs_that_lose_results_are_told_by_their_scenes(tmp_path):
    store = Store(tmp_path / "store")
    run_flow(toy.flow, store, scene="/one")
    sweep(toy.flow, grid({"limit": (1.0, 2.0)}), store, scene="/one")
    run_flow(lambda: {"half": toy.half(toy.source(values=(7.0,))[0])}, store, scene="/two")
    age_all(store.root)

    def told(*options):
        return ss_flow("cache", "gc", "--cache", store.root, "--max-size", "0", *options).out.splitlines()[2:]

    assert gc(store.root, "--dry-run").document()["scenes"] == []
    assert not [line for line in told("--dry-run", "--grace", "1d") if "lose" in line]
    scenes = "/two (1 of 1), /one (3 of 3)"
    assert told("--dry-run")[-1] == f"runs that would lose results: {scenes}"
    assert told()[-1] == f"runs that lost results: {scenes}"


def test_without_runs_and_pins_nothing_is_left(warm):
    age_all(warm.store)
    assert gc(warm.store, "--keep-runs", "0").code == 0
    assert entries(warm.store) == (set(), set())
    assert list((warm.store / "roots/runs").iterdir()) == list((warm.store / "parts").iterdir()) == []


def test_what_is_pinned_stays_whatever_is_asked(warm):
    nodes = warm.called.document()["nodes"]
    pinned = {node["key"] for node in nodes if node["step"] in ("split.propagate", "split.visibility")}
    for what in ("propagate", "visibility"):
        assert ss_flow("cache", "pin", what, "--cache", warm.store).code == 0
    age_all(warm.store)
    done = gc(warm.store, "--keep-runs", "0", "--max-size", "1kB", "--older-than", "1h")
    assert done.code == 3 and done.document()["over_bytes"] > 0
    keys, objects = entries(warm.store)
    assert keys == pinned and objects == named_by(warm.store, pinned)
    words = ss_flow("cache", "gc", "--max-size", "1kB", "--cache", warm.store)
    assert words.code == 3 and "more than --max-size 1kB: the rest is pinned" in words.out
    for what in ("propagate", "visibility"):
        assert ss_flow("cache", "unpin", what, "--cache", warm.store).code == 0
    assert gc(warm.store).code == 0
    assert entries(warm.store) == (set(), set())


def test_a_living_run_keeps_what_it_found_and_an_unknown_one_stops_the_collection(warm):
    (run,) = latest_runs(warm.store / "roots/runs")
    before = entries(warm.store)
    age_all(warm.store)
    claims = Store(warm.store).open_claims()
    claims.take(f"run-{run.folder.name}")
    assert removed(gc(warm.store, "--keep-runs", "0", "--max-size", "0", "--grace", "0s")) == {}
    assert entries(warm.store) == before
    claims.take("run-elsewhere")
    refused = gc(warm.store)
    assert refused.code == 2 and "the run elsewhere of another machine is alive" in refused.err
    claims.release_all()
    assert removed(gc(warm.store, "--keep-runs", "0"))["records of runs"] == 1


def test_a_living_run_keeps_what_it_has_taken_from_another(tmp_path):
    store = Store(tmp_path / "store")
    taken = run_flow(toy.flow, store, scene="one").values["total"]
    run_flow(lambda: {"half": toy.half(stored("total", taken))}, store, scene="two")
    (run,) = latest_runs(store.runs, "two")
    age_all(store.root)
    claims = store.open_claims()
    claims.take(f"run-{run.folder.name}")
    gc(store.root, "--keep-runs", "0", "--max-size", "0")
    assert entries(store.root) == ({node["key"] for node in run.nodes()}, {taken, run.results()["half"][0]})
    claims.release_all()


@pytest.mark.parametrize(
    "command", [("status",), ("cache", "ls"), ("cache", "du"), ("cache", "verify"), ("cache", "gc", "--dry-run")]
)
def test_a_store_that_can_only_be_read_can_be_looked_into(tmp_path, monkeypatch, command):
    store = Store(tmp_path / "store")
    run_flow(toy.flow, store, scene="toy")

    def refused(path, *_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    for name in ("touch", "unlink", "write_text", "rename", "replace"):
        monkeypatch.setattr(Path, name, refused)
    monkeypatch.setattr(os, "access", lambda path, mode, access=os.access: mode != os.W_OK and access(path, mode))
    called = ss_flow(*command, "--cache", store.root)
    assert (called.code, called.err) == (0, "")


def test_want_of_room_takes_what_was_used_least_recently(warm):
    nodes = warm.called.document()["nodes"]
    late = {node["key"] for node in nodes if node["step"] == "split.visibility"}
    age_all(warm.store, hours=3)
    store, used = Store(warm.store), time.time() - 2 * 3600
    for path in [store.action_path(key) for key in late] + [store.object_path(o) for o in named_by(warm.store, late)]:
        os.utime(path, (used, used))
    room = sum(store.size(output) for output in named_by(warm.store, late))
    room += sum(store.action_path(key).stat().st_size for key in late)
    done = gc(warm.store, "--max-size", str(room))
    assert done.code == 0 and done.document()["left"] == {"count": 5, "bytes": room}
    assert entries(warm.store) == (late, named_by(warm.store, late))
    assert removed(done)["capture.ingest"] == 1


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--max-size", "20 potatoes"], "--max-size: '20 potatoes' is not a size"),
        (["--older-than", "a while"], "--older-than: 'a while' is not a duration"),
        (["--grace", "-1h"], "--grace: '-1h' is not a duration"),
        (["--keep-runs", "-1"], "--keep-runs -1 is out of range"),
    ],
)
def test_a_bad_limit_is_told_in_a_sentence(options, sentence, tiny):
    called = ss_flow("cache", "gc", "--cache", tiny.store, *[f"{options[0]}={options[1]}"])
    assert called.code == 2 and sentence in called.err


def test_pins_are_named_by_step_by_digest_or_by_scene(warm):
    digest = warm.called.results()["dense"]
    for what in ("dense", "visibility[0003]", digest[:9], warm.scene):
        assert ss_flow("cache", "pin", what, "--cache", warm.store).code == 0
    pins = json.loads(ss_flow("cache", "pin", "--json", "--cache", warm.store).out)
    assert [p["what"] for p in pins] == ["dense", "visibility[0003]", digest, str(warm.scene)]
    assert pins[2]["keys"] == pins[0]["keys"] and len(pins[0]["keys"]) == len(pins[1]["keys"]) == 1
    assert set(pins[3]["keys"]) == keys_of(warm.called)
    assert pins[2]["objects"] == [digest]
    listed = ss_flow("cache", "pin", "--cache", warm.store).out
    assert "visibility[0003]" in listed and digest in listed
    assert ss_flow("cache", "unpin", digest[:9], "--cache", warm.store).code == 0
    assert ss_flow("cache", "unpin", warm.scene, "--cache", warm.store).code == 0
    assert digest not in ss_flow("cache", "du", "--cache", warm.store).out
    wrong = ss_flow("cache", "unpin", "dense", "--scene", warm.out, "--cache", warm.store)
    assert wrong.code == 2 and "pinned are: dense, visibility[0003]." in wrong.err
    assert ss_flow("cache", "unpin", "dense", "--scene", warm.scene, "--cache", warm.store).code == 0


def test_a_pinned_output_stays_usable_when_other_runs_of_its_capture_are_kept(warm):
    other = warm.out.with_name("other")
    run_tiny(warm.scene, warm.store, "--set", "masks.share=0", out=other)
    age_all(warm.store)
    assert ss_flow("cache", "pin", warm.out, "--cache", warm.store).code == 0
    (pinned,) = json.loads(ss_flow("cache", "pin", "--json", "--cache", warm.store).out)
    assert (pinned["what"], pinned["scene"]) == (str(warm.out), str(warm.scene))
    gone = removed(gc(warm.store, "--keep-runs", "0"))
    assert "records of runs" in gone and entries(warm.store)[0] == keys_of(warm.called)
    coco = ["--format", "coco", "--out", warm.out.with_name("coco.json")]
    assert [ss_flow("export", out, *coco).code for out in (warm.out, other)] == [0, 2]
    assert ss_flow("cache", "unpin", warm.out, "--cache", warm.store).code == 0


def test_a_pin_of_what_is_not_there_is_refused(warm):
    unknown = ss_flow("cache", "pin", "nonsense", "--cache", warm.store)
    assert unknown.code == 2 and "is neither a step of the latest runs, nor a digest, nor an output" in unknown.err
    for place in ("actions", "objects"):
        for folder in (warm.store / place).iterdir():
            folder.rename(warm.store / "tmp" / f"{place}{folder.name}")
    gone = ss_flow("cache", "pin", "propagate", "--cache", warm.store)
    assert gone.code == 2 and "no longer in the store" in gone.err


def test_room_by_step_and_by_scene_adds_up_to_what_the_files_take(warm):
    assert ss_flow("cache", "pin", "propagate", "--cache", warm.store).code == 0
    document = ss_flow("cache", "du", "--json", "--cache", warm.store).document()
    files = sum(len(content) for place in ("actions", "objects") for content in bytes_of(warm.store / place).values())
    assert document["total"] == {"count": len(entries(warm.store)[0]), "bytes": files}
    for usage in (document["by_step"], document["by_scene"]):
        rows = sum(row["bytes"] for row in usage["rows"].values())
        assert rows - usage["shared_bytes"] + usage["unreachable"]["bytes"] == files
    assert document["by_step"]["rows"]["split.visibility"]["count"] == 5
    assert list(document["by_scene"]["rows"]) == [str(warm.scene)]
    assert document["by_scene"]["unreachable"] == {"count": 0, "bytes": 0}
    assert [pin["what"] for pin in document["pins"]] == ["propagate"]
    words = ss_flow("cache", "du", "--by", "step", "--cache", warm.store).out
    assert "split.visibility" in words and size_in_words(files) in words
    assert f"{warm.scene} " not in words.split("pinned")[0]


def test_damage_is_taken_out_and_made_again(warm):
    whole = ss_flow("cache", "verify", "--cache", warm.store)
    assert whole.code == 0 and "all is whole" in whole.out
    scene = warm.called.results()["scene"]
    chunk = max((warm.store / "objects" / scene[:2] / scene).rglob("c*"), key=lambda path: path.stat().st_size)
    content = chunk.read_bytes()
    chunk.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    seen = ss_flow("cache", "verify", "--json", "--cache", warm.store)
    assert seen.code == 3
    (damage,) = seen.document()["damaged"]
    assert (damage["kind"], damage["name"], seen.document()["incomplete"]) == ("object", scene, 1)
    assert again(warm).computed() == {"splat.global_pass": 1}
    assert ss_flow("cache", "verify", "--cache", warm.store).code == 0


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_collectors_beside_a_running_flow_leave_its_results_right(tmp_path, executor):
    values = tuple(float(i) for i in range(40))

    def build():
        return toy.flow(values=values, limit=900.0)

    def run(store: Store):
        return run_flow(build, store, scene="toy", executor=executor, jobs=2)

    expected = run(Store(tmp_path / "other")).values
    root = tmp_path / "store"
    run_flow(lambda: toy.flow(values=values, limit=500.0), Store(root), scene="toy")
    age_all(root)
    ended, taken, faults = threading.Event(), Counter(), []

    def collect_again_and_again():
        store = Store(root)
        while not ended.is_set():
            try:
                done = collect(store, Wanted(store, 0, store.now()))
            except Exception as fault:
                faults.append(fault)
                raise
            taken.update({step: tally.count for step, tally in done.results.items()})

    several = [threading.Thread(target=collect_again_and_again) for _ in range(2)]
    for one in several:
        one.start()
    try:
        results = [run(Store(root)).values for _ in range(3)]
    finally:
        ended.set()
        for one in several:
            one.join()
    assert not faults
    assert results == [expected] * 3
    assert taken["ss_flow_toy.clip"] > 0
    assert latest_runs_are_whole(root)


def latest_runs_are_whole(root: Path) -> bool:
    store = Store(root)
    return all(store.action(node["key"]) is not None for node in next(latest_runs(root / "roots/runs")).nodes())
