"""A store in a bucket, against a real server of S3's protocol on this machine."""

from __future__ import annotations

import http.server
import json
import os
import sys
import threading
import time
import urllib.request
import uuid
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import ss_flow_toy as toy
from tiny_runs import run_tiny, ss_flow, write_room

from ss_flow.cache import bucket as bucket_module
from ss_flow.cache import claims as claims_module
from ss_flow.cache import remote as remote_module
from ss_flow.cache.bucket import Bucket
from ss_flow.cache.canonical import digest
from ss_flow.cache.collect import Roots, collect
from ss_flow.cache.errors import Gone, OtherVersion, StoreFailure
from ss_flow.cache.location import open_store
from ss_flow.cache.remote import MANIFEST, RemoteStore, default_folder
from ss_flow.cache.store import GRACE_SECONDS, Action, Store
from ss_flow.cache.verify import verify
from ss_flow.engine import run_flow
from ss_flow.tasks.artifacts import Cameras, LabelMap

pytest.importorskip("obstore", reason="needs the extra s3")
moto = pytest.importorskip("moto.server", reason="needs moto[server], of the extra test")

LONG_AGO = time.time() - 2 * GRACE_SECONDS


def serve():
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    address = "http://{}:{}".format(*server.get_host_and_port())
    urllib.request.urlopen(urllib.request.Request(f"{address}/bucket", method="PUT")).close()
    return server, address


@pytest.fixture(scope="module")
def address():
    server, address = serve()
    yield address
    server.stop()


