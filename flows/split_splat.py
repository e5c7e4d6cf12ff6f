"""The DAG of Split&Splat: a capture -> view-consistent instances -> Gaussians -> one labelled scene -> descriptors.

A scene that was trained elsewhere takes the place of the Gaussians (`flows/given.py`).
"""

from __future__ import annotations

from typing import Any

from ss_flow.flows.capture import Capture
from ss_flow.flows.given import label_given
from ss_flow.flows.params import Params
from ss_flow.flows.splat import splat
from ss_flow.flows.split import Networks, split
from ss_flow.graph import each, labelled
from ss_flow.tasks.artifacts import Cameras, DenseDescriptors, Gaussians
from ss_flow.tasks.deliver.report_pictures import report_pictures
from ss_flow.tasks.deliver.thumbnails import thumbnails
from ss_flow.tasks.evaluate.instances import evaluate_masks
from ss_flow.tasks.evaluate.novel_view import novel_view
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.semantics.dense_describe import apart, dense_describe, together
from ss_flow.tasks.semantics.name import given_names, name
from ss_flow.tasks.splat.resolve import resolve

LEADS_TO = {
    "sweep": "depth",
    "stereo": "depth",
    "agree": "depth",
    "gaps": "depth",
    "sized": "depth",
    "sensor_depth": "depth",
    "sens_depth": "depth",
    "straightened": "depth",
    "depth_scale": "depth",
    "rescaled": "depth",
    "completed": "depth",
    "exclusive": "merge",
    "retrain": "merge",
    "plan": "merge",
    "merge_pair": "merge",
    "rendered": "describe",
    "localized": "cameras_held_out",
    "without_transients": "reconstruct",
}
"""Steps of which only other results tell what nodes there are: the result that all of these lead to."""
LEADS_TO_CAMERAS = frozenset(
    {"features", "look", "match", "partners", "pose_fit", "with_lens", "refined_cameras", "better_poses"}
)
"""The same of steps that in some captures are known beforehand."""


def split_splat(capture: Capture, held_out: Capture | None, networks: Networks, params: Params) -> dict[str, Any]:
    """The whole DAG. Returns its results by name."""
    found = split(capture, networks, params.split)
    with labelled("split"):
        masks_split = resolve(capture.cameras, found.instances)
    known: dict[str, Any] = {
        "ingest": capture.frames,
        "cameras": capture.cameras,
        "registration": capture.registration,
        "depth": capture.depths,
        "checks": capture.checks,
        "colours": capture.colours or None,
        "dense": found.points,
        "visibility": found.visibility,
        "segment": found.masks,
        "propagate": found.voted,
        "hierarchy": found.tree,
        "cut": found.labels,
        "parts": found.parts,
        "reproject": found.instances,
        "masks_split": masks_split,
        "hinted": found.hinted,
        "truth": capture.truth,
    }
    results = {name: nodes for name, nodes in known.items() if nodes is not None}

    def measure(stage: str, masks: str) -> None:
        if capture.truth is not None and masks in results:
            with labelled(stage):
                results[f"metrics_{stage}"] = evaluate_masks(
                    results[masks],
                    capture.truth,
                    found.tree,
                    capture.frames,
                    zero_is_void=params.evaluate.zero_is_void is not False,
                )

    measure("split", "masks_split")
    if capture.given is None:
        results |= splat(capture, found, networks, params)
    else:
        results |= {"given_scene": capture.given} | label_given(capture, found, masks_split, networks, params)
    measure("refined", "masks_refined")
    measure("splat", "masks")
    if held_out is not None:
        results |= {"ingest_held_out": held_out.frames, "cameras_held_out": held_out.cameras}
        if held_out.truth is not None:
            results["truth_held_out"] = held_out.truth
        results["novel_view"] = novel_view(
            held_out.frames,
            held_out.cameras,
            results["scene"],
            *((capture.by_view, capture.colours) if capture.colours else ()),
            perception=networks.perception,
        )
    results["report_pictures"] = report_pictures(
        capture.frames,
        capture.cameras,
        capture.depths,
        masks_split,
        results["masks"],
        results["scene"],
        turns=capture.turns,
    )
    results["thumbnails"] = thumbnails(capture.frames, results["masks"], turns=capture.turns)
    if networks.patches is not None:
        results["dense_descriptors"] = dense_descriptors(results["scene"], capture.cameras, networks.patches, params)
    results["names"] = name(results["describe"], encoder=networks.encoder)
    if found.hinted is not None:
        results["names"] = given_names(results["names"], found.hinted, found.labels, objects=capture.objects)
    return results


def dense_descriptors(scene: Gaussians, cameras: Cameras, network: Model, params: Params) -> DenseDescriptors:
    """A vector for every Gaussian of the instances: one step an instance, as the finished scene has it."""
    described = each(
        apart(scene),
        build=lambda own: dense_describe(own, cameras, network=network, params=params.semantics.dense),
        on_error="skip",
    )
    return together(scene, described, network=network.name)
