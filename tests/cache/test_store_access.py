"""Who may read and write what is in a store, and what is said where it cannot be written."""

from __future__ import annotations

import errno
import os
import shutil

import numpy as np
import pytest

from ss_flow.cache import codec
from ss_flow.cache.errors import StoreFailure, writing
from ss_flow.cache.files import write_atomically
from ss_flow.cache.store import Action, Store
from ss_flow.tasks.artifacts import LabelMap


def test_a_store_of_a_group_stays_the_groups_though_a_user_has_a_private_umask(tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "store").chmod(0o2770)
    before = os.umask(0o077)
    try:
        store = Store(tmp_path / "store")
        if not hasattr(os, "getxattr") or "system.posix_acl_default" not in os.listxattr(store.root):
            pytest.skip("a file system without access control lists")
        store.record(
            Action("ab" * 32, "toy", (store.put(LabelMap("x", np.ones((2, 2), np.uint16))),), False, {}, 0.0, 0.0)
        )
        store.checkpoint("k").parent.mkdir()
        write_atomically(store.runs / "run" / "run.json", "{}")
        assert store.open_claims().take("k")
    finally:
        os.umask(before)
    made = list(store.root.rglob("*"))
    assert {"zarr.json", f"{'ab' * 32}.json", "checkpoints", "run.json", "k"} <= {path.name for path in made}
    assert [p for p in made if p.stat().st_mode & 0o070 != (0o070 if p.is_dir() else 0o060)] == []


def test_a_store_of_ones_own_stays_private(tmp_path):
    before = os.umask(0o077)
    try:
        store = Store(tmp_path / "store")
        store.put(LabelMap("x", np.ones((2, 2), np.uint16)))
    finally:
        os.umask(before)
    assert [path for path in store.root.rglob("*") if path.stat().st_mode & 0o077] == []


def test_a_file_that_another_user_keeps_private_is_named_with_what_to_do(store, monkeypatch):
    def refuse(path, *_):
        raise PermissionError(errno.EACCES, "Permission denied", path)

    monkeypatch.setattr(os, "utime", refuse)
    with pytest.raises(StoreFailure, match=rf"Permission denied for {store.root}/objects/.*`chmod -R g\+rwX`"):
        store.put(LabelMap("x", np.ones((2, 2), np.uint16)))


def test_a_store_that_can_open_no_file_to_write_says_what_is_wanted(store):
    said = r"Too many open files.* when more files may be open \(`ulimit -n`"
    with pytest.raises(StoreFailure, match=said), writing(store.root):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def test_a_store_that_cannot_be_written_says_so_in_one_sentence(store, monkeypatch):
    value = LabelMap("x", np.ones((2, 2), np.uint16))
    monkeypatch.setattr(codec, "write", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(StoreFailure, match="No space left on device"):
        store.put(value)
    monkeypatch.undo()
    shutil.rmtree(store.root)
    with pytest.raises(StoreFailure, match="it has vanished"):
        store.put(value)
    with pytest.raises(StoreFailure, match="it has vanished"):
        store.open_claims().take("k")
