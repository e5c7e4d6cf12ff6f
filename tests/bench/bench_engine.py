"""What the engine costs: seconds a node beside a minimal loop and other tools, growth to 100,000 nodes, bytes a second.

    python tests/bench/bench_engine.py [--nodes 1000] [--scale 1000 10000 50000] [--views 2000] [--instances 100]

A flow of trivial tasks fans out over N numbers and in again. The yardstick is the least that can be done: a loop with
blake3 keys, an SQLite table and NPY files. joblib, Hamilton, redun and doit are measured where they are installed
(`pip install joblib apache-hamilton redun doit`). Medians of five runs (of the other tools: one run) in folders of
their own; the load of the machine stands beside them. What a run costs that finds everything is measured once more in
processor time, in turns with the loop, as neighbours on the machine change both.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import importlib.util
import io
import logging
import os
import shutil
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from blake3 import blake3

sys.path.insert(0, str(Path(__file__).parent))

ROUNDS = 5
TURNS = 40


def loop(folder: Path, count: int) -> None:
    """The least: a key is the digest of a name, a parameter and the digests of inputs; a result is an NPY file."""
    table = sqlite3.connect(folder / "index.sqlite")
    table.execute("create table if not exists results (key text primary key, digest text)")

    def cached(name: str, parameter: float, inputs: list[str], compute: Callable[..., np.ndarray]) -> str:
        key = blake3(f"{name} {parameter} {' '.join(inputs)}".encode()).hexdigest()
        row = table.execute("select digest from results where key = ?", (key,)).fetchone()
        if row is None:
            value = compute(*(np.load(folder / f"{digest}.npy") for digest in inputs))
            row = (blake3(value.tobytes()).hexdigest(),)
            np.save(folder / f"{row[0]}.npy", value)
            table.execute("insert into results values (?, ?)", (key, row[0]))
            table.commit()
        return str(row[0])

    source = [cached("source", float(i), [], lambda i=i: np.array([float(i)])) for i in range(count)]
    steps = [cached("step", 2.0, [digest], lambda x: 2.0 * x) for digest in source]
    cached("total", 0.0, steps, lambda *xs: np.array([sum(float(x[0]) for x in xs)]))


def ours(folder: Path, count: int) -> None:
    import ss_flow_bench_tasks as tasks

    from ss_flow.cache.store import Store
    from ss_flow.engine import run_flow

    report = run_flow(lambda: tasks.flow(count), Store(folder), scene="bench")
    assert not report.failures


def with_joblib(folder: Path, count: int) -> None:
    import joblib
    import peer_tasks

    memory = joblib.Memory(folder, verbose=0)
    source, step, total = (memory.cache(f) for f in (peer_tasks.source, peer_tasks.step, peer_tasks.total))
    total([step(source(i), 2.0) for i in range(count)])


def with_hamilton(folder: Path, count: int) -> None:
    import peer_hamilton
    from hamilton import driver

    built = driver.Builder().with_modules(peer_hamilton).enable_dynamic_execution(allow_experimental_mode=True)
    built.with_cache(path=str(folder)).build().execute(["total"], inputs={"count": count})


def with_redun(folder: Path, count: int) -> None:
    import peer_redun
    from redun import Scheduler
    from redun.config import Config

    scheduler = Scheduler(config=Config({"backend": {"db_uri": f"sqlite:///{folder}/redun.db"}}))
    scheduler.load(migrate=True)
    scheduler.run(peer_redun.main(count))


def with_doit(folder: Path, count: int) -> None:
    import peer_doit
    from doit.cmd_base import ModuleTaskLoader
    from doit.doit_cmd import DoitMain

    namespace = peer_doit.tasks(folder, count)
    code = DoitMain(ModuleTaskLoader(namespace)).run(["run", "--verbosity", "0"])
    assert code == 0


PEERS = {"joblib": with_joblib, "hamilton": with_hamilton, "redun": with_redun, "doit": with_doit}


def quietly(run: Callable[[Path, int], None], folder: Path, count: int) -> float:
    logging.disable(logging.WARNING)
    gc.collect()  # what earlier runs left is not this one's
    begun = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        run(folder, count)
    return time.perf_counter() - begun


def measure(run: Callable[[Path, int], None], count: int, rounds: int) -> tuple[float, float]:
    """Median seconds of a cold and of a warm run."""
    cold, warm = [], []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as name:
            cold.append(quietly(run, Path(name), count))
            warm.append(quietly(run, Path(name), count))
    return statistics.median(cold), statistics.median(warm)


def overhead(count: int) -> None:
    nodes = 2 * count + 1
    print(f"overhead, {nodes} results of trivial tasks; load {os.getloadavg()[0]:.1f}")
    print(f"{'':10} {'cold ms a node':>15} {'x loop':>7} {'warm ms a node':>15} {'x loop':>7}")
    least: tuple[float, float] | None = None
    for name, run in {"loop": loop, "ss-flow": ours, **PEERS}.items():
        if name in PEERS and importlib.util.find_spec(name) is None:
            print(f"{name:10} not installed")
            continue
        cold, warm = measure(run, count, ROUNDS if name not in PEERS else 1)
        least = least or (cold, warm)
        per_node = (cold / nodes * 1e3, warm / nodes * 1e3)
        print(f"{name:10} {per_node[0]:15.3f} {cold / least[0]:7.2f} {per_node[1]:15.4f} {warm / least[1]:7.2f}")


def all_there(count: int) -> None:
    """A run that finds everything beside the loop that does: in turns, so that both see the same machine."""
    with tempfile.TemporaryDirectory() as least, tempfile.TemporaryDirectory() as own:
        pairs = []
        for _ in range(TURNS + 2):
            pair = []
            for run, folder in ((loop, least), (ours, own)):
                gc.collect()
                begun = time.process_time()
                run(Path(folder), count)
                pair.append(time.process_time() - begun)
            pairs.append(pair)
    of_loop, of_ours = (statistics.median(pair[which] for pair in pairs[2:]) for which in (0, 1))
    ratio = statistics.median(pair[1] / pair[0] for pair in pairs[2:])
    micro = 1e6 / (2 * count + 1)
    print(
        f"all there, medians of {TURNS} turns, processor time: loop {micro * of_loop:.1f} us a result, ss-flow "
        f"{micro * of_ours:.1f}, {ratio:.2f} times; load {os.getloadavg()[0]:.1f}"
    )


def scale(counts: list[int]) -> None:
    print(f"growth; load {os.getloadavg()[0]:.1f}")
    print(f"{'nodes':>8} {'cold ms a node':>15} {'warm ms a node':>15} {'warm peak MB':>13}")
    for count in counts:
        with tempfile.TemporaryDirectory() as name:
            cold = quietly(ours, Path(name), count)
            program = [sys.executable, __file__, "--once", name, str(count)]
            warm, peak = map(float, subprocess.run(program, check=True, capture_output=True, text=True).stdout.split())
        nodes = 2 * count + 1
        print(f"{nodes:8} {cold / nodes * 1e3:15.3f} {warm / nodes * 1e3:15.4f} {peak:13.0f}")


def once(folder: Path, count: int) -> None:
    with tempfile.TemporaryDirectory() as elsewhere:
        ours(Path(elsewhere), 1)  # imports
    warm = quietly(ours, folder, count)
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    print(warm, int(status["VmHWM"].split()[0]) / 1024)


def long_lists(views: int, instances: int) -> None:
    """Instances that each take three lists of all views: processor seconds of a run, and the size of its records."""
    import ss_flow_bench_tasks as tasks

    from ss_flow.cache.store import Store
    from ss_flow.engine import run_flow

    def seconds(folder: Path) -> float:
        begun = time.process_time()
        report = run_flow(lambda: tasks.views_by_instances(views, instances), Store(folder), scene="bench")
        assert not report.failures
        return time.process_time() - begun

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        first, again = seconds(folder), statistics.median(seconds(folder) for _ in range(ROUNDS))
        records = [r for r in folder.glob("actions/*/*.json") if b'"step":"bench.instance"' in r.read_bytes()]
        sizes = [record.stat().st_size for record in records]
        everything = sum(r.stat().st_size for kind in ("actions", "parts") for r in folder.glob(f"{kind}/**/*.json"))
        for record in records:
            record.unlink()
        alone = seconds(folder)
    print(f"{views} views, {len(records)} instances that take three lists of them; load {os.getloadavg()[0]:.1f}")
    print(f"first run {first:.2f} s of processor time, the instances alone {alone:.2f}, all there {again:.2f}")
    print(f"record of an instance {statistics.mean(sizes) / 1e3:.1f} kB, all records {everything / 1e6:.2f} MB")


def throughput() -> None:
    import zarr
    from zarr.codecs import BloscCodec

    from ss_flow.cache.canonical import digest
    from ss_flow.cache.file_digests import FileDigests
    from ss_flow.cache.store import Store
    from ss_flow.tasks.artifacts import LabelMap

    generator = np.random.default_rng(0)
    y, x = np.mgrid[:512, :1024].astype(np.float32)
    depth = np.stack(
        [
            2 + np.sin(x / 100 + i / 10) + np.cos(y / 80) + generator.normal(0, 0.002, x.shape).round(3)
            for i in range(256)
        ]
    ).astype(np.float32)
    value = LabelMap("depth", depth)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def write_zarr() -> None:
            shutil.rmtree(folder / "plain", ignore_errors=True)
            compressor = BloscCodec(cname="lz4", clevel=5, shuffle="shuffle")
            stored = zarr.create_array(
                folder / "plain", shape=depth.shape, dtype=depth.dtype, chunks=(2, 512, 1024), compressors=compressor
            )
            stored[...] = depth

        def write_ours() -> None:
            shutil.rmtree(folder / "store", ignore_errors=True)
            Store(folder / "store").put(value)

        def median(run: Callable[[], object]) -> float:
            times = []
            for _ in range(ROUNDS):
                begun = time.perf_counter()
                run()
                times.append(time.perf_counter() - begun)
            return statistics.median(times)

        name_of_ours = digest(value)
        pairs = {
            "write": (write_zarr, write_ours),
            "read": (
                lambda: np.asarray(zarr.open_array(folder / "plain", mode="r")[...]),
                lambda: Store(folder / "store").get(name_of_ours),
            ),
            "digest": (lambda: blake3(depth.reshape(-1).view(np.uint8).data).hexdigest(), lambda: digest(value)),
        }
        print(f"{depth.nbytes >> 20} MiB of depth; load {os.getloadavg()[0]:.1f}")
        for what, (plain, own) in pairs.items():
            base, seconds = median(plain), median(own)
            print(f"{what:7} {base:6.3f} s plain, {seconds:6.3f} s ours: {base / seconds:5.2f} of its speed")
        photos = [folder / f"{i}.jpg" for i in range(200)]
        for photo in photos:
            photo.write_bytes(generator.bytes(1_000_000))
        first = FileDigests(folder / "files.json")
        for photo in photos:
            first(photo)
        first.save()

        def again() -> None:
            digests = FileDigests(folder / "files.json")
            for photo in photos:
                digests(photo)

        print(f"200 unchanged photos of 1 MB, digests looked up: {1e3 * median(again):.2f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=1000)
    parser.add_argument("--scale", type=int, nargs="*", default=[1000, 10_000, 50_000])
    parser.add_argument("--views", type=int, default=2000)
    parser.add_argument("--instances", type=int, default=100)
    parser.add_argument("--once", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.once:
        once(Path(options.once[0]), int(options.once[1]))
        return
    all_there(options.nodes)
    overhead(options.nodes)
    long_lists(options.views, options.instances)
    throughput()
    scale(options.scale)


if __name__ == "__main__":
    main()
