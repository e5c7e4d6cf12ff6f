"""What a bucket and this machine hold is listed, and what nobody uses is taken out of both."""

from __future__ import annotations

import os
import time

from remote_stores import action_of, emptied, label_map, names, run

from ss_flow.cache import remote as remote_module
from ss_flow.cache.collect import Roots, collect
from ss_flow.cache.remote import RemoteStore
from ss_flow.cache.store import GRACE_SECONDS

LONG_AGO = time.time() - 2 * GRACE_SECONDS


def test_listings_tell_what_the_bucket_and_this_machine_hold(here, there, bucket):
    value = here.put(label_map())
    action = action_of(value)
    here.record(action)
    here.put_part("ab" * 32, {"a.b": "1"})
    size = sum(meta.bytes for meta in bucket.files("objects"))
    for store in (here, there):
        (entry,) = store.objects()
        assert (entry.name, entry.bytes) == (value, size)
        assert abs(entry.used - time.time()) < 10
        assert [entry.name for entry in store.actions()] == [action.key]
        assert [entry.name for entry in store.parts()] == ["ab" * 32]
        assert store.find(value[:7]) == [value]
        assert store.find(value[:1]) == store.find("zz") == []
        assert store.size(value) == size
    bucket.delete(names(bucket, "objects"))
    assert [entry.name for entry in here.objects()] == [value]
    assert here.find(value[:2]) == [value]


def test_files_of_other_hands_in_the_bucket_are_not_listed(here, bucket):
    for name in ("objects/x", "objects/aa/b/c", "objects/README/a", "actions/aa/notes.txt", "parts/x"):
        bucket.put(name, b"x")
    assert [*here.objects(), *here.actions(), *here.parts()] == []


def test_what_is_discarded_or_forgotten_is_gone_everywhere(here, there, bucket):
    action = action_of(here.put(label_map()))
    here.record(action)
    here.put_part("code", {"a": "1"})
    there.get(action.outputs[0])
    assert there.discard(action.outputs[0]) and there.forget(action.key) and there.drop_part("code")
    assert [names(bucket, folder) for folder in ("objects", "actions", "parts")] == [[], [], []]
    assert action.outputs[0] not in there
    assert there.action(action.key, whole=False) is None
    assert not there.discard(action.outputs[0]) and not there.forget(action.key)


def test_what_was_written_or_used_here_since_stays(here, there, bucket):
    action = action_of(here.put(label_map()))
    here.record(action)
    for store in (here, there):
        assert not store.discard(action.outputs[0], unused_since=LONG_AGO)
        assert not store.forget(action.key, unused_since=LONG_AGO)
    soon = time.time() + 60
    os.utime(here.action_path(action.key), (soon + 60, soon + 60))
    assert not here.forget(action.key, unused_since=soon)
    assert emptied(here).action(action.key) == action
    assert there.forget(action.key, unused_since=soon)
    assert there.discard(action.outputs[0], unused_since=soon)


def test_a_copy_is_as_old_as_what_it_is_a_copy_of(here, there, bucket, monkeypatch):
    action = action_of(here.put(label_map()))
    here.record(action)
    monkeypatch.setattr(remote_module, "_stamp", lambda path, used, real=remote_module._stamp: real(path, used - 9999))
    list(there.actions())
    there.get(action.outputs[0])
    assert there.action_path(action.key).stat().st_mtime < time.time() - 9000
    assert there.object_path(action.outputs[0]).stat().st_mtime < time.time() - 9000
    there.action(action.key)
    assert there.object_path(action.outputs[0]).stat().st_mtime > time.time() - 60


def test_garbage_in_the_bucket_is_collected_from_another_machine(here, there, bucket, monkeypatch):
    report = run(here)
    keep = next(n["key"] for n in report.nodes if n["label"] == "ss_flow_toy.total")
    monkeypatch.setattr(RemoteStore, "now", lambda self: time.time() + 2 * GRACE_SECONDS)
    collected = collect(there, lambda living: Roots(held={keep}))
    assert sum(tally.count for tally in collected.results.values()) == 7
    assert [name.rpartition("/")[2] for name in names(bucket, "actions")] == [f"{keep}.json"]
    assert [entry.name for entry in there.objects()] == [report.values["total"]]
    assert emptied(here).action(keep) is not None
