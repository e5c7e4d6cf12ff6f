"""Damaged objects and records are never served; what merely cannot be read now stays."""

from __future__ import annotations

import dataclasses
import errno
import os
import shutil
import sys

import numpy as np
import pytest
import ss_flow_toy as toy

from ss_flow.cache import codec
from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import Gone, OtherVersion, StoreFailure
from ss_flow.cache.store import Action, Store
from ss_flow.cache.survey import Survey
from ss_flow.cache.verify import verify
from ss_flow.tasks import artifacts
from ss_flow.tasks.artifacts import LabelMap


def test_a_damaged_object_is_taken_out_and_never_served(store):
    output = store.put(LabelMap("x", np.eye(64, dtype=np.uint16)))
    files = {f: f.read_bytes() for f in store.object_path(output).rglob("*") if f.is_file()}
    for file, whole in files.items():
        for position in range(0, len(whole), max(1, len(whole) // 20)):
            flipped = bytearray(whole)
            flipped[position] ^= 1
            store.put(LabelMap("x", np.eye(64, dtype=np.uint16)))
            file.write_bytes(flipped)
            try:
                value = Store(store.root).get(output)
            except Gone:
                assert output not in store
            else:  # a bit that says nothing: white space, or how a number is written
                assert digest(value) == output
            shutil.rmtree(store.object_path(output), ignore_errors=True)


def test_an_object_that_lost_a_field_on_the_disk_is_damaged(store):
    output = store.put(LabelMap("x", np.eye(64, dtype=np.uint16)))
    shutil.rmtree(store.object_path(output) / "ids")
    with pytest.raises(Gone, match="was damaged"):
        Store(store.root).get(output)
    assert output not in store


def _changed_label_map(*fields: str) -> type:
    """LabelMap as another version might have it."""
    kind = dataclasses.make_dataclass("LabelMap", fields, frozen=True)
    kind.__module__ = LabelMap.__module__
    return kind


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (("name", "ids", "scale"), "LabelMap has the new field scale"),
        (("name",), "LabelMap has no field ids any more"),
        (("name", "labels"), "LabelMap has no field ids any more, has the new field labels"),
    ],
)
def test_an_object_whose_type_has_other_fields_by_now_stays_and_is_not_called_damaged(store, monkeypatch, fields, said):
    output = store.put(LabelMap("x", np.eye(64, dtype=np.uint16)))
    store.record(Action("ab" * 32, "split.look", (output,), False, {}, 1.5, 10.0))
    with monkeypatch.context() as patch:
        patch.setattr(artifacts, "LabelMap", _changed_label_map(*fields))
        with pytest.raises(OtherVersion) as told:
            Store(store.root).get(output)
        assert said in str(told.value) and "split.look" in str(told.value) and "damaged" not in str(told.value)
        walks, actions = [], Store.actions
        patch.setattr(Store, "actions", lambda store: walks.append(store) or actions(store))
        assert verify(store).damaged == ()
        assert len(walks) == 1  # not once for each such object
    assert Store(store.root).get(output).name == "x"


@pytest.mark.parametrize("missing", ["module", "class"])
def test_an_object_whose_type_is_not_to_be_found_here_stays_and_is_not_called_damaged(store, monkeypatch, missing):
    output = store.put(toy.number(2.0))
    with monkeypatch.context() as patch:
        if missing == "module":
            patch.setitem(sys.modules, "ss_flow_toy", None)
        else:
            patch.delattr(toy, "Number")
        with pytest.raises(OtherVersion, match="there is no type ss_flow_toy:Number here") as told:
            Store(store.root).get(output)
        assert "damaged" not in str(told.value)
        assert verify(store).damaged == ()
        chunk = store.object_path(output) / "value/c.0"
        whole = chunk.read_bytes()
        chunk.write_bytes(whole[::-1])
        assert [damage.name for damage in verify(Store(store.root)).damaged] == [output]
    assert store.get(store.put(toy.number(2.0))).value[0] == 2.0


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EACCES, errno.EIO, errno.ENOMEM])
def test_an_object_that_cannot_be_read_now_stays_and_the_store_says_why_in_one_sentence(store, monkeypatch, number):
    value = LabelMap("x", np.eye(3, dtype=np.uint16))
    output = store.put(value)
    refused = OSError(number, os.strerror(number))
    for trouble in ("open", "lstat"):
        with monkeypatch.context() as patch:
            place, name = (codec, "open") if trouble == "open" else (codec.os, "lstat")
            patch.setattr(place, name, lambda *_: (_ for _ in ()).throw(refused), raising=False)
            for ask in (Store(store.root).get, lambda _: store.put(value), lambda _: verify(store)):
                with pytest.raises(StoreFailure, match=os.strerror(number)):
                    ask(output)
    assert Store(store.root).get(output).ids.trace() == 3


