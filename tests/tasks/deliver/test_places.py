"""What a command may replace: an earlier one's files; what a user put beside them stays."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.deliver.places import RESULT, Written, check_outside, check_replaceable, others, replacing_own

STORE = "s3://bucket/store"
"""A store that lies in no folder."""


def result(folder: Path, *names: str, listed: bool = True) -> Path:
    """An earlier result of these files."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("x")
    folder.mkdir(exist_ok=True)
    (folder / "run.json").write_text(json.dumps({"files": dict.fromkeys(names, 1)} if listed else {}))
    return folder


def put(file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("mine")
    return file


@pytest.mark.parametrize("listed", [True, False])
def test_an_earlier_result_and_what_file_managers_left_in_it_are_nobodys(listed, tmp_path):
    own = ("scene.ply", "masks/0001.png", "masks_split/0001.png", "instances/0001.ply", "undistorted/sparse/0/x.bin")
    folder = result(tmp_path / "out", *own, listed=listed)
    for litter in (".DS_Store", "masks/Thumbs.db", "desktop.ini", "._scene.ply", f".run.json.{'0a' * 16}"):
        put(folder / litter)
    check_replaceable(folder, RESULT, STORE)
    assert others(folder, RESULT) == []


@pytest.mark.parametrize(
    "name",
    [
        "notes.txt",
        "photos/0001.jpg",
        "masks/mine.png",
        "descriptors.npz",
        "transforms.json",
        ".hidden",
        "other/run.json",
    ],
)
def test_what_no_run_wrote_is_there_after_the_result_was_replaced(name, tmp_path):
    folder = result(tmp_path / "out", "scene.ply", "masks/0001.png")
    put(folder / name)
    check_replaceable(folder, RESULT, STORE)
    with replacing_own(folder, RESULT) as filling:
        result(filling, "scene.ply")
    assert (folder / name).read_text() == "mine"
    assert not (folder / "masks/0001.png").exists()


@pytest.mark.parametrize("linked", [True, False])
def test_links_that_a_user_made_in_a_result_stay_links(linked, tmp_path, monkeypatch):
    folder = result(tmp_path / "out", "scene.ply")
    for name, what in (("folder", tmp_path), ("nothing", tmp_path / "nothing")):
        (folder / name).symlink_to(what)
    for name in ("notes.txt", "photos/0001.jpg"):
        put(folder / name)
    if not linked:
        monkeypatch.setattr(os, "link", lambda *_, **__: os.readlink(tmp_path))  # fails as on a disk that has no links
    with replacing_own(folder, RESULT) as filling:
        result(filling, "scene.ply")
    assert {name: os.readlink(folder / name) for name in ("folder", "nothing")} == {
        "folder": str(tmp_path),
        "nothing": str(tmp_path / "nothing"),
    }
    assert (folder / "notes.txt").read_text() == (folder / "photos/0001.jpg").read_text() == "mine"


def test_names_that_another_disk_spells_otherwise_are_the_same(tmp_path):
    folder = result(tmp_path / "out", "masks/K\u00fcche.png")
    (folder / "masks/K\u00fcche.png").rename(folder / "masks/Ku\u0308che.png")
    assert others(folder, RESULT) == []


@pytest.mark.parametrize(
    ("files", "names"),
    [(["00000.png"], ["00000.png", "transforms.json"]), ([{"file": "deep/0001.obj"}], ["deep/0001.obj"])],
)
def test_any_form_in_which_a_mark_lists_files_is_understood(files, names, tmp_path):
    kind = Written("mark.json", "earlier pictures", frozenset({"transforms.json"}))
    for name in names:
        put(tmp_path / "out" / name)
    (tmp_path / "out/mark.json").write_text(json.dumps({"files": files}))
    assert others(tmp_path / "out", kind) == []
    put(tmp_path / "out/00001.png")
    assert others(tmp_path / "out", kind) == ["00001.png"]


def test_a_file_that_a_new_one_would_replace_leaves_all_as_it_was(tmp_path):
    folder = result(tmp_path / "out", "scene.ply")
    put(folder / "masks/0002.png")
    told = r"out holds masks/0002.png, which no command wrote"
    with pytest.raises(InputError, match=told), replacing_own(folder, RESULT) as filling:
        result(filling, "scene.ply", "masks/0002.png")
    assert (folder / "masks/0002.png").read_text() == "mine" and (folder / "scene.ply").is_file()
    assert os.listdir(tmp_path) == ["out"]


def test_what_a_user_puts_there_while_a_run_goes_on_stays_too(tmp_path):
    folder = result(tmp_path / "out", "scene.ply")
    with replacing_own(folder, RESULT) as filling:
        (filling / "scene.ply").write_text("new")
        put(folder / "notes.txt")
    assert (folder / "notes.txt").read_text() == "mine" and (folder / "scene.ply").read_text() == "new"


@pytest.mark.parametrize("read", ["", "masks", "masks/0001.png", "../link"])
def test_what_is_read_is_not_replaced_though_a_run_wrote_it(read, tmp_path):
    folder = result(tmp_path / "out", "masks/0001.png")
    (tmp_path / "link").symlink_to(folder / "masks")
    with pytest.raises(InputError, match=r"out holds .*, which is read here"):
        check_replaceable(folder, RESULT, STORE, [tmp_path / "elsewhere", folder / read])
    check_replaceable(folder, RESULT, STORE, [tmp_path, tmp_path / "out2/masks"])


@pytest.mark.parametrize("there", [True, False])
def test_a_folder_that_is_the_store_or_lies_in_it_or_holds_it_is_refused(there, tmp_path):
    store = tmp_path / "a/store"
    if there:
        store.mkdir(parents=True)
    for place in (store, store / "objects/out", tmp_path / "a/../a/store"):
        with pytest.raises(InputError, match="lies in the store"):
            check_outside(place, store)
    if not there:
        with pytest.raises(InputError, match=r"a holds the store .*store, which would be lost"):
            check_replaceable(tmp_path / "a", RESULT, str(store))
    check_replaceable(tmp_path / "a/storehouse", RESULT, store)


def test_of_several_runs_that_end_at_once_none_fails_and_what_a_user_put_there_stays(tmp_path, monkeypatch):
    folder, rename, failed = result(tmp_path / "out", "scene.ply"), Path.rename, []
    put(folder / "notes.txt")

    def deliver():
        try:
            with replacing_own(folder, RESULT) as filling:
                result(filling, "scene.ply")
        except OSError as error:
            failed.append(error)

    beside = threading.Thread(target=deliver)

    def renamed(path, target):
        rename(path, target)
        if path == folder and beside.ident is None:
            beside.start()
            beside.join(0.2)  # it waits; else it would have ended long before

    monkeypatch.setattr(Path, "rename", renamed)
    deliver()
    beside.join()
    assert failed == [] and os.listdir(tmp_path) == ["out"] and (folder / "notes.txt").read_text() == "mine"
