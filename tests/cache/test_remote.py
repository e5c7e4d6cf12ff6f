"""A store in a bucket: what one machine puts another gets, and nothing is moved twice."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import ss_flow_toy as toy
from remote_stores import action_of, emptied, label_map, names

from ss_flow.cache import remote
from ss_flow.cache.bucket import Bucket
from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import Gone, StoreFailure
from ss_flow.cache.remote import MANIFEST, RemoteStore
from ss_flow.cache.store import GRACE_SECONDS
from ss_flow.tasks.artifacts import Cameras, LabelMap


def test_what_one_machine_puts_another_gets_equal_to_the_bit(here, there):
    for value in (
        label_map(),
        LabelMap("large", np.random.default_rng(0).integers(0, 9999, (3000, 3000)).astype(np.uint16)),
        Cameras(("a", "ü"), np.ones((2, 2), np.int32), np.ones((2, 4)), np.ones((2, 4, 4)), True),
        toy.number(1.0),
    ):
        object_digest = here.put(value)
        assert object_digest == digest(value)
        assert object_digest in there
        assert digest(there.get(object_digest)) == object_digest


def test_what_was_read_once_is_read_here_the_next_time(here, there, bucket):
    object_digest = here.put(label_map())
    there.get(object_digest)
    bucket.delete(names(bucket, "objects"))
    again = RemoteStore(there.location, there.root)
    assert digest(again.get(object_digest)) == digest(again.read(object_digest)) == object_digest


def test_no_other_process_sweeps_what_is_downloaded_though_it_is_old(here, there, monkeypatch):
    object_digest = here.put(label_map())
    here.record(action := action_of(object_digest))
    stamp = remote._stamp
    monkeypatch.setattr(remote, "_stamp", lambda path, _: (stamp(path, 0.0), there.sweep_temporaries()))
    assert there.action(action.key) == action
    assert digest(there.get(object_digest)) == object_digest
    assert there.object_path(object_digest).stat().st_mtime == 0.0


def test_the_bucket_is_asked_once_whether_it_holds_an_object_and_never_for_what_is_here(here, there, asked):
    object_digest = here.put(label_map())
    asked.clear()
    assert object_digest in here
    assert not asked
    assert object_digest in there and object_digest in there
    assert asked == {"head": 1}


def test_storing_the_same_twice_uploads_it_once(here, there, asked):
    here.put(label_map())
    uploaded = asked["put"]
    assert uploaded
    here.put(label_map())
    there.put(label_map())
    assert (asked["put"], asked["create"]) == (uploaded, 1)


def test_an_unknown_object_is_gone(here):
    with pytest.raises(Gone, match="not in the store"):
        here.get("00" * 32)
    assert "00" * 32 not in here


def test_an_upload_that_is_cut_leaves_no_object_and_is_finished_by_the_next(here, there, bucket, monkeypatch):
    real = Bucket.create

    def cut(self, name, content):
        raise KeyboardInterrupt

    monkeypatch.setattr(Bucket, "create", cut)
    with pytest.raises(KeyboardInterrupt):
        here.put(label_map())
    monkeypatch.setattr(Bucket, "create", real)
    object_digest = digest(label_map())
    assert names(bucket, "objects") and not any(
        name.endswith(f"{object_digest}/{MANIFEST}") for name in names(bucket, "objects")
    )
    assert object_digest not in there
    with pytest.raises(Gone, match="not in the store"):
        there.get(object_digest)
    assert list(there.objects()) == []
    here.put(label_map())
    assert digest(there.get(object_digest)) == object_digest


def test_what_a_cut_upload_left_long_ago_is_listed_and_can_be_discarded(here, bucket, monkeypatch):
    object_digest = digest(label_map())
    bucket.put(f"objects/{object_digest[:2]}/{object_digest}/ids/{MANIFEST}", b"{}")
    assert list(here.objects()) == []
    monkeypatch.setattr(RemoteStore, "now", lambda self: time.time() + 2 * GRACE_SECONDS)
    assert [entry.name for entry in here.objects()] == [object_digest]
    assert here.discard(object_digest)
    assert names(bucket, "objects") == []


def test_files_of_an_object_are_written_before_the_one_that_makes_it_count(here, monkeypatch):
    written = []
    for method in ("put", "create"):
        real = getattr(Bucket, method)
        monkeypatch.setattr(Bucket, method, lambda s, n, c, real=real: (real(s, n, c), written.append(n))[0])
    object_digest = here.put(label_map())
    assert len(written) > 2
    assert written[-1] == f"objects/{object_digest[:2]}/{object_digest}/{MANIFEST}"


def test_what_makes_an_object_count_is_deleted_before_its_other_files(here, bucket, monkeypatch):
    object_digest = here.put(label_map())
    deleted, delete = [], Bucket.delete
    monkeypatch.setattr(
        Bucket, "delete", lambda self, files: deleted.append(sorted(files)) or delete(self, deleted[-1])
    )
    assert here.discard(object_digest)
    first, rest = deleted
    assert first == [f"objects/{object_digest[:2]}/{object_digest}/{MANIFEST}"] and len(rest) > 1


def test_the_time_is_that_of_the_buckets_clock(here, monkeypatch):
    head = Bucket.head
    monkeypatch.setattr(Bucket, "head", lambda self, name: replace(head(self, name), written=123.0))
    assert here.now() == 123.0


def test_of_two_that_write_the_same_object_both_have_it(here, there):
    value = LabelMap("large", np.random.default_rng(0).integers(0, 9999, (2000, 2000)).astype(np.uint16))
    writers = [threading.Thread(target=store.put, args=[value]) for store in (here, there)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert digest(emptied(here).get(digest(value))) == digest(value)


def test_an_action_is_found_elsewhere_while_its_outputs_are_there(here, there, bucket):
    outputs = here.put(label_map()), here.put(label_map(8))
    action = action_of(*outputs)
    here.record(action)
    assert there.action(action.key) == action
    assert there.action("cd" * 32) is None
    bucket.delete([f"objects/{outputs[1][:2]}/{outputs[1]}/{MANIFEST}"])
    assert emptied(here).action(action.key) is None
    assert emptied(here).action(action.key, whole=False) == action


def test_an_action_that_was_found_once_is_read_here(here, there, asked):
    action = action_of(here.put(label_map()))
    here.record(action)
    there.action(action.key)
    there.get(action.outputs[0])
    asked.clear()
    assert RemoteStore(there.location, there.root).action(action.key) == action
    assert not asked


def test_an_action_is_recorded_in_the_bucket_before_here(here, monkeypatch):
    action = action_of(here.put(label_map()))
    monkeypatch.setattr(Bucket, "put", lambda *_: (_ for _ in ()).throw(StoreFailure("no network")))
    with pytest.raises(StoreFailure):
        here.record(action)
    assert not here.action_path(action.key).exists()


def test_what_a_digest_of_code_or_of_a_list_stands_for_is_known_elsewhere(here, there):
    here.put_part("code", {"a.b": "1"})
    here.put_part("list", ("12", "34"))
    assert (there.part("code"), there.part("list")) == ({"a.b": "1"}, ["12", "34"])
    assert there.part("other") is None
