"""Seconds and memory of a whole run on many frames: a generated room with a depth sensor, from an empty store.

    python tests/bench/bench_many.py [--frames 100 200 400] [--objects 50] [--width 640] [--preset fast] [OPTION ...]

Printed for each number of frames: seconds by the clock, CPU seconds, the peak of memory, instances that were found, and
how large the store has become. Further options go to `ss-flow run`. Masks come from the segmenter that is found, see
`ss-flow models list`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from ss_flow.cache.files import folder_bytes
from ss_flow.flows.generated import RoomParams, generate, write_scene

RUN = [sys.executable, "-P", "-c", "from ss_flow.flows.cli.main import entry; entry()", "run"]


def measured(command: list[str]) -> tuple[float, float, float]:
    """Seconds by the clock, CPU seconds, and the peak of memory in GB, sampled; all of the process and its children."""
    begin, peak, spent = time.monotonic(), 0, 0.0
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    family = psutil.Process(process.pid)
    while process.poll() is None:
        try:
            everyone = [family, *family.children(recursive=True)]
            peak = max(peak, sum(one.memory_info().rss for one in everyone))
            spent = max(spent, sum(sum(one.cpu_times()[:4]) for one in everyone))
        except psutil.NoSuchProcess:
            pass
        time.sleep(0.5)
    if process.returncode:
        sys.exit(process.returncode)
    return time.monotonic() - begin, spent, peak / 1e9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 200, 400])
    parser.add_argument("--objects", type=int, default=50)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--preset", default="fast")
    args, further = parser.parse_known_args()
    for frames in args.frames:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            room = RoomParams(args.objects, frames, args.width, args.width * 3 // 4, seed=3, held_out=0)
            write_scene(generate(room), folder / "room", masks=None)
            options = [
                "--preset",
                args.preset,
                "--cache",
                str(folder / "store"),
                "--out",
                str(folder / "out"),
                *further,
            ]
            seconds, spent, peak = measured([*RUN, str(folder / "room"), *options])
            found = len(json.loads((folder / "out/instances.json").read_text())["instances"])
            store = folder_bytes(folder / "store") / 1e9
        print(f"{frames} frames: {seconds:.0f} s, {spent:.0f} CPU s, {peak:.2f} GB,", end=" ")
        print(f"{found} instances, store {store:.2f} GB", flush=True)


if __name__ == "__main__":
    main()