@pytest.fixture
def location(address, monkeypatch, tmp_path):
    """An empty prefix of a bucket."""
    settings = {
        "AWS_ENDPOINT_URL": address,
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
        "NO_PROXY": "127.0.0.1",
        "XDG_CACHE_HOME": str(tmp_path / "user"),
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setitem(bucket_module.RETRIES, "max_retries", 1)
    return f"s3://bucket/{uuid.uuid4().hex}"


@pytest.fixture
def opened(location, tmp_path):
    """Opens the store of one more machine, which has a folder of its own."""
    return lambda name: RemoteStore(location, tmp_path / name)


@pytest.fixture
def here(opened):
    return opened("here")


@pytest.fixture
def there(opened):
    return opened("there")


@pytest.fixture
def bucket(location):
    return Bucket(location)


@pytest.fixture
def asked(monkeypatch):
    """Counts what the bucket is asked, by method."""
    counts = Counter()
    for name in ("get", "head", "files", "put", "create", "blocks"):
        method = getattr(Bucket, name)

        def counting(self, *arguments, name=name, method=method):
            counts[name] += 1
            return method(self, *arguments)

        monkeypatch.setattr(Bucket, name, counting)
    return counts


def label_map(n=64):
    return LabelMap("x", np.eye(n, dtype=np.uint16))


def names(bucket, folder):
    return sorted(meta.name for meta in bucket.files(folder))


def action_of(*outputs, key="ab" * 32):
    return Action(key, "step", outputs, True, {"parameters": {"p": 1}, "code": "c"}, 1.5, 10.0, warnings=("w",))


def emptied(store):
    """The same store as another process sees it that has nothing at hand."""
    return RemoteStore(store.location, store.root.with_name(uuid.uuid4().hex))


def run(store, **options):
    return run_flow(toy.flow, store, scene="toy", **options)


def computed(report):
    return sum(node["event"] == "finished" for node in report.nodes)


# Objects


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


def test_a_damaged_object_in_the_bucket_is_never_served_and_is_taken_out_and_made_again(here, bucket):
    object_digest = here.put(label_map())
    files = {name: bucket.get(name)[0] for name in names(bucket, "objects")}
    for file, whole in files.items():
        for damage in (b"", whole[:-1], bytes([whole[0] ^ 1]) + whole[1:], whole[:40] + b"\x00" + whole[41:]):
            bucket.put(file, damage)
            reader = emptied(here)
            try:
                value = reader.get(object_digest)
            except Gone as gone:
                assert "damaged" in str(gone)
                assert object_digest not in reader
                assert names(bucket, "objects") == []
                reader.put(label_map())
            else:  # a bit that says nothing, such as white space
                assert digest(value) == object_digest
            assert digest(emptied(here).get(object_digest)) == object_digest
            bucket.put(file, whole)


@pytest.mark.parametrize("read", ["get", "read"])
def test_what_is_damaged_only_on_its_way_is_downloaded_again_and_stays_in_the_bucket(
    here, there, bucket, monkeypatch, read
):
    object_digest = here.put(label_map())
    held = names(bucket, "objects")
    real, damaged = Bucket.blocks, []

    def once(self, name):
        whole = b"".join(real(self, name))
        if damaged:
            return [whole]
        damaged.append(name)
        return [whole[: len(whole) // 2]]

    monkeypatch.setattr(Bucket, "blocks", once)
    assert digest(getattr(there, read)(object_digest)) == object_digest
    assert damaged and names(bucket, "objects") == held
    assert list((there.root / "tmp").iterdir()) == []


def test_a_damaged_copy_here_is_downloaded_again(here, there):
    object_digest = here.put(label_map())
    there.get(object_digest)
    place = there.object_path(object_digest) / "ids" / MANIFEST
    place.write_text("{}")
    assert digest(RemoteStore(there.location, there.root).get(object_digest)) == object_digest
    assert place.read_text() != "{}"


def test_an_object_whose_type_is_not_to_be_found_here_stays_in_the_bucket_and_here(here, there, monkeypatch):
    output = here.put(toy.number(2.0))
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "ss_flow_toy", None)
        for store in (there, here):
            with pytest.raises(OtherVersion, match="there is no type ss_flow_toy:Number here"):
                store.get(output)
            assert verify(store).damaged == ()
        assert here.object_path(output).is_dir()
    assert there.get(output).value[0] == 2.0


def test_a_damaged_copy_here_that_the_bucket_does_not_hold_is_gone(here, bucket):
    object_digest = here.put(label_map())
    (here.object_path(object_digest) / "ids" / MANIFEST).write_text("{}")
    bucket.delete(names(bucket, "objects"))
    reader = RemoteStore(here.location, here.root)
    with pytest.raises(Gone):
        reader.get(object_digest)
    assert object_digest not in reader


def test_files_with_names_that_lead_elsewhere_are_not_downloaded(here, there, bucket):
    object_digest = here.put(label_map())
    folder = f"objects/{object_digest[:2]}/{object_digest}"
    bucket.put(f"{folder}/.hidden", b"x")
    assert digest(there.get(object_digest)) == object_digest
    assert not (there.object_path(object_digest) / ".hidden").exists()


def test_a_full_disk_here_names_the_folder_and_leaves_nothing(here, there, monkeypatch):
    object_digest = here.put(label_map())
    monkeypatch.setattr(Bucket, "blocks", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(StoreFailure, match=rf"{there.root} cannot be written: No space left"):
        there.get(object_digest)
    assert list((there.root / "tmp").iterdir()) == []
    assert not there.object_path(object_digest).exists()


def test_a_folder_here_that_was_moved_away_is_not_there_again(here, there):
    object_digest = here.put(label_map())
    there.root.rename(there.root.with_name("moved"))
    with pytest.raises(StoreFailure, match=rf"{there.root} cannot be written: it has vanished"):
        there.get(object_digest)
    assert not there.root.exists()


def test_an_object_that_the_bucket_lost_is_restored_from_here_when_it_is_whole(here, there, bucket):
    whole, damaged = here.put(label_map()), here.put(label_map(8))
    (here.object_path(damaged) / "ids" / MANIFEST).write_text("{}")
    bucket.delete(names(bucket, "objects"))
    for object_digest in (whole, damaged):
        with pytest.raises(Gone):
            there.get(object_digest)
        here.restore(object_digest)
    assert digest(there.get(whole)) == whole
    assert damaged not in there and damaged not in here


# Actions and parts of keys


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


def test_a_damaged_action_in_the_bucket_counts_for_nothing_and_is_recorded_again(here, there, bucket):
    action = action_of(here.put(label_map()))
    here.record(action)
    (name,) = names(bucket, "actions")
    good = bucket.get(name)[0]
    for bad in (
        good.replace(b"abab", b"abac"),
        good[:-3],
        b"[]",
        b"\xff",
        good.replace(action.outputs[0].encode(), b"../"),
    ):
        bucket.put(name, bad)
        assert there.action(action.key) is None
    there.record(action)
    assert there.action(action.key) == action
    assert emptied(here).action(action.key) == action


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


# A whole flow


def test_what_one_machine_computed_is_all_hits_on_another(here, there):
    first = run(here)
    assert computed(first) == 8
    again = run(there)
    assert computed(again) == 0 and len(again.nodes) == 8
    assert again.values == first.values
    assert float(there.get(again.values["total"]).value[0]) == 14.0


def test_processes_work_on_a_bucket_by_its_location(location, there):
    store = open_store(location)
    assert store.root.is_relative_to(os.environ["XDG_CACHE_HOME"])
    assert computed(run(store, executor="processes")) == 8
    assert computed(run(there)) == 0


def test_a_flow_heals_what_is_damaged_in_the_bucket(here, there, bucket):
    report = run(here)
    damaged = report.values["squares"][1]
    file = next(n for n in names(bucket, f"objects/{damaged[:2]}/{damaged}") if not n.endswith(MANIFEST))
    bucket.put(file, b"\x00" * 8)
    total = there.action_path(next(n["key"] for n in report.nodes if n["label"] == "ss_flow_toy.total"))
    bucket.delete([total.relative_to(there.root).as_posix()])
    again = run(there)
    assert again.values == report.values
    assert {n["label"] for n in again.nodes if n["event"] == "finished"} == {
        "ss_flow_toy.square[n1]",
        "ss_flow_toy.total",
    }
    assert digest(emptied(here).get(damaged)) == damaged


def test_nothing_in_the_bucket_is_a_credential(here, bucket, monkeypatch):
    run(here)
    kept = [bucket.get(name)[0] for folder in ("actions", "parts", "claims") for name in names(bucket, folder)]
    kept += [path.read_bytes() for path in (here.root / "roots").rglob("*") if path.is_file()]
    assert kept
    assert not [content for content in kept if b"SECRET" in content or b'"test"' in content]


# Listing and taking out


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


def test_verifying_reads_the_bucket_even_where_the_copy_here_is_whole(here, bucket):
    good, damaged = here.put(label_map()), here.put(label_map(8))
    bucket.put(f"objects/{damaged[:2]}/{damaged}/ids/{MANIFEST}", b"{}")
    found = verify(here)
    assert [damage.name for damage in found.damaged] == [damaged]
    assert found.objects.count == 2
    assert good in emptied(here) and damaged not in emptied(here)


# Claims


@pytest.fixture
def two(here, there):
    claims = here.open_claims(), there.open_claims()
    yield claims
    for each in claims:
        each.release_all()


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(remote_module._BucketClaims, "poll_seconds", 0.0)
    monkeypatch.setattr(claims_module, "HEARTBEAT_SECONDS", 0.05)


def test_one_of_two_machines_gets_a_key_and_the_other_after_its_release(two, bucket, impatient):
    first, second = two
    assert first.take("k")
    assert not second.take("k")
    first.release("k")
    assert names(bucket, "claims") == []
    assert second.take("k")


def test_a_refused_key_is_not_asked_for_again_at_once(two, asked):
    first, second = two
    assert first.take("k")
    assert not second.take("k")
    asked.clear()
    assert not second.take("k")
    assert not asked


def test_a_claim_that_its_holder_touches_lives_and_one_that_nobody_touches_expires(two, bucket, impatient, monkeypatch):
    first, second = two
    monkeypatch.setattr(claims_module, "EXPIRY_SECONDS", 0.5)
    assert first.take("living")
    bucket.put("claims/silent", json.dumps({"host": "elsewhere", "pid": 1, "started": 0}).encode())
    assert not second.take("living") and not second.take("silent")
    time.sleep(0.8)
    assert not second.take("living")
    assert second.take("silent")


def test_the_claim_of_a_dead_process_of_this_machine_is_taken_over_at_once(two, bucket):
    first, _ = two
    bucket.put("claims/k", json.dumps({**json.loads(first._token), "pid": 2**22 + 1}).encode())
    assert first.take("k")


def test_a_claim_of_ours_whose_making_was_never_confirmed_is_in_nobodys_way(two, bucket):
    first, second = two
    bucket.put("claims/k", first._token)
    assert not second.take("k")
    assert first.take("k")
    first.release("k")
    assert names(bucket, "claims") == []


def test_of_several_that_find_a_stale_claim_one_gets_it(opened, bucket, two):
    bucket.put("claims/k", json.dumps({**json.loads(two[0]._token), "pid": 2**22 + 1}).encode())
    several = [opened(f"m{i}").open_claims() for i in range(4)]
    start = threading.Barrier(4)
    got = []

    def take(claims):
        start.wait()
        got.append(claims.take("k"))

    threads = [threading.Thread(target=take, args=[claims]) for claims in several]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(got) == 1
    for claims in several:
        claims.release_all()


def test_a_claim_that_was_taken_over_is_neither_touched_nor_released_by_its_first_holder(two, bucket, impatient):
    first, _ = two
    assert first.take("k")
    theirs = json.dumps({"host": "elsewhere", "pid": 1, "started": 0}).encode()
    bucket.put("claims/k", theirs)
    time.sleep(0.3)
    first.release("k")
    assert bucket.get("claims/k")[0] == theirs


def test_a_claim_that_was_touched_since_it_was_seen_is_not_removed(here, bucket):
    place = remote_module._BucketClaims(bucket)
    assert place.create("k", b"holder")
    seen = place.look("k")
    place.touch("k", seen)
    assert not place.remove("k", seen)
    assert place.look("k").content == b"holder"
    assert place.remove("k", place.look("k"))
    assert place.look("k") is None


def test_a_claim_is_removed_though_the_answer_to_writing_over_it_was_lost(here, bucket, monkeypatch):
    place = remote_module._BucketClaims(bucket)
    assert place.create("k", b"holder")
    seen, real = place.look("k"), Bucket.replace

    def lost(self, seen, content):
        assert real(self, seen, content)
        return real(self, seen, content)  # as the library asks again

    with monkeypatch.context() as patched:
        patched.setattr(Bucket, "replace", lost)
        assert place.remove("k", seen)
    assert place.look("k") is None


def test_of_two_that_find_an_emptied_claim_one_removes_it(here, bucket, monkeypatch):
    place = remote_module._BucketClaims(bucket)
    assert place.create("k", b"holder")
    seen = place.look("k")
    with monkeypatch.context() as patched:
        patched.setattr(Bucket, "delete", lambda *_: None)
        assert place.remove("k", seen)  # and dies before it deletes it
        emptied = place.look("k")
        assert place.remove("k", emptied)
    assert not place.remove("k", emptied)
    assert place.remove("k", place.look("k"))


def test_living_claims_are_known_and_stale_ones_swept(two, bucket):
    first, second = two
    first.take("run-küche")
    bucket.put("claims/dead", json.dumps({**json.loads(first._token), "pid": 2**22 + 1}).encode())
    bucket.put("claims/elsewhere", json.dumps({"host": "elsewhere", "pid": 1, "started": 0}).encode())
    assert second.living() == {"run-küche", "elsewhere"}
    assert second.sweep() == 1
    second.distrust(time.time() + 60)
    assert second.living() == set()
    assert second.sweep() == 2
    assert names(bucket, "claims") == []


# What is wrong


class Cutting(http.server.BaseHTTPRequestHandler):
    """Holds nothing. Cuts the first `cut` answers of its server; `told` is the length that it tells of them, 0 = that
    of what is left."""

    def do_GET(self):
        listing = "list-type" in self.path
        answer = (
            b"<ListBucketResult><IsTruncated>false</IsTruncated></ListBucketResult>" if listing else b"<Error/>" * 9
        )
        self.server.asked += 1
        told = len(answer)
        if self.server.asked <= self.server.cut:
            answer = answer[:9]
            told = self.server.told or len(answer)
        self.send_response(200 if listing else 404)
        self.send_header("Content-Length", str(told))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *_):
        pass


@pytest.mark.parametrize(
    ("ask", "told", "answer"),
    [
        (Bucket.files, 80, []),
        (Bucket.files, 0, []),
        (Bucket.folders, 80, []),
        (Bucket.folders, 0, []),
        (Bucket.get, 80, None),
    ],
)
def test_what_was_asked_is_asked_again_where_the_answer_was_cut(location, monkeypatch, ask, told, answer):
    with http.server.HTTPServer(("127.0.0.1", 0), Cutting) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
        server.asked, server.cut, server.told = 0, 1, told
        assert ask(Bucket(location), "objects") == answer
        server.asked, server.cut = 0, 9
        with pytest.raises(StoreFailure, match="cannot be used"):
            ask(Bucket(location), "objects")
        assert server.asked == 2, "no more often than other requests"
        server.shutdown()


def test_a_server_that_has_gone_is_told_in_one_sentence_that_names_the_store(location, tmp_path, monkeypatch):
    server, address = serve()
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    store = RemoteStore(location, tmp_path / "here")
    claims = store.open_claims()
    assert claims.take("held")
    object_digest = store.put(label_map())
    server.stop()
    for call in (
        lambda: store.put(label_map(8)),
        lambda: "00" * 32 in store,
        lambda: store.get("00" * 32),
        lambda: store.action("ab" * 32),
        lambda: list(store.objects()),
        lambda: store.discard(object_digest),
        lambda: claims.take("k"),
        store.now,
        lambda: run(store),
    ):
        with pytest.raises(StoreFailure) as failure:
            call()
        text = str(failure.value)
        assert text.startswith(f"the store {location} cannot be used: ")
        assert "\n" not in text and len(text) < 300
    claims.release_all()


def test_a_bucket_that_is_not_there_is_told_by_what_the_server_says(location, tmp_path):
    store = RemoteStore("s3://elsewhere/x", tmp_path / "here")
    with pytest.raises(StoreFailure, match="s3://elsewhere/x cannot be used: The specified bucket does not exist"):
        store.put(label_map())


def test_missing_credentials_are_told(location, tmp_path, monkeypatch):
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(StoreFailure, match="there are no credentials"):
        RemoteStore(location, tmp_path / "here").now()


@pytest.mark.parametrize(
    ("location", "expected"),
    [
        ("s3://key:hidden@bucket/x", "credentials belong into the environment"),
        ("s3://bucket/x?token=hidden", "credentials belong into the environment"),
        ("s3://", "name a folder, or s3://BUCKET/PREFIX"),
        ("s3:///x", "name a folder, or s3://BUCKET/PREFIX"),
        ("https://bucket/x", "name a folder, or s3://BUCKET/PREFIX"),
    ],
)
def test_a_location_that_is_none_is_refused_without_a_secret(location, expected, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    called = ss_flow("status", "--cache", location)
    assert called.code == 2
    assert expected in called.err.replace("\n", " ")
    assert "hidden" not in called.err
    assert list(tmp_path.iterdir()) == []


def test_without_obstore_the_extra_to_install_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(ValueError, match=r"pip install 'ss-flow\[s3\]'"):
        open_store("s3://bucket/x")


def test_a_path_is_a_folder_and_a_url_a_bucket(location, tmp_path):
    assert type(open_store(tmp_path / "store")) is type(open_store(str(tmp_path / "store"))) is Store
    store = open_store(f"{location}/")
    assert isinstance(store, RemoteStore)
    assert store.location == location


def test_every_location_and_endpoint_has_a_folder_of_its_own(monkeypatch):
    for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT"):
        monkeypatch.delenv(name, raising=False)
    folders = [default_folder("s3://a/b"), default_folder("s3://a-b")]
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9000")
    folders.append(default_folder("s3://a/b"))
    monkeypatch.delenv("AWS_ENDPOINT_URL")
    monkeypatch.setenv("AWS_ENDPOINT", "http://127.0.0.1:9001")
    folders.append(default_folder("s3://a/b"))
    assert len({*folders}) == 4


def test_the_command_line_takes_a_location_from_the_option_and_from_the_environment(location, monkeypatch):
    run(open_store(location))
    assert ss_flow("status", "--json", "--cache", location).document()["scene"] == "toy"
    monkeypatch.setenv("SS_FLOW_CACHE", location)
    rows = ss_flow("cache", "ls", "--json").document()
    assert len(rows) == 8 and all(row["bytes"] > 0 for row in rows)
    called = ss_flow("status", "--cache", "s3://bucket/elsewhere")
    assert called.code == 2
    assert "the store s3://bucket/elsewhere knows no run" in called.err


def test_a_scene_that_one_machine_ran_is_reused_and_searched_by_another(location, tmp_path, monkeypatch):
    monkeypatch.setenv("SS_FLOW_MODELS", "")
    scene = write_room(tmp_path / "room")
    first = run_tiny(scene, location, out=tmp_path / "first")
    assert first.code == 0, first.err
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "another"))
    again = run_tiny(scene, location, out=tmp_path / "again")
    assert again.code == 0, again.err
    assert not again.computed()
    assert again.results() == first.results()
    assert again.document()["store"] == location
    assert ss_flow("query", tmp_path / "again", "red", "--json").document()["instances"]
