"""Evaluation of a finished run against annotated points, as a flow of its own on the run's stored results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ss_flow.errors import InputError
from ss_flow.flows.results import Results
from ss_flow.graph import labelled
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Metrics
from ss_flow.tasks.evaluate.points import TruePoints, evaluate_gaussians, evaluate_points, lifted
from ss_flow.tasks.evaluate.scannet import scannet_truth

Reference = Callable[[Path], FileRef]


def on_points(results: Results, truth: TruePoints, *, radius: float, compat: bool) -> dict[str, Metrics]:
    """Score what a run came to after Split and after Splat on annotated points."""
    instances = results.node("reproject")
    rules: dict[str, Any] = {"transfer_radius": radius, "compat_gap_bug": compat}
    with labelled("split"):
        points, labels = results.node("dense"), results.node("cut")
        after_split = evaluate_points(points, labels, instances, truth, **rules)
    with labelled("splat"):
        after_splat = evaluate_gaussians(results.node("scene"), instances, truth, **rules)
    return {"split": after_split, "splat": after_splat}


def lifted_truth(results: Results) -> TruePoints:
    """The capture's own annotated views, carried to the dense points. Raises InputError when it has none."""
    if "truth" not in results.digests:
        raise InputError("the capture has no annotated views; name the ground truth of a scan with --truth.")
    dense, seen, truth = (results.node(name) for name in ("dense", "visibility", "truth"))
    return lifted(dense, seen, truth)


def scan_truth(folder: Path, reference: Reference, *, compat: bool) -> TruePoints:
    """The ground truth of a ScanNet scene folder.

    compat: take the aggregation of the finer mesh, as the published scripts do. Raises InputError when a file is
    missing.
    """
    name = folder.resolve().name
    official, finer = folder / f"{name}.aggregation.json", folder / f"{name}_vh_clean.aggregation.json"
    chosen, other = (finer, official) if compat else (official, finer)
    mesh = folder / f"{name}_vh_clean_2.ply"
    segments = folder / f"{name}_vh_clean_2.0.010000.segs.json"
    for file in (mesh, segments, chosen):
        if not file.is_file():
            raise InputError(f"{folder} has no {file.name}; a ScanNet scene folder with its annotation is needed.")
    return scannet_truth(
        mesh=reference(mesh),
        segments=reference(segments),
        aggregation=reference(chosen),
        other=reference(other) if other.is_file() else None,
    )
