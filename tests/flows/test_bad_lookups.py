"""Searches, exports and looks into a store that cannot be answered or written are refused in one sentence."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from refusals import assert_refused, file
from tiny_runs import ss_flow

QUERIES: dict[str, tuple[Callable[[Path], list[str]], str]] = {
    "a folder that is no result": (lambda out: [str(out.parent), "red"], "it has no run.json"),
    "a folder that is not there": (lambda out: [str(out / "nowhere"), "red"], "it has no run.json"),
    "a result that is a file": (lambda out: [str(out / "scene.ply"), "red"], "it has no run.json"),
    "a run.json that was cut": (lambda out: [spoilt(out / "run.json", "{"), "red"], "run.json is damaged"),
    "a run.json of something else": (lambda out: [spoilt(out / "run.json", "[]"), "red"], "run.json is damaged"),
    "an instances.json that was cut": (
        lambda out: [spoilt(out / "instances.json", "{"), "red"],
        "instances.json is damaged",
    ),
    "an instances.json whose instances lack their names": (
        lambda out: [spoilt(out / "instances.json", '{"instances": [{"id": 1}], "groups": []}'), "red"],
        "instances.json is damaged: an instance lacks what a run writes of it",
    ),
    "a text without a colour": (lambda out: [str(out), "teapot"], '"teapot" names no colour'),
    "an empty text": (lambda out: [str(out), ""], "The query is empty"),
    "a distance out of range": (lambda out: [str(out), "red", "--tau-corr", "5"], "must be above 0 and at most 2"),
    "a distance that is not finite": (lambda out: [str(out), "red", "--tau-corr", "nan"], "must be above 0"),
}


def spoilt(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path.parent)


@pytest.mark.parametrize("name", QUERIES)
def test_a_bad_search_is_refused_with_one_sentence(name, warm):
    make, expected = QUERIES[name]
    assert_refused(ss_flow("query", *make(warm.out), "--cache", warm.store), expected)


def test_a_search_after_its_store_went_away_says_so_and_makes_no_new_one(warm):
    document = json.loads((warm.out / "run.json").read_text())
    document["store"] = str(warm.store)
    (warm.out / "run.json").write_text(json.dumps(document))
    descriptor = document["results"]["describe"][0]
    shutil.rmtree(warm.store / "objects" / descriptor[:2] / descriptor)
    again = f"ss-flow run {warm.scene} --preset fast --set=.* --out {warm.out} --cache {warm.store}"
    assert_refused(ss_flow("query", warm.out, "red"), f"no longer holds describe of .*; run it again: `{again}`")
    shutil.rmtree(warm.store)
    told = f"the results of {warm.out} are in the store {warm.store}, which is not here; name a copy of it with --cache"
    assert_refused(ss_flow("query", warm.out, "red"), told)
    assert not warm.store.exists()


@pytest.mark.parametrize("command", [("query", "red"), ("export", "--format", "coco"), ("edit",), ("render",)])
def test_a_store_that_was_moved_is_found_where_the_environment_says(command, warm, monkeypatch):
    moved = warm.store.rename(warm.store.with_name("moved"))
    script = warm.out.parent / "script.json"
    script.write_text('{"operations": []}')
    more = {
        "edit": [script, "--out", warm.out.parent / "edited"],
        "export": ["--out", warm.out.parent / "coco.json"],
        "render": ["--frames", "1", "--what", "labels", "--out", warm.out.parent / "pictures"],
    }
    words = (command[0], warm.out, *command[1:], *more.get(command[0], []))
    assert_refused(ss_flow(*words), f"the results of {warm.out} are in the store {warm.store}, which is not here")
    monkeypatch.setenv("SS_FLOW_CACHE", str(moved))
    called = ss_flow(*words)
    assert called.code == 0, called.err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["why", "nope"], "has no step 'nope'; it has .*split.propagate"),
        (["cache", "show", "nope"], "is neither a step of the latest runs nor a digest"),
        (["cache", "show", "segment[0099]"], r"'segment\[0099\]' is neither"),
        (["cache", "show", "scene", "--view", "99", "--png", "x.png"], "--view 99 is out of range; .* views 0 to 4"),
        (["cache", "show", "scene", "--view", "-1", "--png", "x.png"], "--view -1 is out of range"),
        (["status", "elsewhere"], "knows no run of elsewhere"),
        (["graph", "elsewhere"], "knows no run of elsewhere"),
        (["cache", "ls", "elsewhere"], "knows no run of elsewhere"),
    ],
)
def test_looking_for_what_is_not_there_is_refused_with_one_sentence(arguments, expected, tiny):
    assert_refused(ss_flow(*arguments, "--cache", tiny.store), expected)


@pytest.mark.parametrize(
    "command", [["status"], ["why", "dense"], ["graph"], ["cache", "ls"], ["cache", "show", "dense"]]
)
def test_looking_into_a_store_that_is_not_there_makes_none(command, tmp_path):
    assert_refused(ss_flow(*command, "--cache", tmp_path / "store"), "there is no store")
    assert not (tmp_path / "store").exists()


def test_a_store_without_runs_says_how_to_make_one(tmp_path):
    from ss_flow.cache.store import Store

    Store(tmp_path / "store")
    assert_refused(ss_flow("status", "--cache", tmp_path / "store"), "knows no run; `ss-flow run SCENE` makes one")


def test_a_picture_that_cannot_be_written_is_refused_before_it_is_drawn(tiny, tmp_path):
    place = file(tmp_path / "f") / "x.png"
    assert_refused(ss_flow("cache", "show", "dense", "--png", place, "--cache", tiny.store), "x.png cannot be written")


@pytest.mark.parametrize(
    "command",
    [
        ["report", "OUT"],
        ["view", "OUT", "--html", "OUT/x.html"],
        ["view", "OUT", "--rerun", "OUT/x.rrd"],
        ["status", "--otlp", "OUT/x.json"],
        ["cache", "show", "scene", "--png", "OUT/x.png"],
        ["export", "OUT", "--format", "ply", "--out", "OUT/x.ply"],
    ],
)
def test_a_file_in_a_folder_that_may_not_be_written_is_refused(command, tiny, monkeypatch):
    monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != tiny.out)
    words = [word.replace("OUT", str(tiny.out)) for word in command]
    assert_refused(ss_flow(*words, "--cache", tiny.store), f"cannot be written: {tiny.out} is not a writable folder")


def test_masks_that_cannot_be_read_are_named(warm, tmp_path):
    mask = sorted((warm.out / "masks").iterdir())[2]
    file(mask)
    for command in (["query", warm.out, "white", "--out", tmp_path / "found"], ["diff", warm.out, warm.out]):
        more = ["--cache", warm.store] if command[0] == "query" else []
        assert_refused(ss_flow(*command, *more), f"{mask.name} cannot be read or is damaged")
    assert not (tmp_path / "found").exists()
