"""Whether the confidence of an instance says how likely it is right, on generated captures with a segmenter's masks.

    python tests/bench/bench_confidence.py room:0,1 desk:0 kitchen:0,1 ... [--preset fast] [--set STEP.PARAM=VALUE ...]
                                           [--store DIR] [--fit]

SS_FLOW_MODELS names the folder of the segmenter's weights; without it, masks follow surfaces and colours. Captures are
those of bench_composite.py by kind (`sensor`: rooms with a depth camera's depth; `crowded`: 100 small things) and
seeds; `fast@room:0` names a preset besides. What is looked at are the instances that lists show, things and no crumbs;
*right* are those with an IoU of at least one half with a thing, in the pixels of all views. For each capture: how many
there are, how many are right, the mean confidence, and ScanNet's AP at .5 on pixels. Then, for all: those with
confidences between 0 and .1 and so on, with the mean confidence and the share that is right; the expected calibration
error (ECE), which is the mean difference of the two; the AUC, which is the chance that of a right and a wrong one the
right one has the higher confidence; and the risk, which is the share that is wrong of the surest 20, 40, ... per cent,
and its mean over all shares (AURC). With --fit, the weights of the evidence by a logistic regression on all these
captures, and ECE and AUC where each kind is judged by weights fitted to all others.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_composite import capture_of
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import rankdata

from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import Bool, Float64, InstanceMasks
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.deliver.instances_json import is_crumb
from ss_flow.tasks.evaluate.instances import pooled
from ss_flow.tasks.evaluate.scannet_ap import scannet_ap
from ss_flow.tasks.split.confidence import evidence, pieces

STEPS = "ingest", "reproject", "hierarchy", "masks_split", "truth"
BINS = 10


@dataclass(frozen=True)
class Judged:
    """The instances of a capture that lists show."""

    kind: str
    told: Float64
    """[N, 4] their evidence."""
    confidence: Float64
    """[N]."""
    right: Bool
    """[N]."""
    ap50: float


def judged(kind: str, folder: Path, params: Params, store: Store) -> Judged:
    """Run Split on a capture, and compare its instances with the true ones."""
    prepared = prepare(open_scene(folder), params, RunOptions(), file_digests(store))

    def build() -> dict[str, Any]:
        results = prepared.build()
        return {name: results[name] for name in STEPS}

    found: dict[str, Any] = run_flow(build, store, scene=prepared.name, header={}).values
    frames, predicted, truth = (tuple(map(store.get, found[name])) for name in ("ingest", "masks_split", "truth"))
    tree = store.get(found["hierarchy"])
    instances: list[InstanceMasks] = [store.get(key) for key in found["reproject"]]

    table = pooled(predicted, truth, frames).without(predicted=0)
    table = replace(table, truth_ids=np.where(table.truth_ids == 0, -1, table.truth_ids))
    ap50 = scannet_ap(table, {one.instance_id: one.confidence for one in instances}, 0.5)
    best = dict(zip(table.predicted_ids.tolist(), table.iou[table.truth_ids > 0].max(axis=0, initial=0), strict=True))
    stuff, of_more = set(tree.node[tree.stuff].tolist()), pieces(tree)
    listed = [i for i in instances if i.instance_id and i.instance_id not in stuff and not is_crumb(i)]
    return Judged(
        kind,
        np.array([evidence(i, i.origin, piece=i.instance_id in of_more) for i in listed]).reshape(-1, 4),
        np.array([i.confidence for i in listed]),
        np.array([best.get(i.instance_id, 0) >= 0.5 for i in listed], bool),
        ap50,
    )


def bin_of(confidence: Float64) -> NDArray[np.intp]:
    """[N] which of the bins each falls in."""
    return np.minimum((confidence * BINS).astype(np.intp), BINS - 1)


def calibration_error(confidence: Float64, right: Bool) -> float:
    """The mean difference of confidence and share that is right, over the bins."""
    return float(np.abs(np.bincount(bin_of(confidence), confidence - right)).sum() / len(right))


def auc(confidence: Float64, right: Bool) -> float:
    """The chance that a right one has the higher confidence."""
    ranks, count = rankdata(confidence)[right].sum(), int(right.sum())
    return float((ranks - count * (count + 1) / 2) / max(1, count * (len(right) - count)))


def bins(confidence: Float64, right: Bool) -> Iterator[str]:
    """A line for each bin that is not empty."""
    place = bin_of(confidence)
    for low in np.unique(place):
        own = place == low
        yield f"| {low / BINS:.1f} | {own.sum()} | {confidence[own].mean():.2f} | {right[own].mean():.2f} |"


def risks(confidence: Float64, right: Bool) -> Float64:
    """[N] the share that is wrong of the surest 1, 2, ... N."""
    wrong = ~right[np.argsort(-confidence, kind="stable")]
    return np.asarray(np.cumsum(wrong) / np.arange(1, len(wrong) + 1))


def fitted(told: Float64, right: Bool) -> Float64:
    """[5] the weights of the evidence, and the constant, of the greatest likelihood, each shrunk a little."""
    rows = np.column_stack([told, np.ones(len(told))])
    sign = np.where(right, 1, -1)
    scale = np.append(told.std(axis=0), 0)

    def loss(weights: Float64) -> float:
        return float(np.logaddexp(0, -sign * (rows @ weights)).sum() + 0.5 * ((scale * weights) ** 2).sum())

    return np.asarray(minimize(loss, np.zeros(rows.shape[1])).x)


def fit(all_of: Sequence[Judged]) -> None:
    """Print the weights, and what they are worth on kinds that they were not fitted to."""
    told, right = np.concatenate([one.told for one in all_of]), np.concatenate([one.right for one in all_of])
    kind = np.concatenate([[one.kind] * len(one.right) for one in all_of])
    found = np.zeros(len(right))
    for left_out in np.unique(kind):
        own = kind == left_out
        weights = fitted(told[~own], right[~own])
        found[own] = expit(told[own] @ weights[:-1] + weights[-1])
    print("\nweights and constant", np.round(fitted(told, right), 2))
    print(f"each kind by all others: ECE {calibration_error(found, right):.3f}, AUC {auc(found, right):.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", help="[PRESET@]KIND:SEED[,SEED ...]")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--store", type=Path, help="a store to keep")
    parser.add_argument("--fit", action="store_true", help="the weights, too")
    args = parser.parse_args()
    all_of = []
    with nullcontext(args.store) if args.store else tempfile.TemporaryDirectory() as kept:
        print("| capture | instances | right | mean confidence | AP50 |\n|---|---|---|---|---|")
        for capture in args.captures:
            preset, _, named = capture.rpartition("@")
            kind, _, seeds = named.partition(":")
            params = settings.apply(settings.preset(Params(), preset or args.preset), args.set)
            for seed in map(int, seeds.split(",")):
                folder = capture_of(kind, seed, Path(kept))
                one = judged(kind, folder, params, Store(Path(kept)))
                cells = f"{one.right.sum()} | {one.confidence.mean():.2f} | {100 * one.ap50:.1f}"
                print(f"| {preset or args.preset} {kind} {seed} | {len(one.right)} | {cells} |", flush=True)
                all_of.append(one)
    confidence = np.concatenate([one.confidence for one in all_of])
    right = np.concatenate([one.right for one in all_of])
    print("\n| from | instances | mean confidence | right |\n|---|---|---|---|")
    print("\n".join(bins(confidence, right)))
    risk = risks(confidence, right)
    shares = ", ".join(f"{risk[int(np.ceil(len(risk) * share)) - 1]:.2f}" for share in (0.2, 0.4, 0.6, 0.8, 1))
    print(f"\nECE {calibration_error(confidence, right):.3f}, AUC {auc(confidence, right):.3f}")
    print(f"risk of the surest 20, 40, 60, 80, 100 %: {shares}; AURC {risk.mean():.3f}")
    print(f"mean AP50 {100 * np.mean([one.ap50 for one in all_of]):.1f}")
    if args.fit:
        fit(all_of)


if __name__ == "__main__":
    main()
