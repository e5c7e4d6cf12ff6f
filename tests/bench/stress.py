"""The demo under fire: killed at random moments, run by eight processes at once, on failing disks and damaged stores.

    python tests/bench/stress.py kill [--kills 50] [--executor threads]
    python tests/bench/stress.py race [--processes 8] [--expire]
    python tests/bench/stress.py faults

Each compares the digests of all results with those of an undisturbed run, and ends with an error where they differ.
The first run of each makes what is compared with.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from ss_flow.cache.store import Store
from ss_flow.runs import latest_runs

ENTRY = "from ss_flow.flows.cli.main import entry; entry()"
SHORT = [
    "--set=merge.global_iterations=100",
    "--set=reconstruct.min_iterations=60",
    "--set=reconstruct.max_iterations=80",
]

EXPIRE = """
import ss_flow.cache.claims as claims
claims.EXPIRY_SECONDS, claims.HEARTBEAT_SECONDS = 0.0, 1000.0
claims._lives = lambda pid, started: False
"""
"""Every claim of another process looks stale at once."""

FULL_DISK = """
import random
from ss_flow.cache import codec
write, chance = codec.write, random.Random({seed})
def sometimes_full(value, folder):
    if chance.random() < 0.01:
        raise OSError(28, "No space left on device")
    write(value, folder)
codec.write = sometimes_full
"""

FAILING = """
import functools
from ss_flow.tasks.splat import reconstruct as module
inner = module.reconstruct.function
@functools.wraps(inner)
def failing(views, instance, **options):
    if instance.instance_id % 10 == 3:
        raise RuntimeError("injected")
    return inner(views, instance, **options)
module.reconstruct.function = failing
"""


def command(folder: Path, store: Path, *more: str, before: str = "") -> list[str]:
    """A demo; its scene is made once and shared."""
    out = ["--out", str(folder), "--cache", str(store), "--json", "--masks", "truth"]
    return [sys.executable, "-c", before + ENTRY, "demo", *out, *SHORT, *more]


def results(output: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(output)["results"]
    return found


def run(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, capture_output=True, text=True)


def undisturbed(work: Path) -> dict[str, Any]:
    begun = time.monotonic()
    done = run(command(work / "quiet", work / "quiet-store"))
    assert done.returncode == 0, done.stderr
    print(f"undisturbed run: {time.monotonic() - begun:.1f} s")
    return results(done.stdout)


def finished(store: Path) -> Counter[str]:
    """How often each key was computed, over all runs."""
    return Counter(
        event["key"]
        for run in latest_runs(store / "roots" / "runs")
        for event in run.events()
        if event["event"] == "finished"
    )


def left_over(store: Path) -> dict[str, int]:
    return {name: len(os.listdir(store / name)) for name in ("tmp", "claims")}


def kill(work: Path, kills: int, executor: str) -> None:
    expected = undisturbed(work)
    store, chance, killed = work / "store", random.Random(0), 0
    more = ["--executor", executor]
    shutil.copytree(work / "quiet" / "scene", work / "killed" / "scene")
    while killed < kills:
        process = subprocess.Popen(
            command(work / "killed", store, *more),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            process.wait(chance.uniform(0.5, 5.0))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            killed += 1
        else:  # it came to its end: begin anew, so that every moment of a run is met
            assert process.returncode == 0, process.stderr and process.stderr.read()
            assert max(finished(store).values()) == 1
            shutil.rmtree(store)
        process.communicate()
    last = run(command(work / "killed", store, *more))
    assert last.returncode == 0, last.stderr
    twice = [key for key, times in finished(store).items() if times > 1]
    same = results(last.stdout) == expected
    print(f"{executor}: {killed} kills; digests equal: {same}; keys computed twice: {len(twice)}")
    for path in (store / "tmp").iterdir():  # as if an hour had passed
        os.utime(path, (0, 0))
    before = left_over(store)
    run(command(work / "killed", store, *more))
    print(f"left behind {before}; after the next run, with what was left an hour old: {left_over(store)}")
    orphans = run(["pgrep", "-fc", "ss_flow.executors.worker"]).stdout.strip()
    print(f"worker processes left: {orphans}")
    assert same
    assert not twice


def race(work: Path, processes: int, expire: bool) -> None:
    expected = undisturbed(work)
    store = work / "store"
    begun = time.monotonic()
    several = []
    for number in range(processes):
        shutil.copytree(work / "quiet" / "scene", work / str(number) / "scene")
        several.append(
            subprocess.Popen(
                command(work / str(number), store, before=EXPIRE if expire else ""),
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    outputs = [process.communicate() for process in several]
    assert all(process.returncode == 0 for process in several), [error for _, error in outputs]
    same = all(results(output) == expected for output, _ in outputs)
    times = finished(store)
    print(
        f"{processes} processes at once in {time.monotonic() - begun:.1f} s; digests equal: {same}; "
        f"{len(times)} keys, computed {sum(times.values())} times; left behind {left_over(store)}"
    )
    assert same
    assert expire or max(times.values()) == 1


def faults(work: Path) -> None:
    expected = undisturbed(work)
    store = work / "store"
    shutil.copytree(work / "quiet" / "scene", work / "faulty" / "scene")
    refused = 0
    for seed in range(60):
        done = run(command(work / "faulty", store, before=FULL_DISK.format(seed=seed)))
        if done.returncode == 0:
            break
        refused += 1
        assert "No space left on device" in done.stderr and done.stderr.count("\n") <= 8, done.stderr
    print(f"disk full at 1 % of writes: {refused} runs refused, then digests equal: {results(done.stdout) == expected}")
    assert results(done.stdout) == expected

    chance = random.Random(0)
    objects = [entry.name for entry in Store(store).objects()]
    for name in chance.sample(objects, max(1, len(objects) // 100)):
        flip(Store(store), name, chance)
    options = ["--set=merge.global_iterations=101"]
    again = run(command(work / "faulty", store, *options))
    fresh = run(command(work / "faulty", work / "fresh-store", *options))
    same = results(again.stdout) == results(fresh.stdout)
    print(f"1 % of {len(objects)} objects damaged, then another parameter: digests equal a fresh store's: {same}")
    assert same

    failed = run(command(work / "failing", work / "failing-store", before=FAILING))
    document = json.loads(failed.stdout)
    told = sorted(failure["label"] for failure in document["failures"])
    print(f"a tenth of the instances failing: exit code {failed.returncode}, {document['status']}, told of {told}")
    assert (failed.returncode, document["status"]) == (3, "degraded")
    assert told and all("reconstruct" in label for label in told)


def flip(store: Store, name: str, chance: random.Random) -> None:
    """Flip one bit somewhere in the values of an object."""
    chunks = [path for path in store.object_path(name).glob("*/c*") if path.is_file()]
    chunks += [path for path in store.object_path(name).glob("*/c/**/*") if path.is_file()]
    file = chance.choice(chunks or [store.object_path(name) / "zarr.json"])
    content = bytearray(file.read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    file.write_bytes(content)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["kill", "race", "faults"])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--executor", default="threads")
    parser.add_argument("--processes", type=int, default=8)
    parser.add_argument("--expire", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        if options.what == "kill":
            kill(work, options.kills, options.executor)
        elif options.what == "race":
            race(work, options.processes, options.expire)
        else:
            faults(work)


if __name__ == "__main__":
    main()
