"""Evaluation by published protocols, as flows of their own on the results of a run: stored, or of the same flow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.errors import InputError
from ss_flow.graph import labelled
from ss_flow.task import Reference
from ss_flow.tasks.artifacts import Metrics
from ss_flow.tasks.capture.scene_files import SceneFiles, files_in
from ss_flow.tasks.evaluate import lerf
from ss_flow.tasks.evaluate.novel_objects import ObjectViews, Removals, object_views, removals
from ss_flow.tasks.evaluate.points import TruePoints, evaluate_gaussians, evaluate_points, lifted
from ss_flow.tasks.evaluate.replica import replica_truth
from ss_flow.tasks.evaluate.scannet import scannet_truth
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.colour_words import colours_in
from ss_flow.tasks.semantics.query import QueryParams, Similarity, chosen, similarity

Nodes = Mapping[str, Any]
"""The results of a run by name, as nodes of a flow."""


def on_points(nodes: Nodes, truth: TruePoints, *, radius: float = 0.0, compat: bool = False) -> dict[str, Metrics]:
    """Score what a run came to after Split and after Splat on annotated points."""
    return {
        "split": after_split(nodes, truth, radius=radius, compat=compat),
        "splat": after_splat(nodes, truth, radius=radius, compat=compat),
    }


def after_split(nodes: Nodes, truth: TruePoints, *, radius: float = 0.0, compat: bool = False) -> Metrics:
    """Score the labelled points (Split&Splat, P_labeled)."""
    with labelled("split"):
        return evaluate_points(
            nodes["dense"],
            nodes["cut"],
            nodes["reproject"],
            truth,
            transfer_radius=radius,
            compat_gap_bug=compat,
        )


def after_splat(nodes: Nodes, truth: TruePoints, *, radius: float = 0.0, compat: bool = False) -> Metrics:
    """Score the Gaussians of the finished scene."""
    with labelled("splat"):
        return evaluate_gaussians(
            nodes["scene"], nodes["reproject"], truth, transfer_radius=radius, compat_gap_bug=compat
        )


def lifted_truth(nodes: Nodes) -> TruePoints:
    """The capture's own annotated views, carried to the dense points. Raises InputError when it has none."""
    if "truth" not in nodes:
        raise InputError("the capture has no annotated views; name the ground truth of a scan with --truth.")
    return lifted(nodes["dense"], nodes["visibility"], nodes["truth"])


def scan_truth(folder: Path, reference: Reference, *, compat: bool = False) -> TruePoints:
    """The ground truth of a ScanNet or Replica scene folder.

    compat: of ScanNet, take the aggregation of the finer mesh, as the published scripts do. Raises InputError when a
    file is missing.
    """
    semantic = next((p for p in (folder / "habitat", folder) if (p / "mesh_semantic.ply").is_file()), None)
    if semantic is not None:
        if compat:
            raise InputError(f"{semantic} is Replica's, and --compat is for ScanNet's annotation; leave it out.")
        info = semantic / "info_semantic.json"
        if not info.is_file():
            raise InputError(f"{semantic} has no info_semantic.json, which says what the objects of Replica are.")
        return replica_truth(mesh=reference(semantic / "mesh_semantic.ply"), info=reference(info))
    name = folder.resolve().name
    official, finer = folder / f"{name}.aggregation.json", folder / f"{name}_vh_clean.aggregation.json"
    chosen_file, other = (finer, official) if compat else (official, finer)
    mesh, labels = folder / f"{name}_vh_clean_2.ply", folder / f"{name}_vh_clean_2.labels.ply"
    segments = folder / f"{name}_vh_clean_2.0.010000.segs.json"
    for file in (mesh, segments, chosen_file):
        if not file.is_file():
            raise InputError(
                f"{folder} has no {file.name}; a scene folder of ScanNet or Replica with its annotation is needed."
            )
    return scannet_truth(
        mesh=reference(mesh),
        segments=reference(segments),
        aggregation=reference(chosen_file),
        other=reference(other) if other.is_file() else None,
        labels=reference(labels) if labels.is_file() else None,
    )


def on_objects(nodes: Nodes, perception: Model | None) -> dict[str, ObjectViews | Removals]:
    """Renderings object by object: of the views that were kept back, where these are annotated, or else of those that
    were trained on.

    perception: the network of LPIPS. Raises InputError when no views are annotated.
    """
    kept_back = "truth_held_out" in nodes
    if not kept_back and "truth" not in nodes:
        raise InputError("the capture has no annotated views; without them no object is known to measure.")
    end = "_held_out" if kept_back else ""
    return {
        "views": object_views(
            nodes[f"ingest{end}"],
            nodes[f"cameras{end}"],
            nodes["scene"],
            nodes[f"truth{end}"],
            perception=perception,
        ),
        "removals": removals(nodes["cameras"], nodes["scene"], nodes["masks"]),
    }


