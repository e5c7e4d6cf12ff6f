from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from ss_flow.cache import claims as module
from ss_flow.cache.claims import Claims, Folder
from ss_flow.cache.errors import StoreFailure


@pytest.fixture
def claims(store):
    opened = Claims(store.root)
    yield opened
    opened.release_all()


def place(store, key="k"):
    return store.root / "claims" / key


def test_a_claim_that_is_touched_while_it_is_released_is_released_all_the_same(store, monkeypatch):
    claims, remove, touched = Claims(store.root), Folder.remove, iter([True])
    monkeypatch.setattr(Folder, "remove", lambda *args: not next(touched, False) and remove(*args))
    assert claims.take("k")
    claims.release("k")
    assert list((store.root / "claims").iterdir()) == []


def test_the_end_does_not_wait_for_a_server_that_does_not_answer(claims, monkeypatch):
    answers, waited_in_vain = threading.Event(), []
    assert claims.take("a") and claims.take("b")
    monkeypatch.setattr(module, "RELEASE_SECONDS", 0.01)
    monkeypatch.setattr(Folder, "look", lambda *_: waited_in_vain.append(not answers.wait(2)))
    claims.release_all()
    answers.set()
    assert True not in waited_in_vain


def test_one_of_two_gets_a_key_and_the_other_after_its_release(store, claims):
    assert claims.take("k")
    assert not Claims(store.root).take("k")
    claims.release("k")
    assert not place(store).exists()
    assert Claims(store.root).take("k")


def test_the_claim_of_a_dead_process_of_this_machine_is_taken_over_at_once(store, claims):
    program = f"""
from pathlib import Path
from ss_flow.cache.claims import Claims
Claims(Path({str(store.root)!r})).take("k")
import os; os._exit(0)
"""
    subprocess.run([sys.executable, "-c", program], check=True)
    assert place(store).exists()
    assert claims.take("k")


def test_a_forked_process_claims_in_its_own_name(store):
    program = f"""
import json, os
from pathlib import Path
from ss_flow.cache.claims import Claims
Claims(Path({str(store.root)!r}))
if os.fork() == 0:
    Claims(Path({str(store.root)!r})).take("k")
    Path({str(store.root / "pid")!r}).write_text(str(os.getpid()))
    os._exit(0)
os.wait()
"""
    subprocess.run([sys.executable, "-c", program], check=True)
    assert json.loads(place(store).read_text())["pid"] == int((store.root / "pid").read_text())


def test_the_claim_of_another_process_with_the_same_number_is_taken_over(store, claims):
    ours = json.loads(claims._token)
    place(store).write_text(json.dumps({**ours, "started": ours["started"] - 1000}))
    assert claims.take("k")


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="only here the start has a clock that nobody sets")
def test_the_claim_of_a_living_process_holds_when_the_clock_is_set(store, claims, monkeypatch):
    place(store).write_text(json.dumps({**json.loads(claims._token), "token": "another"}))
    now = psutil.Process().create_time()
    monkeypatch.setattr(psutil.Process, "create_time", lambda process: now + 3600)
    assert not claims.take("k")


def test_a_disk_that_is_full_leaves_no_empty_claim(store, claims, monkeypatch):
    def full(handle, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "write", full)
    with pytest.raises(StoreFailure, match="No space left"):
        claims.take("k")
    assert not place(store).exists()


def test_the_claim_of_another_host_expires_by_our_own_clock_only(store, claims, monkeypatch):
    place(store).write_text(json.dumps({"host": "elsewhere", "pid": 1, "started": 0}))
    os.utime(place(store), (0, 0))  # a host whose clock is fifty years behind
    assert not claims.take("k")
    monkeypatch.setattr(module, "EXPIRY_SECONDS", 0.2)
    time.sleep(0.1)
    assert not claims.take("k")
    os.utime(place(store), (1e9, 1e9))  # it lives: it touched its claim
    time.sleep(0.15)
    assert not claims.take("k")
    time.sleep(0.3)
    assert claims.take("k")


def test_a_touch_shows_that_the_holder_lives_and_changes_nothing_else(store):
    folder = Folder(store.root)
    assert folder.create("k", b"mine")
    os.utime(place(store), (0, 0))
    folder.touch("k", folder.look("k"))
    assert folder.look("k").touched > 1e9 and folder.look("k").content == b"mine"


def test_a_claim_that_was_taken_over_is_neither_touched_nor_released_by_its_first_holder(store, monkeypatch):
    monkeypatch.setattr(module, "HEARTBEAT_SECONDS", 0.05)
    monkeypatch.setattr(module, "EXPIRY_SECONDS", 0.0)
    first, second = Claims(store.root), Claims(store.root)
    assert first.take("k")
    place(store).write_text(json.dumps({"host": "elsewhere", "pid": 1, "started": 0}))
    assert not second.take("k")
    time.sleep(0.1)
    assert second.take("k")
    first.release("k")
    assert place(store).exists()
    second.release_all()
    assert not place(store).exists()


def test_of_many_processes_that_find_a_stale_claim_one_gets_it(store):
    place(store).write_text(json.dumps({**json.loads(Claims(store.root)._token), "pid": 2**22 + 1}))
    program = f"""
import sys, time
from pathlib import Path
from ss_flow.cache.claims import Claims
claims = Claims(Path({str(store.root)!r}))
sys.stdin.readline()
print(int(claims.take("k")), flush=True)
sys.stdin.readline()
"""
    start = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    several = [subprocess.Popen([sys.executable, "-c", program], **start) for _ in range(4)]
    for one in several:
        one.stdin.write("go\n")
        one.stdin.flush()
    assert sum(int(one.stdout.readline()) for one in several) == 1
    for one in several:
        one.communicate()


def test_living_claims_are_those_that_are_not_known_to_be_dead(store, claims):
    claims.take("ours")
    place(store, "elsewhere").write_text(json.dumps({"host": "elsewhere", "pid": 1, "started": 0}))
    place(store, "dead").write_text(json.dumps({**json.loads(claims._token), "pid": 2**22 + 1}))
    assert claims.living() == {"ours", "elsewhere"}
