"""What close-ups of every photo add to the masks of single views, by the size of things, and what they cost.

    python tests/bench/bench_close_ups.py CAPTURE [--labels PATH] [--preset default] [--views 8] [--models DIR]

CAPTURE has labels: its `instance` folder, or as `bench_masks.py` takes them. For each range of a thing's share of its
photo: how many things in how many views, then of the masks of the whole photo, and of these and close-ups, the mean of
the best IoU with each thing, and the share of things that a mask has with an IoU of .5 and more, in per cent. Then CPU
seconds a view of one thread.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from pathlib import Path

import numpy as np
from bench_masks import best_iou
from bench_segment import first_segmenter, load

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from outlines import read_outlines

from ss_flow.flows import settings
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.split.close_ups import CloseUpParams, close_ups
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.segment import segment

BOUNDS = (0.0, 0.001, 0.003, 0.01, 0.03, 1.0)
"""Of a thing's share of its photo."""


def line(title: str, found: Float64) -> str:
    """found: [N, 2] best IoU without and with close-ups."""
    best, half = 100 * found.mean(axis=0), 100 * (found >= 0.5).mean(axis=0)
    cells = [title, str(len(found)), f"{best[0]:.1f}", f"{best[1]:.1f}", f"{half[0]:.0f}", f"{half[1]:.0f}"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--views", type=int, default=8, help="so many that have labels, evenly spread")
    parser.add_argument("--models", type=Path, help="a folder of models; by default SS_FLOW_MODELS")
    args = parser.parse_args()
    model = first_segmenter(args.models)
    if model is None:
        parser.error("no segmenter is here; see `ss-flow models list`")
    outlines = read_outlines(args.labels or args.capture / "instance")
    segmenting = settings.preset(Params(), args.preset).split.segment
    frames = {frame.name: frame for frame in load(args.capture, 0)}
    labelled = [n for n, frame in frames.items() if outlines.at_size(n, frame.height, frame.width) is not None]
    chosen = labelled[:: max(1, len(labelled) // args.views)][: args.views]
    rows, seconds = [], np.zeros(2)
    for name in chosen:
        frame = frames[name]
        begun = time.process_time()
        whole = segment(frame, embed(frame, model=model), params=segmenting, model=model)
        between = time.process_time()
        both = close_ups(frame, whole, params=CloseUpParams(crowded=0), segmenting=segmenting, model=model)
        seconds += between - begun, time.process_time() - between
        truth = outlines.at_size(name, frame.height, frame.width)
        for thing in np.unique(truth[truth > 0]).tolist():
            shown = truth == thing
            rows.append((shown.mean(), best_iou(whole, shown), best_iou(both, shown)))
    table = np.array(rows)
    print(
        "| share of the photo | things | best IoU | with close-ups | IoU >= .5 | with close-ups |\n" + "|---" * 6 + "|"
    )
    for low, high in itertools.pairwise(BOUNDS):
        inside = (table[:, 0] >= low) & (table[:, 0] < high)
        if inside.any():
            print(line(f"{100 * low:g} to {100 * high:g} %", table[inside, 1:]))
    print(line("all", table[:, 1:]))
    whole_photo, rest = seconds / len(chosen)
    print(f"\n{len(chosen)} views of {args.capture.name}, {model.name}, {args.preset}; load {os.getloadavg()[0]:.1f}")
    print(f"CPU seconds a view: {whole_photo:.1f}, and {rest:.1f} for close-ups")


if __name__ == "__main__":
    main()