def test_an_object_that_memory_is_too_short_for_stays(store, monkeypatch):
    output = store.put(LabelMap("x", np.zeros((400, 500), np.uint16)))
    for name in ("_read_chunks", "_read_file"):
        with monkeypatch.context() as patch:
            patch.setattr(codec, name, lambda *_: (_ for _ in ()).throw(MemoryError))
            with pytest.raises(MemoryError):
                Store(store.root).get(output)
    assert Store(store.root).get(output).ids.shape == (400, 500)


def test_an_action_counts_only_while_its_outputs_are_there(store):
    output = store.put(LabelMap("x", np.ones((2, 2), np.uint16)))
    action = Action("ab" * 32, "step", (output,), False, {"parameters": {"p": 1}}, 1.5, 10.0)
    store.record(action)
    assert store.action(action.key) == action
    shutil.rmtree(store.object_path(output))
    assert store.action(action.key) is None
    assert store.action(action.key, whole=False) == action


def test_an_action_that_is_not_of_its_key_or_not_json_is_none(store):
    action = Action("ab" * 32, "step", (store.put(LabelMap("x", np.ones((2, 2)))),), False, {}, 1.5, 10.0)
    store.record(action)
    path = store.action_path(action.key)
    good = path.read_text()
    changes = (good.replace("abab", "abac"), good[:-3], "[]", "{}", good.replace(action.outputs[0], "../" * 20))
    for bad in changes:
        path.write_text(bad)
        assert store.action(action.key) is None
    path.write_text(good)
    assert store.action(action.key) == action


@pytest.mark.parametrize("kind", ["folder", "loop", "unreadable"])
def test_a_record_that_cannot_be_read_counts_for_nothing_and_is_recorded_again(store, monkeypatch, kind):
    action = Action("ab" * 32, "step", (store.put(toy.number(1.0)),), False, {}, 1.5, 10.0)
    store.record(action)
    path = store.action_path(action.key)
    if kind == "unreadable":
        refused = PermissionError(errno.EACCES, "Permission denied")
        monkeypatch.setattr("ss_flow.cache.store.read_stamped", lambda _: (_ for _ in ()).throw(refused))
    else:
        path.unlink()
        path.mkdir() if kind == "folder" else path.symlink_to(path)
    assert store.action(action.key) is None
    assert not Survey.of(store).is_whole(action.key)
    assert [damage.name for damage in verify(store).damaged] == [action.key]
    if kind == "folder":
        path.mkdir()
    store.record(action)
    monkeypatch.undo()
    assert store.action(action.key) == action


def test_a_process_that_can_open_no_file_takes_no_record_for_missing(store, monkeypatch):
    action = Action("ab" * 32, "step", (store.put(toy.number(1.0)),), False, {}, 1.5, 10.0)
    store.record(action)
    refused = OSError(errno.EMFILE, "Too many open files")
    monkeypatch.setattr("ss_flow.cache.store.read_stamped", lambda _: (_ for _ in ()).throw(refused))
    with pytest.raises(StoreFailure, match="cannot be read: Too many open files"):
        verify(store)
    monkeypatch.undo()
    assert store.action(action.key) == action