@dataclass(frozen=True)
class LabelledScene:
    """Label files of a scene in LERF-OVS's format, and how things are looked for in it."""

    labels: lerf.Labels
    texts: Mapping[str, str]
    """What is asked for each category, of those that the encoder can be asked for."""
    unread: tuple[str, ...]
    """The others, which score 0: without a network only colours are understood."""
    encoder: Model | None
    query: QueryParams

    @classmethod
    def of(
        cls,
        folder: Path,
        scene: SceneFiles,
        reference: Reference,
        *,
        encoder: Model | None,
        query: QueryParams,
        texts: Mapping[str, str] | None = None,
    ) -> LabelledScene:
        """The label files of a folder, each named like its view.

        texts: of the categories that are asked for in other words than their own.
        Raises InputError when the folder holds none, one is damaged, or no category can be asked for.
        """
        files = files_in(folder, frozenset({".json"}))
        if not files:
            raise InputError(f"{folder} holds no label files; a folder of NAME.json in LERF-OVS's format is needed.")
        polygons = [polygon for file in files for polygon in lerf.read_label(file).polygons]
        categories = sorted({category for category, _ in polygons})
        photos, lenses = (scene.names, scene.lenses) if scene.lenses else ((), ())
        labels = lerf.Labels(tuple(file.stem for file in files), tuple(map(reference, files)), photos, lenses)
        asked = {category: (texts or {}).get(category, category) for category in categories}
        read = {category: text for category, text in asked.items() if encoder is not None or colours_in(text)}
        if not read:
            raise InputError(
                f"none of the categories of {folder} names a colour, and without a text-image network only colours are "
                "understood; get one (`ss-flow models list`), or say with --texts what to ask for."
            )
        return cls(labels, read, tuple(category for category in categories if category not in read), encoder, query)


def labels_of(scene: SceneFiles) -> Path:
    """Where the labels of a scene lie: label/ in its folder, or label/NAME beside it, as in LERF-OVS. Raises InputError
    when they lie in neither."""
    root = scene.root.resolve()
    places = (root / "label", root.parent / "label" / root.name)
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        raise InputError(f"{scene.root} has no labels in label/; name their folder with --truth.")
    return found


def lerf_strict(nodes: Nodes, scene: LabelledScene) -> dict[str, Metrics]:
    """What the texts select, by the strict protocol."""
    answers = tuple(chosen(found, params=scene.query) for found in _found(nodes, scene))
    return {
        "splat": lerf.strict(
            nodes["ingest"],
            nodes["cameras"],
            nodes["scene"],
            answers,
            labels=scene.labels,
            categories=tuple(scene.texts),
        )
    }


def lerf_oracle(nodes: Nodes, scene: LabelledScene) -> dict[str, Metrics]:
    """What ground truth chooses among the candidates, by the protocol of the paper's authors."""
    found = _found(nodes, scene)
    rules: dict[str, Any] = {"labels": scene.labels, "categories": tuple(scene.texts), "tau_corr": scene.query.tau_corr}
    metrics = {}
    for stage, maps in (("split", "masks_split"), ("splat", "masks")):
        with labelled(stage):
            metrics[stage] = lerf.oracle(nodes["ingest"], nodes["cameras"], nodes[maps], found, **rules)
    return metrics


def lerf_2d(nodes: Nodes, scene: LabelledScene) -> dict[str, Metrics]:
    """LangSplat's protocol on rendered features."""
    return {
        "splat": lerf.langsplat_2d(
            nodes["ingest"],
            nodes["cameras"],
            nodes["scene"],
            nodes["describe"],
            labels=scene.labels,
            texts=tuple(scene.texts.items()),
            encoder=scene.encoder,
        )
    }


def _found(nodes: Nodes, scene: LabelledScene) -> tuple[Similarity, ...]:
    """How well the text of each category fits each instance."""
    return tuple(
        similarity(
            nodes["describe"],
            text=text,
            prompt=scene.query.prompt,
            encoder=scene.encoder,
            tau_view=scene.query.tau_view,
        )
        for text in scene.texts.values()
    )


LERF = {"lerf-strict": lerf_strict, "lerf-oracle": lerf_oracle, "lerf-2d": lerf_2d}
"""The three protocols on labelled frames by name."""
