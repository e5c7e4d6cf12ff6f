"""Whether Splat makes the masks of a capture better or worse, object by object.

    python tests/bench/bench_masks.py CAPTURE [--labels PATH] [--preset fast] [--set STEP.PARAM=VALUE] [--store DIR]
                                      [--split] [--noisy DEVIATION]

Prints, for each object of the labels, the best IoU of any mask with it, mean over the labelled views: of the view's own
masks (raw), then of the instances' after Split, after refinement, and in the end; and the most that a view loses from
Split to the end. Labels are one-channel PNG files named like the frames, 0 where nothing is said; the capture's
`instance` folder if not told otherwise. Or one JSON file of polygons: `outlines/hololens_office.json` was drawn by hand
on thirteen photos of an office, every second frame of which has all of them. --split stops after Split. With --noisy,
photos get noise of so many grey values, as JPEG of quality 90.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from altered_captures import add_noise, altered
from outlines import Outlines, read_outlines

from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import LabelMap, MaskSet
from ss_flow.tasks.capture.scene import open_scene

STAGES = ("segment", "masks_split", "masks_refined", "masks")


def masks_of(
    folder: Path, params: Params, store: Store, stages: Sequence[str] = STAGES
) -> list[list[MaskSet | LabelMap]]:
    """The masks of all views, at each stage."""
    prepared = prepare(open_scene(folder), params, RunOptions(), file_digests(store))

    def build() -> dict[str, object]:
        results = prepared.build()
        return {stage: results[stage] for stage in stages}

    values = run_flow(build, store, scene=prepared.name, header={}).values
    return [[store.get(digest) for digest in values[stage]] for stage in stages]


def best_iou(masks: MaskSet | LabelMap, truth: np.ndarray) -> float:
    """The highest IoU of a mask with an object's: [H, W]."""
    if isinstance(masks, MaskSet):
        dense = masks.dense()
    else:
        dense = np.array([masks.ids == i for i in np.unique(masks.ids[truth]) if i]).reshape(-1, *truth.shape)
    return max((float((mask & truth).sum() / (mask | truth).sum()) for mask in dense), default=0.0)


def by_object(stages: list[list[MaskSet | LabelMap]], outlines: Outlines) -> dict[int, np.ndarray]:
    """[views, stages] the best IoU of each object."""
    table = defaultdict(list)
    for maps in zip(*stages, strict=True):
        truth = outlines.at_size(maps[0].name, *maps[-1].ids.shape)
        if truth is None:
            continue
        for name in np.unique(truth[truth > 0]).tolist():
            table[name].append([best_iou(m, truth == name) for m in maps])
    return {name: np.array(rows) for name, rows in sorted(table.items())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--store", type=Path, help="a store to keep")
    parser.add_argument("--split", action="store_true", help="stop after Split")
    parser.add_argument("--noisy", type=float, help="noise that photos get, of 255 grey values")
    args = parser.parse_args()
    outlines = read_outlines(args.labels or args.capture / "instance")
    params = settings.apply(settings.preset(Params(), args.preset), args.set)
    with tempfile.TemporaryDirectory() as temporary:
        asked = STAGES[:2] if args.split else STAGES
        place, capture = args.store or Path(temporary), args.capture
        if args.noisy:
            capture = altered(capture, f"noisy-{args.noisy:g}", lambda copy: add_noise(copy, args.noisy), place)
        stages = masks_of(capture, params, Store(place), asked)
        table = by_object(stages, outlines)
    columns = ("object", "views", *("raw", "Split", "refined", "final")[: len(asked)], "worst view")
    print(f"| {' | '.join(columns)} |\n" + "|---" * len(columns) + "|")
    for name, rows in table.items():
        mean = " | ".join(f"{100 * value:.1f}" for value in rows.mean(axis=0))
        print(f"| {outlines.names[name]} | {len(rows)} | {mean} | {100 * (rows[:, -1] - rows[:, 1]).min():+.1f} |")
    means = np.mean([rows.mean(axis=0) for rows in table.values()], axis=0)
    print(f"| mean | | {' | '.join(f'{100 * value:.1f}' for value in means)} | |")


if __name__ == "__main__":
    main()
