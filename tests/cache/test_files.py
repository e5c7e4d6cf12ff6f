"""A file is written whole or not at all, under any name."""

from __future__ import annotations

import os
import time

import pytest

from ss_flow.cache.files import write_atomically
from ss_flow.cache.store import GRACE_SECONDS


def test_a_file_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    target = tmp_path / "x.json"
    write_atomically(target, "old")

    def crash(handle):
        raise OSError("power cut")

    monkeypatch.setattr(os, "fsync", crash)
    with pytest.raises(OSError, match="power cut"):
        write_atomically(target, "new")
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


@pytest.mark.parametrize(
    "name", ["x" * 255, "\u5199" * 85, os.fsdecode(b"\xff" * 250)], ids=["long", "3 bytes", "no text"]
)
def test_a_file_may_have_the_longest_name_that_file_systems_take(tmp_path, name):
    write_atomically(tmp_path / name, "content")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "content"}


@pytest.mark.parametrize("synced", [True, False])
def test_a_file_is_synced_where_nothing_makes_it_again(tmp_path, monkeypatch, synced):
    calls = []
    monkeypatch.setattr(os, "fsync", calls.append)
    write_atomically(tmp_path / "a", "content", synced=synced)
    assert (tmp_path / "a").read_text() == "content" and len(calls) == synced


def test_what_killed_writers_left_beside_a_file_is_taken_away_by_age_and_nothing_else_is(tmp_path):
    left, young = (tmp_path / f".a[1].ply.{digit * 32}" for digit in "0f")
    others = [tmp_path / name for name in (".a[1].ply.0123", f".a1.ply.{'0' * 32}", f".b.a[1].ply.{'0' * 32}")]
    for path in (left, young, *others):
        path.write_text("x")
        if path != young:
            os.utime(path, (0, time.time() - 2 * GRACE_SECONDS))
    write_atomically(tmp_path / "a[1].ply", "new")
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "a[1].ply", young, *others])
