"""What can go wrong while a flow runs: damage, full disks, lost processes, too little memory, interrupts."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import psutil
import pytest
import ss_flow_toy as toy

from ss_flow.cache import codec, file_digests
from ss_flow.cache.canonical import digest_file
from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.store import Store
from ss_flow.engine import Request, run_flow, run_flows
from ss_flow.errors import InputError
from ss_flow.events import Record, Reporter
from ss_flow.graph import each
from ss_flow.runs import latest_runs
from ss_flow.task import FileRef


def run(store, build=toy.flow, **options):
    return run_flow(build, Store(store.root), scene="toy", **options)


def read_by(done, store, build=toy.flow):
    """Run, and have the results read by `done`."""
    return run_flows([Request(build, "toy", done=done)], Store(store.root))[0]


def computed(report):
    return sorted(n["label"] for n in report.nodes if n["event"] == "finished")


def flip(store, object_digest, byte=-1):
    """Flip one bit in the values of a stored object."""
    chunk = next(store.object_path(object_digest).glob("*/c*"))
    content = bytearray(chunk.read_bytes())
    content[byte] ^= 1
    chunk.write_bytes(content)


def one(build):
    """A flow over one number."""
    return lambda: {"out": build(toy.source(values=(2.0,))[0])}


def test_a_damaged_input_is_made_again_before_it_is_used(store):
    squares = run(store).values["squares"]
    flip(store, squares[1])
    again = run(store, lambda: {"total": toy.total(toy.flow()["squares"]), "half": each_half()})
    fresh = run(
        Store(store.root.parent / "fresh"), lambda: {"total": toy.total(toy.flow()["squares"]), "half": each_half()}
    )
    assert again.values == fresh.values
    assert computed(again) == [
        "ss_flow_toy.half[0]",
        "ss_flow_toy.half[1]",
        "ss_flow_toy.half[2]",
        "ss_flow_toy.square[n1]",
    ]


def each_half():
    return each(toy.flow()["squares"], build=toy.half)


def test_a_damaged_result_that_decides_what_comes_next_is_made_again(store):
    def build():
        return {"end": toy.halving(toy.source(values=(10.0,))[0])}

    first = run(store, build)
    [number] = [n["outputs"][0] for n in first.nodes if n["step"] == "ss_flow_toy.source"]
    flip(store, number)
    again = run(store, build)
    assert again.values == first.values
    assert computed(again) == ["ss_flow_toy.source"]
    assert again.nodes[0]["why"] == "its result is no longer in the store"
    kinds = [event["event"] for event in next(latest_runs(store.root / "roots" / "runs")).events()]
    assert kinds.count("restarted") == 1


def test_bits_flipped_in_many_objects_change_no_result(store):
    first = run(store)
    objects = [entry.name for entry in store.objects()]
    for seed in range(5):
        for name in random.Random(seed).sample(objects, 3):
            if name in store:
                flip(store, name, byte=seed)
        again = run(store, lambda seed=seed: toy.flow(limit=50.0 + seed))
        assert again.values == first.values
        run(store)


def test_a_final_result_that_its_reader_finds_damaged_is_made_again_and_read_again(store):
    first = run(store)
    flip(store, first.values["squares"][2])
    flip(store, first.values["total"])
    read = []

    def done(report):
        reader = Store(store.root)
        read.append([reader.get(value) for value in (*report.values["squares"], report.values["total"])])

    again = read_by(done, store)
    assert again.values == first.values and len(read) == 1 and len(read[0]) == 4
    assert computed(again) == ["ss_flow_toy.square[n2]", "ss_flow_toy.total"]
    kinds = [event["event"] for event in next(latest_runs(store.root / "roots" / "runs")).events()]
    assert kinds.count("restarted") == 2 and kinds[-1] == "run ended"


def test_the_other_flows_are_read_once_when_a_result_of_one_is_made_again(store):
    run(store)
    flip(store, run(store).values["total"])
    read = []

    def done(scene, report):
        read.append((scene, Store(store.root).get(report.values["total"]) is not None))

    builds = {"other": lambda: toy.flow(limit=20.0), "toy": toy.flow}
    requests = [Request(build, scene, done=partial(done, scene)) for scene, build in builds.items()]
    reports = run_flows(requests, Store(store.root))
    assert sorted(read) == [("other", True), ("toy", True)]
    assert all(isinstance(report.values["total"], str) for report in reports)


@pytest.mark.parametrize(
    ("task", "results"), [(toy.square, 1), (toy.uncertain, 2)], ids=["the same result", "another result each time"]
)
def test_a_result_that_is_damaged_again_after_it_was_made_anew_ends_the_run(store, task, results):
    """As on a failing disk, also where a computation does not give the same bits twice."""
    tried = []

    def done(report):
        tried.append(report.values["out"])
        flip(store, report.values["out"])
        Store(store.root).get(report.values["out"])

    with pytest.raises(StoreFailure, match=r"was damaged .*, though it was made anew; is the disk failing"):
        read_by(done, store, one(task))
    assert len(tried) == 2 and len(set(tried)) == results
    last = list(next(latest_runs(store.root / "roots" / "runs")).events())[-1]
    assert (last["event"], last["interrupted"]) == ("run ended", True)


def test_a_reader_that_fails_leaves_the_record_of_a_run_that_ended(store):
    def done(report):
        raise InputError("no place to write to")

    with pytest.raises(InputError, match="no place"):
        read_by(done, store)
    ends = [e for e in next(latest_runs(store.root / "roots" / "runs")).events() if e["event"] == "run ended"]
    assert [(end["failed"], set(end["results"])) for end in ends] == [(0, {"squares", "total"})]


def test_a_disk_that_is_full_now_and_then_costs_runs_but_no_result(store, monkeypatch):
    expected = run(Store(store.root.parent / "fresh")).values
    write, chance = codec.write, random.Random(0)

    def sometimes_full(value, folder):
        if chance.random() < 0.4:
            raise OSError(28, "No space left on device")
        write(value, folder)

    monkeypatch.setattr(codec, "write", sometimes_full)
    refusals, report = 0, None
    while report is None and refusals < 40:
        try:
            report = run(store)
        except StoreFailure as failure:
            refusals += 1
            assert "No space left on device" in str(failure)
            assert list((store.root / "claims").iterdir()) == list((store.root / "tmp").iterdir()) == []
    assert report is not None
    assert report.values == expected
    assert refusals


def test_an_input_file_that_changes_after_its_key_was_made_fails_its_step_and_leaves_no_result(store, tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")

    class Changing(Reporter):
        def event(self, kind, **details):
            if (kind, details.get("step")) == ("started", "ss_flow_toy.source"):
                file.write_text("5.0")

    def flow():
        return {"x": toy.times_file(toy.source(values=(3.0,))[0], files=(FileRef(file, digest_file(file)),))}

    failure = run_flow(flow, store, scene="toy", reporter=Changing()).values["x"]
    assert isinstance(failure.error, InputError)
    assert "factor.txt, which has changed since the run started" in str(failure.error)
    file.write_text("2.0")
    os.utime(file, (1, 1))
    again = run_flow(flow, store, scene="toy")
    assert again.nodes[-1]["event"] == "finished" and float(store.get(again.values["x"]).value[0]) == 6.0


def test_a_file_that_is_another_one_only_while_it_is_read_fails_its_step(store, tmp_path, monkeypatch):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")
    read = Path.read_text

    def exchanged(path, *args, **options):
        if path != file:
            return read(path, *args, **options)
        file.write_text("5.00")
        content = read(file)
        file.write_text("2.0")
        os.utime(file, (1, 1))
        return content

    monkeypatch.setattr(Path, "read_text", exchanged)

    def flow():
        return {"x": toy.times_file(toy.source(values=(3.0,))[0], files=(FileRef(file, digest_file(file)),))}

    failure = run_flow(flow, store, scene="toy").values["x"]
    assert "factor.txt, which has changed since the run started" in str(failure.error)


def written_meanwhile(file, contents, digests=digest_file):
    """Digests of a file into which someone else writes each of these contents just after it was read."""
    left = iter(contents)

    def slow(path):
        digest = digests(path)
        if (content := next(left, None)) is not None:
            file.write_text(content)
            os.utime(file, (len(content), len(content)))
        return digest

    return slow


def test_a_file_that_changes_while_it_is_digested_is_digested_again(tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")
    ref = FileRef.of(file, written_meanwhile(file, ["2.00", "5.0"]))
    assert ref.digest == digest_file(file) and not ref.has_changed()
    with pytest.raises(InputError, match=r"factor.txt changes while it is read; run again when it is complete\."):
        FileRef.of(file, written_meanwhile(file, ["6.00", "7.0", "8.00"]))


def test_what_was_read_of_a_file_that_changed_meanwhile_is_not_remembered(tmp_path, monkeypatch):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")
    os.utime(file, (1, 1))
    digests = FileDigests(tmp_path / "files.json")
    with monkeypatch.context() as patched:
        patched.setattr(file_digests, "digest_file", written_meanwhile(file, ["5.00"], lambda path: "of both"))
        digests(file)
    file.write_text("2.0")
    os.utime(file, (1, 1))
    assert digests(file) == digest_file(file)


def test_a_file_that_was_only_touched_is_read_again_and_found_to_be_the_same(store, tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("2.0")

    def flow():
        ref = FileRef(file, digest_file(file))
        os.utime(file, (1, 1))
        return {"x": toy.times_file(toy.source(values=(3.0,))[0], files=(ref,))}

    assert run_flow(flow, store, scene="toy").failures == []


def test_a_store_that_vanishes_ends_the_run_with_one_sentence(store):
    import shutil

    class Vanish(Reporter):
        def event(self, kind, **details):
            if kind == "finished":
                shutil.rmtree(store.root, ignore_errors=True)

    with pytest.raises(StoreFailure, match="it has vanished"):
        run(store, reporter=Vanish())


def test_a_store_on_a_path_with_spaces_and_unicode_works_on_every_executor(tmp_path):
    store = Store(tmp_path / "ein Örtchen für 数据")
    values = [run(store, executor=executor).values for executor in ("processes", "threads")]
    assert values[0] == values[1]


def test_tasks_never_declare_more_memory_together_than_the_run_may_use(store):
    running, most = set(), []

    class Watch(Reporter):
        def event(self, kind, **details):
            if kind == "started" and "hungry" in details["step"]:
                running.add(details["label"])
                most.append(len(running))
            elif kind == "finished":
                running.discard(details["label"])

    def build():
        return {"all": each(toy.source(values=tuple(map(float, range(4)))), build=toy.hungry)}

    run(store, build, memory_mb=1500, jobs=4, reporter=Watch())
    assert max(most) == 1
    with pytest.raises(InputError, match="needs 1000 MB of memory, but the run may use 500 MB"):
        raise run(Store(store.root.parent / "b"), build, memory_mb=500).failures[0].error


def test_a_task_whose_process_was_killed_is_tried_once_more_alone(store, tmp_path):
    told = []

    class Watch(Reporter):
        def event(self, kind, **details):
            if kind in ("retried", "failed"):
                told.append((kind, details.get("because", details.get("error"))))

    marker = str(tmp_path / "marker")
    report = run(store, one(lambda x: toy.killed_once(x, marker=marker)), reporter=Watch())
    assert computed(report) == ["ss_flow_toy.killed_once", "ss_flow_toy.source"]
    assert told == [
        ("retried", "WorkerDied: the process of ss_flow_toy.killed_once was killed, as happens when memory runs out")
    ]
    told.clear()
    run(store, one(toy.killed), reporter=Watch())
    assert [kind for kind, _ in told] == ["retried", "failed"]
    assert all("memory runs out" in because for _, because in told)


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_a_task_whose_memory_ran_out_knows_its_last_try(store, executor):
    report = run(store, one(toy.makes_do), executor=executor)
    assert computed(report) == ["ss_flow_toy.makes_do", "ss_flow_toy.source"]


def test_a_killed_process_is_not_waited_for_until_a_child_that_its_task_forked_ends(store, tmp_path):
    child = tmp_path / "child"
    report = run(store, one(lambda x: toy.killed_beside_its_child(x, child_file=str(child))))
    assert computed(report) == ["ss_flow_toy.killed_beside_its_child", "ss_flow_toy.source"]
    left = psutil.Process(int(child.read_text()))
    assert left.status() != psutil.STATUS_ZOMBIE
    left.kill()


AFTER_A_FORK = """
import os, sys, threading
sys.path.insert(0, {support!r})
import ss_flow_toy as toy
from ss_flow import execute
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
run_flow(toy.flow, Store({store!r}), scene="toy")
end, held = os.pipe()
execute._peaks._lock.acquire()
if os.fork():
    os._exit(0)
