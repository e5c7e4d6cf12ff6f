"""What each rule gives that Split has beyond the paper: generated captures without it, one rule at a time.

    python tests/bench/bench_rules.py room:0,1 desk:0,1 kitchen:0 ... [--without STEP.PARAM=VALUE ...]
                                      [--preset fast] [--store DIR] [--jobs 2]

A capture is a kind of `bench_composite.py` (a room, sensor, desk, kitchen, walk, ...) and its seeds; `photos` is a walk
from its photos alone. A line for each rule, by the setting that undoes it: whole (the share of things that are exactly
one instance), mIoU, PQ in per cent, mean over the captures, predicted ids in all, and the captures in which a thing
more or less is whole without the rule, or mIoU differs by more than a point. Only what a rule changes is computed anew.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from bench_composite import capture_of, outcome

from ss_flow.cache.store import Store
from ss_flow.flows import settings
from ss_flow.flows.params import Params
from ss_flow.tasks.evaluate.instances import evaluate_masks

RULES = (
    "split.overlooked.rise=0",
    "split.visibility.deviations=0",
    "split.observe.nested=true",
    "split.propagate.views=in_turn",
    "split.propagate.smoothing=0",
    "split.propagate.touching_merge=false",
    "split.propagate.tau_piece=1",
    "split.propagate.min_label_views=1",
    "split.hierarchy.doubt=1",
    "split.hierarchy.silent=1",
    "split.hierarchy.prior_agreement=0",
    "split.hierarchy.stuff.planes=1",
    "split.hierarchy.shadows.agreement=0",
    "split.hierarchy.shadows.colors=1",
    "split.hierarchy.shadows.gap=0",
    "split.hierarchy.alone=0",
    "split.hierarchy.contact=0",
    "split.hierarchy.apart=0",
    "split.hierarchy.convex=0",
    "split.hierarchy.inlaid=0",
    "split.hierarchy.around=1",
    "split.boards.rises=0",
    "split.walls.colors=0",
    "split.reproject.min_agreement=0",
    "split.reproject.selection.masks=all",
    "split.reproject.draw_missing=false",
    "split.granularity=1",
)
"""What undoes each."""
COLUMNS = ("whole", "miou", "pq", "num_predicted")


def table_of(capture: tuple[str, int], without: Sequence[str], preset: str, place: Path) -> np.ndarray:
    """[1 + rules, COLUMNS] of a capture, by its kind and seed: with all rules, then without each."""
    kind, seed = capture
    folder = capture_of("walk" if kind == "photos" else kind, seed, place)
    rows, known = [], {}
    for undone in ([], *([setting] for setting in without)):
        params = settings.apply(settings.preset(Params(), preset), undone)
        found = outcome(folder, params, Store(place), kind == "photos")
        masks = b"".join(view.ids.tobytes() for view in found.predicted)
        if masks not in known:
            values = evaluate_masks(found.predicted, found.truth, None, found.frames).values
            known[masks] = [values[column] for column in COLUMNS]
        rows.append(known[masks])
    print(kind, seed, "done", file=sys.stderr, flush=True)
    return np.array(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+")
    parser.add_argument("--without", nargs="+", default=RULES, help="what undoes each rule")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--store", type=Path, help="a store to keep")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    named = [capture.split(":") for capture in args.captures]
    captures = [(kind, int(seed)) for kind, seeds in named for seed in seeds.split(",")]
    with nullcontext(args.store) if args.store else tempfile.TemporaryDirectory() as kept:
        work = partial(table_of, without=args.without, preset=args.preset, place=Path(kept))
        with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
            tables = np.array(list(pool.map(work, captures)))  # [captures, 1 + rules, COLUMNS]
    print("| without | whole | mIoU | PQ | ids | captures that change: whole, mIoU |\n|---|---|---|---|---|---|")
    for row, rule in enumerate(("", *args.without)):
        whole, miou, pq, _ = 100 * tables[:, row].mean(axis=0)
        change = 100 * (tables[:, row] - tables[:, 0])[:, :2]
        changed = [
            f"{kind} {seed} {change[i, 0]:+.0f}, {change[i, 1]:+.1f}"
            for i, (kind, seed) in enumerate(captures)
            if change[i, 0] or abs(change[i, 1]) > 1
        ]
        ids = int(tables[:, row, 3].sum())
        print(f"| {rule and f'`{rule}`'} | {whole:.1f} | {miou:.1f} | {pq:.1f} | {ids} | {'; '.join(changed)} |")


if __name__ == "__main__":
    main()
