"""The output folder: whole or not at all, and never in the place of something else."""

from __future__ import annotations

import errno
import fcntl
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.files import hidden
from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Frame, LabelMap
from ss_flow.tasks.deliver.output import RUN_FILE, check_place, replacing, write_masks

EMPTY = np.zeros(0, np.uint8)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def fill(folder, name):
    with replacing(folder) as filling:
        (filling / name).touch()


def test_what_was_filled_appears_under_the_name_and_nothing_beside_it(tmp_path):
    with replacing(tmp_path / "deep/out") as filling:
        (filling / "a").write_text("1")
        assert not (tmp_path / "deep/out").exists()
    assert (tmp_path / "deep/out/a").read_text() == "1"
    assert names(tmp_path / "deep") == ["out"]


def test_the_new_content_replaces_the_old_as_a_whole(tmp_path):
    for name in ("a", "b"):
        with replacing(tmp_path / "out") as filling:
            (filling / name).write_text(name)
    assert names(tmp_path / "out") == ["b"]
    assert names(tmp_path) == ["out"]


def test_when_filling_fails_the_old_content_stays(tmp_path):
    with replacing(tmp_path / "out") as filling:
        (filling / "a").write_text("old")
    with pytest.raises(OSError, match="full"), replacing(tmp_path / "out") as filling:
        (filling / "a").write_text("half")
        raise OSError("disk full")
    assert (tmp_path / "out/a").read_text() == "old"
    assert names(tmp_path) == ["out"]


def test_a_store_that_fails_while_an_output_is_filled_is_told_as_such(tmp_path):
    with pytest.raises(StoreFailure, match=r"^the store fails$"), replacing(tmp_path / "out"):
        raise StoreFailure("the store fails")


def test_what_a_killed_run_left_is_taken_away_and_the_neighbours_are_not(tmp_path):
    own = [".out[1].0123abcd.partial", ".out[1].0123abcd.old.partial"]
    others = [".out[1].v2.0123abcd.partial", ".out1.0123abcd.partial", "out[1].partial"]
    for name in (*own, *others):
        (tmp_path / name).mkdir()
    with replacing(tmp_path / "out[1]"):
        pass
    assert names(tmp_path) == sorted([*others, "out[1]"])


def test_a_folder_may_have_the_longest_name_that_file_systems_take_and_takes_nothing_of_its_neighbour(tmp_path):
    folder, neighbour = tmp_path / ("o" * 255), tmp_path / ("o" * 254 + "x")
    left = tmp_path / f"{hidden(neighbour.name)}.0123abcd.old.partial"
    left.mkdir()
    for content in ("old", "new"):
        with replacing(folder) as filling:
            (filling / "a").write_text(content)
        assert (folder / "a").read_text() == content
        assert names(tmp_path) == sorted([folder.name, left.name])
    with pytest.raises(OSError, match="full"), replacing(neighbour):
        raise OSError("disk full")
    assert names(tmp_path) == sorted([folder.name, neighbour.name])


def killed_in_the_middle(folder, monkeypatch, error):
    """Replace a folder, and have this be raised between the two renames."""
    rename = Path.rename

    def interrupted(path, target):
        rename(path, target)
        if path == folder:
            raise error

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", interrupted)
        with replacing(folder) as filling:
            (filling / "b").touch()


def test_who_is_interrupted_between_the_two_renames_puts_the_old_content_back(tmp_path, monkeypatch):
    with replacing(tmp_path / "out") as filling:
        (filling / "a").touch()
    with pytest.raises(KeyboardInterrupt):
        killed_in_the_middle(tmp_path / "out", monkeypatch, KeyboardInterrupt)
    assert names(tmp_path) == ["out"] and names(tmp_path / "out") == ["a"]


def test_what_was_killed_between_the_two_renames_is_put_back_also_by_one_that_fails(tmp_path):
    for left in (".out.0123abcd.partial", ".out.0123abcd.old.partial"):
        (tmp_path / left).mkdir()
        (tmp_path / left / left).touch()
    with pytest.raises(OSError, match="full"), replacing(tmp_path / "out"):
        raise OSError("disk full")
    assert names(tmp_path) == ["out"] and names(tmp_path / "out") == [".out.0123abcd.old.partial"]