os.close(held)
os.read(end, 1)  # until the parent has gone
report = run_flow(lambda: toy.flow(values=(5.0, 6.0)), Store({store!r}), scene="toy")
print(report.failures, any(thread.name == "peak-memory" for thread in threading.enumerate()), flush=True)
"""


def test_a_forked_process_runs_flows_when_its_parent_has_gone(store):
    program = AFTER_A_FORK.format(support=str(Path(toy.__file__).parent), store=str(store.root))
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (ran.stdout, ran.stderr) == ("[] True\n", "")


PROGRAM = """
import sys
{before}
sys.path.insert(0, {support!r})
import ss_flow_toy as toy
from pathlib import Path
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
x = lambda: toy.source(values=(2.0,))[0]
run_flow(lambda: {{"out": {call}}}, Store(Path({store!r})), scene="toy", executor={executor!r})
"""


def start(store, call, executor="threads", before=""):
    support = str(Path(toy.__file__).parent)
    text = PROGRAM.format(support=support, call=call, store=str(store.root), executor=executor, before=before)
    return subprocess.Popen([sys.executable, "-c", text], stderr=subprocess.PIPE, text=True)


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def claims(store):
    return [path.name for path in (store.root / "claims").iterdir()]


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_the_first_interrupt_lets_a_task_keep_what_it_has_and_leaves_neither_process_nor_claim(
    store, tmp_path, executor
):
    process = start(store, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid')!r})", executor)
    wait_for(lambda: list(store.root.glob("checkpoints/*.npz")))
    worker = int((tmp_path / "pid").read_text())
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert error.strip().endswith("KeyboardInterrupt")
    assert not psutil.pid_exists(worker)
    assert claims(store) == []
    assert len(list(store.root.glob("checkpoints/*.npz"))) == 1
    events = [event["event"] for event in next(latest_runs(store.root / "roots" / "runs")).events()]
    assert events[-2:] == ["stopping", "run ended"]


def test_the_second_interrupt_does_not_wait(store, tmp_path):
    process = start(store, f"toy.deaf(x(), pid_file={str(tmp_path / 'pid')!r})")
    wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    worker = int((tmp_path / "pid").read_text())
    process.send_signal(signal.SIGINT)
    time.sleep(1)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=10)
    wait_for(lambda: not psutil.pid_exists(worker))
    assert claims(store) == []


def test_a_killed_run_leaves_no_worker_behind(store, tmp_path):
    process = start(store, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid')!r})")
    wait_for(lambda: list(store.root.glob("checkpoints/*.npz")))
    worker = int((tmp_path / "pid").read_text())
    process.kill()
    process.communicate()
    wait_for(lambda: not psutil.pid_exists(worker))


def test_a_run_goes_on_where_a_killed_one_was(store, tmp_path):
    process = start(store, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid')!r})")
    wait_for(lambda: list(store.root.glob("checkpoints/*.npz")))
    process.kill()
    process.communicate()
    assert claims(store)
    report = run(store, lambda: {"source": toy.source(values=(2.0,))})
    assert computed(report) == []
    second = start(store, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid2')!r})")
    wait_for(lambda: (tmp_path / "pid2").exists())  # the claim of the dead holds nobody up
    second.kill()
    second.communicate()


CLAIMS_EXPIRE_AT_ONCE = """
import ss_flow.cache.claims as claims
claims.EXPIRY_SECONDS, claims._lives = 0.0, lambda pid, started: False
"""


@pytest.mark.parametrize("before", ["", CLAIMS_EXPIRE_AT_ONCE], ids=["claims hold", "claims expire"])
def test_several_processes_at_once_share_the_work_of_one_flow(store, before):
    many = "toy.total(toy.each(toy.source(values=tuple(map(float, range(40)))), build=toy.nap))"
    several = [start(store, many, before=before) for _ in range(4)]
    assert [process.communicate()[1] for process in several] == [""] * 4
    finished = [
        event["key"]
        for found in latest_runs(store.root / "roots" / "runs")
        for event in found.events()
        if event["event"] == "finished"
    ]
    assert len(set(finished)) == 42
    if not before:
        assert len(finished) == 42
    assert claims(store) == os.listdir(store.root / "tmp") == []


def test_two_threads_may_run_flows_at_once_on_one_store(store):
    reports = []
    threads = [threading.Thread(target=lambda: reports.append(run(store))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({json.dumps(report.values) for report in reports}) == 1
    assert sum(len(computed(report)) for report in reports) == 8


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_the_event_log_names_the_store_when_the_disk_is_full(store):
    log = Record(Path("/dev/full"), store.root)
    with pytest.raises(StoreFailure, match=f"store {store.root} cannot be written: No space left"):
        log.event("started", label="x")
