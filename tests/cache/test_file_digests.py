"""The digests of a user's files are remembered until the files change."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

from ss_flow.cache.canonical import digest_file
from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.files import write_checked


def test_a_file_is_read_once_until_it_changes(tmp_path, monkeypatch):
    from ss_flow.cache import file_digests

    reads = []
    real = file_digests.digest_file
    monkeypatch.setattr(file_digests, "digest_file", lambda p: reads.append(p) or real(p))
    photo = tmp_path / "photo"
    photo.write_text("one")
    with FileDigests(tmp_path / "files.json") as first:
        value = first(photo)
    again = FileDigests(tmp_path / "files.json")
    assert again(photo) == value
    assert len(reads) == 1
    photo.write_text("another")
    assert again(photo) != value
    FileDigests(tmp_path / "files.json", verify=True)(photo)
    assert len(reads) == 3


def test_a_damaged_table_of_files_is_learnt_again(tmp_path):
    photo = tmp_path / "photo"
    photo.write_text("one")
    digests = FileDigests(tmp_path / "files.json")
    right = digests(photo)
    digests.save()
    good = (tmp_path / "files.json").read_text()
    for bad in ("{", "[]", good.replace(right[:8], "0" * 8), good[:-9]):
        (tmp_path / "files.json").write_text(bad)
        assert FileDigests(tmp_path / "files.json")(photo) == right


def test_a_table_of_files_that_cannot_be_read_or_written_is_learnt_again_and_nothing_fails(tmp_path, monkeypatch):
    photo = tmp_path / "photo"
    photo.write_text("one")
    with FileDigests(tmp_path / "files.json") as first:
        right = first(photo)

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "read_text", refuse)
        patched.setattr(os, "fsync", refuse)
        with FileDigests(tmp_path / "files.json") as digests:
            assert digests._known == {} and digests(photo) == right
    assert FileDigests(tmp_path / "files.json")._known == first._known


def test_a_store_that_was_moved_away_is_not_there_again_for_what_was_learnt_of_files(tmp_path):
    photo = tmp_path / "photo"
    photo.write_text("one")
    with FileDigests(tmp_path / "moved" / "files.json") as digests:
        digests(photo)
    assert not (tmp_path / "moved").exists()


def test_files_of_folders_that_are_gone_are_forgotten_and_what_was_checked_is_not(tmp_path):
    files = [tmp_path / name / "photo" for name in ("here", "gone")]
    with FileDigests(tmp_path / "files.json") as digests:
        for file in files:
            file.parent.mkdir()
            file.write_text("one")
            digests(file)
        digests.once(lambda subject: None, None, ["of a model"])
        shutil.rmtree(files[1].parent)
    assert list(FileDigests(tmp_path / "files.json")._known) == [str(files[0]), "checked of a model"]


def test_the_digest_of_a_file_whose_name_is_no_text_is_remembered(tmp_path):
    file = tmp_path / "a\udcff.jpg"
    file.write_bytes(b"x")
    digests = FileDigests(tmp_path / "files.json")
    known = digests(file)
    digests.save()
    assert FileDigests(tmp_path / "files.json")._known[str(file)][1] == known


def test_a_file_that_was_written_over_with_its_old_time_is_read_again(tmp_path):
    """As archives unpack over one another whose files have all the same time: the inode, too, is often the old one."""
    file = tmp_path / "depth.raw"
    file.write_bytes(b"one")
    os.utime(file, (1, 1))
    with FileDigests(tmp_path / "files.json") as digests:
        before, known = file.stat(), digests(file)
    time.sleep(0.05)  # as fine as a kernel's clock
    file.write_bytes(b"two")
    os.utime(file, (1, 1))
    after = file.stat()
    assert (before.st_size, before.st_mtime_ns, before.st_ino) == (after.st_size, after.st_mtime_ns, after.st_ino)
    assert FileDigests(tmp_path / "files.json")(file) == digest_file(file) != known


def test_a_table_of_an_older_version_is_learnt_again(tmp_path):
    file = tmp_path / "photo"
    file.write_text("one")
    status = file.stat()
    old = {str(file): [status.st_size, status.st_mtime_ns, status.st_ino, "of another"]}
    write_checked(tmp_path / "files.json", json.dumps(old))
    assert FileDigests(tmp_path / "files.json")(file) == digest_file(file)