@pytest.mark.parametrize("locks", [True, False])
def test_what_another_one_is_filling_is_left_alone(locks, tmp_path, monkeypatch):
    def refuse(handle, how):
        raise OSError(errno.ENOLCK, "No locks available")

    if not locks:
        monkeypatch.setattr(fcntl, "flock", refuse)
    with replacing(tmp_path / "out") as filling:
        (filling / "a").touch()
        with replacing(tmp_path / "out") as another:
            (another / "b").touch()
        (filling / "c").touch()
    assert names(tmp_path) == ["out"] and names(tmp_path / "out") == ["a", "c"]


def test_what_another_one_has_moved_away_is_left_to_it(tmp_path):
    with replacing(tmp_path / "out") as filling:
        filling.with_suffix(".old.partial").mkdir()
        with replacing(tmp_path / "out"):
            pass
        assert filling.with_suffix(".old.partial").is_dir()


def test_who_begins_takes_nothing_of_one_that_begins_beside_it(tmp_path, monkeypatch):
    make, beside = Path.mkdir, threading.Thread(target=fill, args=(tmp_path / "out", "b"))

    def made(path, *arguments, **options):
        make(path, *arguments, **options)
        if path.name.endswith(".partial") and beside.ident is None:
            beside.start()
            beside.join(0.2)  # it waits; else it would have ended long before

    monkeypatch.setattr(Path, "mkdir", made)
    fill(tmp_path / "out", "a")
    beside.join()
    assert names(tmp_path) == ["out"] and len(names(tmp_path / "out")) == 1


def test_a_relative_name_is_taken_from_where_one_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with replacing(Path("out")) as filling:
        (filling / "a").touch()
    assert (tmp_path / "out/a").exists()


@pytest.mark.parametrize("made", [True, False])
def test_a_link_stays_and_what_it_leads_to_is_replaced(made, tmp_path):
    target, link = tmp_path / "disk/deep/out", tmp_path / "here/out"
    link.parent.mkdir()
    link.symlink_to(target)
    if made:
        target.mkdir(parents=True)
        (target / RUN_FILE).write_text("{}")
    check_place(link)
    with replacing(link) as filling:
        (filling / "a").touch()
    assert link.is_symlink() and names(link) == ["a"]
    assert names(link.parent) == ["out"] and names(target.parent) == ["out"]


def test_the_place_that_a_link_leads_to_is_checked(tmp_path):
    (tmp_path / "file").touch()
    for name, target in (("below a file", "file/out"), ("circle", "circle"), ("to a file", "file")):
        (tmp_path / name).symlink_to(target)
        with pytest.raises(InputError, match=f"{name} (cannot be written|is a file)"):
            check_place(tmp_path / name)


@pytest.mark.parametrize("make", ["nothing", "empty", "earlier result", "deep"])
def test_a_place_that_is_free_or_holds_an_earlier_result_is_accepted(make, tmp_path):
    place = tmp_path / ("a/b/c/out" if make == "deep" else "out")
    if make in ("empty", "earlier result"):
        place.mkdir()
    if make == "earlier result":
        (place / RUN_FILE).write_text("{}")
        (place / "scene.ply").write_text("x")
    check_place(place)


@pytest.mark.parametrize(
    ("make", "says"),
    [("file", "out is a file"), ("foreign", "something else"), ("below a file", "not a writable folder")],
)
def test_a_place_that_is_taken_is_refused(make, says, tmp_path):
    place = tmp_path / "out"
    if make == "foreign":
        place.mkdir()
        (place / "thesis.tex").write_text("x")
    else:
        place.write_text("x")
    with pytest.raises(InputError, match=says):
        check_place(place / "deeper" if make == "below a file" else place)


def test_masks_are_written_at_the_size_of_the_photo_without_blending_ids(tmp_path):
    ids = np.array([[1, 500], [0, 65535]], np.uint16)
    frame = Frame("view", 2, 2, EMPTY, EMPTY, 8, 6)
    write_masks({tmp_path / "masks": [LabelMap("view", ids)]}, [frame], [None])
    read = cv2.imread(str(tmp_path / "masks/view.png"), cv2.IMREAD_UNCHANGED)
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, np.kron(ids, np.ones((3, 4), np.uint16)))


def test_frames_and_maps_that_do_not_pair_up_are_a_fault(tmp_path):
    frame = Frame("view", 2, 2, EMPTY, EMPTY, 2, 2)
    with pytest.raises(ValueError, match="shorter"):
        write_masks({}, [frame], [])
    with pytest.raises(ValueError, match="0 maps for masks of 1 frames"):
        write_masks({tmp_path / "masks": []}, [frame], [None])
