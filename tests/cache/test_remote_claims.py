"""Claims in a bucket: one of several machines gets a key, and no claim outlives its holder for long."""

from __future__ import annotations

import json
import threading
import time

import pytest
from remote_stores import names

from ss_flow.cache import claims as claims_module
from ss_flow.cache import remote as remote_module
from ss_flow.cache.bucket import Bucket


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
