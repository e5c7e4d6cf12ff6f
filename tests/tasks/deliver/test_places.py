"""What a command may replace: an earlier one's files, and nothing that a user put beside them."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.deliver.places import (
    BESIDE_FILE,
    RESULT,
    Written,
    check_outside,
    check_replaceable,
    note_beside,
    replacing_own,
)

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
def test_an_earlier_result_and_what_file_managers_left_in_it_may_be_replaced(listed, tmp_path):
    own = ("scene.ply", "masks/0001.png", "masks_split/0001.png", "instances/0001.ply", "undistorted/sparse/0/x.bin")
    folder = result(tmp_path / "out", *own, listed=listed)
    for litter in (".DS_Store", "masks/Thumbs.db", "desktop.ini", "._scene.ply", f".run.json.{'0a' * 16}"):
        put(folder / litter)
    check_replaceable(folder, RESULT, STORE)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("notes.txt", "notes.txt"),
        ("photos/0001.jpg", "photos/"),
        ("masks/mine.png", "masks/mine.png"),
        ("descriptors.npz", "descriptors.npz"),
        ("transforms.json", "transforms.json"),
        (".hidden", ".hidden"),
    ],
)
def test_a_result_with_what_no_run_wrote_is_refused_and_named(name, told, tmp_path):
    folder = result(tmp_path / "out", "scene.ply", "masks/0001.png")
    put(folder / name)
    with pytest.raises(InputError, match=f"out holds {told}, which is no part of an earlier result; move it away, or"):
        check_replaceable(folder, RESULT, STORE)


@pytest.mark.parametrize("what", ["a folder", "nothing"])
def test_a_link_that_a_user_made_in_a_result_is_not_lost_either(what, tmp_path):
    folder = result(tmp_path / "out", "scene.ply")
    (tmp_path / "a folder").mkdir()
    (folder / "link").symlink_to(tmp_path / what)
    with pytest.raises(InputError, match=r"out holds link,"):
        check_replaceable(folder, RESULT, STORE)


def test_names_that_another_disk_spells_otherwise_are_the_same(tmp_path):
    folder = result(tmp_path / "out", "masks/K\u00fcche.png")
    (folder / "masks/K\u00fcche.png").rename(folder / "masks/Ku\u0308che.png")
    check_replaceable(folder, RESULT, STORE)


def test_a_result_in_a_result_is_no_part_of_it(tmp_path):
    folder = result(tmp_path / "out", "scene.ply")
    result(folder / "other", "scene.ply")
    with pytest.raises(InputError, match=r"out holds other/,"):
        check_replaceable(folder, RESULT, STORE)


@pytest.mark.parametrize(
    ("files", "names"),
    [(["00000.png"], ["00000.png", "transforms.json"]), ([{"file": "deep/0001.obj"}], ["deep/0001.obj"])],
)
def test_any_form_in_which_a_mark_lists_files_is_understood(files, names, tmp_path):
    kind = Written("mark.json", "earlier pictures", frozenset({"transforms.json"}))
    for name in names:
        put(tmp_path / "out" / name)
    (tmp_path / "out/mark.json").write_text(json.dumps({"files": files}))
    check_replaceable(tmp_path / "out", kind, STORE)
    put(tmp_path / "out/00001.png")
    with pytest.raises(InputError, match=r"out holds 00001.png, which is no part of earlier pictures"):
        check_replaceable(tmp_path / "out", kind, STORE)


def test_what_commands_wrote_into_a_result_may_be_replaced_unless_it_was_changed(tmp_path):
    folder = result(tmp_path / "out", "scene.ply")
    for name in ("page.html", "objects/0001.spz", "objects/export.json"):
        put(folder / name)
    note_beside(folder / "page.html")
    note_beside(folder / "objects")
    check_replaceable(folder, RESULT, STORE)
    with (folder / "page.html").open("a") as page:
        page.write("and my notes")
    with pytest.raises(InputError, match=r"out holds page.html,"):
        check_replaceable(folder, RESULT, STORE)


def test_what_is_written_outside_of_results_is_not_noted(tmp_path):
    note_beside(put(tmp_path / "page.html"))
    assert os.listdir(tmp_path) == ["page.html"]


def test_a_note_that_cannot_be_read_makes_what_it_told_of_the_users(tmp_path):
    folder = result(tmp_path / "out", "scene.ply")
    note_beside(put(folder / "page.html"))
    (folder / BESIDE_FILE).write_text("{")
    with pytest.raises(InputError, match=r"out holds page.html,"):
        check_replaceable(folder, RESULT, STORE)


def test_what_a_user_puts_there_while_a_run_goes_on_stays_too(tmp_path):
    folder = result(tmp_path / "out", "scene.ply")
    with pytest.raises(InputError, match=r"out holds notes.txt,"), replacing_own(folder, RESULT) as filling:
        (filling / "scene.ply").write_text("new")
        put(folder / "notes.txt")
    assert (folder / "notes.txt").read_text() == "mine" and (folder / "scene.ply").read_text() == "x"


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
