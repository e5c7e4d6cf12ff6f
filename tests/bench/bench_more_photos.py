"""What two photos more cost: the share of Splat's nodes that are found again when a capture of fifty grows to 52.

    python tests/bench/bench_more_photos.py [--objects 20] [--views 52] [--width 192] [--left-out 20 21]

A generated room is run without two of its photos, then with them, on one store, with true masks and trainings of a few
steps: what is counted is which nodes run, not how long they take.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from ss_flow.flows.generated import RoomParams, generate, write_scene

SHORT = ("reconstruct.min_iterations=10", "reconstruct.max_iterations=10", "merge.min_iterations=2",
         "merge.max_iterations=2", "merge.global_iterations=5", "split.dense.max_points=400000")  # fmt: skip


def run(scene: Path, store: Path) -> list[dict[str, object]]:
    """The nodes of a run."""
    options = ["--out", str(scene) + "-out", "--cache", str(store), "--json", "--preset", "fast"]
    sets = [f"--set={assignment}" for assignment in SHORT]
    command = [sys.executable, "-c", "from ss_flow.flows.cli.main import entry; entry()", "run", str(scene)]
    return json.loads(subprocess.run([*command, *options, *sets], check=True, capture_output=True).stdout)["nodes"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=20)
    parser.add_argument("--views", type=int, default=52)
    parser.add_argument("--width", type=int, default=192)
    parser.add_argument("--left-out", type=int, nargs="+", default=[20, 21], help="photos that come later")
    options = parser.parse_args()
    size = {"width": options.width, "height": options.width * 3 // 4}
    room = generate(RoomParams(objects=options.objects, views=options.views, **size, held_out=0))
    with tempfile.TemporaryDirectory() as temporary:
        few, all_ = Path(temporary, "few"), Path(temporary, "all")
        for folder in (few, all_):
            write_scene(room, folder, masks="truth")
        for k in options.left_out:
            for file in few.rglob(f"{room.cameras.names[k]}.*"):
                file.unlink()
        run(few, Path(temporary, "store"))
        nodes = run(all_, Path(temporary, "store"))
    hits, total = Counter[str](), Counter[str]()
    for node in nodes:
        step = str(node["step"])
        total[step] += 1
        hits[step] += bool(node["hit"])
    splat = [step for step in total if step.startswith("splat.")]
    for step in sorted(total):
        print(f"{step:28} {hits[step]:4} of {total[step]:4} found again")
    print(f"{'all of Splat':28} {sum(hits[s] for s in splat):4} of {sum(total[s] for s in splat):4}")
    seen = [len(set(room.ids[k].ravel().tolist()) - {0}) for k in options.left_out]
    print(f"objects that the photos that came later show: {seen} of {options.objects}")


if __name__ == "__main__":
    main()
