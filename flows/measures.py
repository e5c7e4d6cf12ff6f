"""Figures of a result by name, such as "split.miou": those measured against ground truth, and some that need none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ss_flow.cache.store import Store
from ss_flow.flows.deliver import METRICS

_MASKS = ("miou", "macc25", "macc50", "pq", "sq", "rq", "hungarian_miou", "whole", "pq_things")
_COUNTS = ("over_segmentation", "under_segmentation", "num_truth", "num_predicted")

NAMES: dict[str, tuple[str, ...]] = {
    "propagate": ("split.labelled",),
    "reproject": ("split.instances",),
    "masks_split": ("split.covered",),
    "scene": ("splat.instances", "splat.gaussians"),
    "metrics_split": tuple(f"split.{name}" for name in _MASKS + _COUNTS),
    "metrics_refined": tuple(f"refined.{name}" for name in _MASKS + _COUNTS),
    "metrics_splat": tuple(f"splat.{name}" for name in _MASKS + _COUNTS),
    "novel_view": tuple(
        f"novel_view.{name}"
        for name in ("psnr", "ssim", "psnr_neighbour_colours", "psnr_colour_fitted", "lpips", "lpips_unscaled")
    ),
    "query": ("query.matched", "query.matched_share", "query.best"),
}
"""Which figures each step gives."""

HEADLINE = (
    "split.miou",
    "splat.miou",
    "splat.pq",
    "novel_view.psnr",
    "splat.instances",
    "splat.gaussians",
    "query.matched",
    "query.matched_share",
    "query.best",
)
"""Those that are shown when no --metric is given."""


def names_of(steps: Iterable[str]) -> list[str]:
    """The figures that a run of these steps gives."""
    return [name for step in steps for name in NAMES.get(step, ())]


def measures(store: Store, document: Mapping[str, Any]) -> dict[str, float]:
    """The figures of a run, from its document run.json.

    Fractions are 0..1. `split.labelled` is the share of the dense points that got a label; `split.instances` counts the
    instances after Split, and `split.covered` is the share of all pixels that their masks fill; `splat.instances`
    counts those with Gaussians of their own; `query.matched` the instances that the text means, `query.matched_share`
    their share of all, and `query.best` is the best score.
    """
    results = document["results"]
    found: dict[str, float] = {}
    if "propagate" in results:
        found["split.labelled"] = float((store.get(results["propagate"]).label > 0).mean())
    if "reproject" in results:
        found["split.instances"] = len(results["reproject"]) - 1  # the background comes first
    if "masks_split" in results:
        ids = [store.get(value).ids for value in results["masks_split"]]
        found["split.covered"] = sum(np.count_nonzero(one) for one in ids) / sum(one.size for one in ids)
    if "scene" in results:
        scene = store.get(results["scene"])
        found["splat.instances"] = len({*scene.instance_id.tolist()} - {0})
        found["splat.gaussians"] = len(scene)
    for group in METRICS.values():
        found |= {f"{group}.{name}": value for name, value in document["metrics"].get(group, {}).items()}
    if "query" in results:
        answer = store.get(results["query"])
        matched = len(answer.matches())
        found["query.matched"] = matched
        found["query.matched_share"] = matched / max(len(answer.instance_id), 1)
        found["query.best"] = max(answer.score.tolist(), default=-1.0)
    return found
