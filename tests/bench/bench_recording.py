"""Which views of a long recording with poses and depth are enough? By how far its camera moves against every n-th.

    python tests/bench/bench_recording.py [--walks room:4] [--frames 600] [--width 320] [--preset fast] [--store DIR]
                                          [--views max_views=300 stride=5 ...]

The walks are those of bench_video.py, by so many frames, as an RGB-D recording: each frame with its pose and its depth.
Of each choice of views (parameters of `capture`), a run from an empty store; columns as there.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from bench_video import row_of, walk

from ss_flow.cache.store import Store
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.generated.room import write_views
from ss_flow.flows.params import Params
from ss_flow.tasks.capture.scene import open_scene


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", nargs="+", default=["room:4"])
    parser.add_argument("--views", nargs="+", default=["max_views=300", "stride=5"])
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--store", type=Path, help="a folder to keep what is made")
    args = parser.parse_args()
    print("| walk | views | number | whole, mIoU | held out, dB | CPU s | s |\n" + "|---" * 7 + "|")
    with tempfile.TemporaryDirectory() as temporary:
        place = args.store or Path(temporary)
        for name in args.walks:
            of, folder = walk(name, args.frames, args.width), place / name.replace(":", "-")
            write_views(of.seen, folder)
            write_views(of.between, folder / "held_out")
            for choice in args.views:
                texts = [*(f"capture.{one}" for one in choice.split(",")), *args.set]
                params: Any = settings.apply(settings.preset(Params(), args.preset), texts)
                store = Store(place / f"store-{folder.name}-{choice}")
                scene = prepare(open_scene(folder), params, RunOptions(), file_digests(store)).scene
                print(row_of(of, choice, [int(name) for name in scene.names], folder, params, store), flush=True)


if __name__ == "__main__":
    main()
