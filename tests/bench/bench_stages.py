"""Where Split loses an object, stage by stage: from what the segmenter could show to the masks of the instances.

    python tests/bench/bench_stages.py CAPTURE [--labels PATH] [--preset default] [--set STEP.PARAM=VALUE]
                                       [--store DIR] [--every N] [--ask]

Prints for each object of the labels (as bench_masks.py takes them) the best IoU, in per cent

- asked (with --ask): of the segmenter's answer to a box round the object and five points on it, both placed by the
  labels: what it can show at all;
- raw: of a mask that the segmenter found by itself in the view;
- leaves: of any union of the labels of `split.propagate`, the leaves of the tree: what perfect grouping would give;
- tree: of a single node of the tree, whatever its agreement;
- cut: of an instance;
- Split: of an instance's mask in the view;

the agreement of that node (1 for a leaf), which the cut compares with `split.granularity`, and, over the labelled views
of the object together, its best IoU after Split, how many ids cover more than a tenth of it, whether it is whole (IoU
of at least 0.5, one such id), and which other objects that id holds most of. Asked, raw and Split are
means over the labelled views, every N-th of them. Leaves, tree and cut are of dense points, whose true object is what
most labelled views show them on; they tell about grouping, and are not to be compared with the others digit by digit.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_masks import best_iou

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from outlines import read_outlines

from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import Bool, Float64, Frame, Hierarchy, Int32, LabelMap, MaskSet, PointLabels, Visibility
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.evaluate.contingency import contingency
from ss_flow.tasks.evaluate.panoptic import pieces, whole
from ss_flow.tasks.geometry.images import decode_rgb
from ss_flow.tasks.geometry.sampling import greedy_farthest
from ss_flow.tasks.masks.overlap import iou
from ss_flow.tasks.models.catalogue import available, find
from ss_flow.tasks.models.sam import Sam

POINTS = 5
"""Points that ask for an object, besides the box."""
CORNERS = (2, 3)
"""How the segmenter knows the corners of a box."""


@dataclass(frozen=True)
class Outcome:
    """What Split made of a capture, the views one by one."""

    ingest: list[Frame]
    segment: list[MaskSet]
    visibility: list[Visibility]
    masks_split: list[LabelMap]
    propagate: PointLabels
    hierarchy: Hierarchy
    cut: PointLabels


def outcome(folder: Path, params: Params, store: Store) -> Outcome:
    """Run Split on a capture and read what came of it."""
    prepared = prepare(open_scene(folder), params, RunOptions(), file_digests(store))
    stages = Outcome.__dataclass_fields__

    def build() -> dict[str, object]:
        results = prepared.build()
        return {stage: results[stage] for stage in stages}

    values = run_flow(build, store, scene=prepared.name, header={}).values
    read = {name: store.get(v) if isinstance(v, str) else [store.get(one) for one in v] for name, v in values.items()}
    return Outcome(**read)


def asked(sam: Sam, frame: Frame, objects: list[Bool]) -> Iterator[float]:
    """IoU of each object with the segmenter's best answer to a box round it and points on it."""
    image = sam.image(sam.encode(decode_rgb(frame)), few=True)
    for mask in objects:
        y, x = np.nonzero(mask)
        places = np.stack([x, y], axis=1)[:: max(1, len(x) // 2000)] + 0.5
        chosen = places[greedy_farthest(places, POINTS, alpha=0.3, drop_hull=True)]
        box = np.array([[x.min(), y.min()], [x.max() + 1, y.max() + 1]])
        prompt = np.concatenate([box, chosen])
        answer, _ = image.predict_prompt(prompt, np.array([*CORNERS, *[1] * len(chosen)], np.int32))
        yield iou(answer, mask)


def true_objects(found: Outcome, truths: list[Int32 | None]) -> Int32:
    """[N] the object that most labelled views show each dense point on; 0 = none of them, -1 = no labelled view."""
    count = 1 + max(int(t.max()) for t in truths if t is not None)
    votes = np.zeros((len(found.propagate.label), count), np.int32)
    for view, truth in zip(found.visibility, truths, strict=True):
        if truth is not None:
            np.add.at(votes, (view.point_index, truth.ravel()[view.pixel]), 1)
    return np.where(votes.any(axis=1), votes.argmax(axis=1), -1).astype(np.int32)


def grouping(found: Outcome, true: Int32) -> dict[int, list[float]]:
    """For each object: IoU of the best union of leaves, of the best node, of the best instance, in points; and the
    agreement of that node."""
    known = true >= 0
    leaf, instance = found.propagate.label[known], found.cut.label[known]
    nodes, rows = found.hierarchy.node, found.hierarchy.row_of()
    under = np.zeros((len(nodes), int(leaf.max()) + 1), bool)
    for label in np.unique(leaf[leaf > 0]).tolist():
        node = label
        while node:
            under[rows[node], label] = True
            node = int(found.hierarchy.parent[rows[node]])
    size, of_instance = np.bincount(leaf), np.bincount(instance)
    table = {}
    for name in np.unique(true[true > 0]).tolist():
        mine = true[known] == name
        held = np.bincount(leaf[mine], minlength=len(size))
        in_instance = np.bincount(instance[mine], minlength=len(of_instance))
        held[0] = in_instance[0] = 0
        # The union with the highest IoU is that of the purest leaves, down to one of them.
        purest = np.argsort(-held / np.maximum(size, 1), kind="stable")[: np.count_nonzero(held)]
        unions = np.cumsum(held[purest]) / (mine.sum() + np.cumsum((size - held)[purest]))
        in_node, of_node = under @ held, under @ size
        by_node: Float64 = in_node / (mine.sum() + of_node - in_node)
        by_instance = in_instance / (mine.sum() + of_instance - in_instance)
        best = int(by_node.argmax())
        table[name] = [
            unions.max(initial=0),
            by_node[best],
            by_instance[1:].max(initial=0),
            found.hierarchy.agreement[best],
        ]
    return table


def instances(found: Outcome, truths: list[Int32 | None]) -> dict[int, tuple[float, int, bool, list[int]]]:
    """For each object, of all pixels of the views that show it: the best IoU of an instance, how many cover more than a
    tenth of it, whether it is whole, and the other objects that the best instance holds more than half of."""
    table = {}
    for name in sorted({i for truth in truths if truth is not None for i in np.unique(truth[truth > 0]).tolist()}):
        views = [
            (t, m.ids) for t, m in zip(truths, found.masks_split, strict=True) if t is not None and (t == name).any()
        ]
        counts = contingency(*(np.concatenate([pair[side].ravel() for pair in views]) for side in (0, 1)))
        counts = counts.without(truth=0, predicted=0)
        row = counts.truth_ids.tolist().index(name)
        best = int(counts.iou[row].argmax())
        held = counts.intersection[:, best] > counts.truth_area / 2
        others = [int(i) for i in counts.truth_ids[held] if i != name]
        table[name] = float(counts.iou[row, best]), int(pieces(counts)[row]), bool(whole(counts)[row]), others
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--store", type=Path, help="a store to keep")
    parser.add_argument("--every", type=int, default=1, help="count every N-th labelled view")
    parser.add_argument("--ask", action="store_true", help="ask the segmenter for the labels' objects, too")
    args = parser.parse_args()
    outlines = read_outlines(args.labels or args.capture / "instance")
    params = settings.apply(settings.preset(Params(), args.preset), args.set)
    with tempfile.TemporaryDirectory() as temporary:
        found = outcome(args.capture, params, Store(args.store or Path(temporary)))
    truths = [outlines.at_size(frame.name, frame.height, frame.width) for frame in found.ingest]
    labelled = [row for row, truth in enumerate(truths) if truth is not None][:: args.every]
    kept = [truth if row in labelled else None for row, truth in enumerate(truths)]
    model = find(available("segmenter")[0].name) if args.ask else None
    sam = Sam(model) if model is not None else None
    by_view: dict[int, list[list[float]]] = {}
    for row in labelled:
        truth = truths[row]
        assert truth is not None
        names = np.unique(truth[truth > 0]).tolist()
        objects = [truth == name for name in names]
        answers = list(asked(sam, found.ingest[row], objects)) if sam is not None else [np.nan] * len(names)
        for name, mask, answer in zip(names, objects, answers, strict=True):
            pool, split = best_iou(found.segment[row], mask), best_iou(found.masks_split[row], mask)
            by_view.setdefault(name, []).append([answer, pool, split])
    columns = "object | views | asked | raw | leaves | tree | cut | Split | agreement | all views | ids | whole | with"
    print(f"| {columns} |\n" + "|---" * (columns.count("|") + 1) + "|")
    grouped, taken = grouping(found, true_objects(found, truths)), instances(found, kept)
    nothing = [0.0, 0.0, 0.0, 0.0]  # no dense point lies on it
    for name, (pooled, ids, one, others) in taken.items():
        leaves, node, instance, agreement = grouped.get(name, nothing)
        answer, raw, split = 100 * np.mean(by_view[name], axis=0)
        cells = [answer, raw, 100 * leaves, 100 * node, 100 * instance, split]
        print(
            f"| {outlines.names[name]} | {len(by_view[name])} | {' | '.join(f'{cell:.1f}' for cell in cells)} "
            f"| {agreement:.2f} | {100 * pooled:.1f} | {ids} | {'whole' if one else ''} "
            f"| {', '.join(outlines.names[other] for other in others)} |"
        )
    share = 100 * np.mean([one for _, _, one, _ in taken.values()])
    mean = 100 * np.mean([pooled for pooled, _, _, _ in taken.values()])
    print(f"\nOf {len(taken)} objects {share:.1f} % whole, mean IoU over all views {mean:.1f}")


if __name__ == "__main__":
    main()
