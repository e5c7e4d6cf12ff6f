"""Which runs each of the paper's tables is made of, and what is measured of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ss_flow.errors import InputError
from ss_flow.flows import paper
from ss_flow.flows.evaluate import (
    LERF,
    LabelledScene,
    Nodes,
    after_splat,
    after_split,
    scan_truth,
)
from ss_flow.task import Reference
from ss_flow.tasks.artifacts import Metrics
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.evaluate.points import InstanceIoUs, TruePoints, evaluate_points, instance_ious

CLICKS = "clicks.json"
"""Points clicked on objects, in a scene's folder; under this name no other run takes them for its hints."""
_ABLATED_SCENE = "scene0062_00"

ScanMeasure = Callable[[Nodes, TruePoints], "Metrics | InstanceIoUs"]


def by_clicks_alone(nodes: Nodes, truth: TruePoints) -> Metrics:
    """Score the points as the masks that grew from clicks label them, without propagation."""
    return evaluate_points(nodes["dense"], nodes["hinted"], nodes["reproject"], truth)


def each_instance(nodes: Nodes, truth: TruePoints) -> InstanceIoUs:
    """The IoU of each true instance after Splat."""
    return instance_ious(nodes["scene"], truth)


@dataclass(frozen=True)
class Variant:
    """One row of a table: how a scene is run, and what is measured of it."""

    row: str
    """Its name in the paper; "" where the rows are scenes or instances."""
    settings: tuple[str, ...] = ()
    """Parameters that differ from the preset's."""
    measure: ScanMeasure | None = None
    """What is measured on annotated points; None where the section's protocol is one on labelled frames."""
    hints: bool = False
    """Whether masks grow from points that a user clicked."""
    subsampled: bool = True
    """Whether only every n-th frame is taken."""


@dataclass(frozen=True)
class Section:
    """One column of tables: the figures of one protocol, which stand apart from all others."""

    title: str
    protocol: str
    """A name of `evaluate.LERF`, "points after Split", or "points after Splat"."""
    variants: tuple[Variant, ...]
    of_paper: bool = True
    """Whether it is what the paper's figures were measured by."""


@dataclass(frozen=True)
class Plan:
    """What a table is made of."""

    data: Literal["scan", "labels"]
    rows: Literal["scenes", "variants", "instances"]
    sections: tuple[Section, ...]


def _values(table: str, measure: ScanMeasure | None = None) -> tuple[Variant, ...]:
    """A variant for each value of a table's parameter."""
    known = paper.tables()[table]
    return tuple(Variant(value, (f"{known.parameter}={value}",), measure) for value in known.rows)


_SPLIT, _SPLAT = "points after Split", "points after Splat"

PLANS = {
    "scannet": Plan(
        "scan",
        "scenes",
        (
            Section("after Splat", _SPLAT, (Variant("", measure=after_splat),)),
            Section("after Split", _SPLIT, (Variant("", measure=after_split),), of_paper=False),
        ),
    ),
    "lerf": Plan(
        "labels",
        "scenes",
        (
            Section("strict: by text alone", "lerf-strict", (Variant(""),), of_paper=False),
            Section("oracle: ground truth chooses among the candidates", "lerf-oracle", (Variant(""),)),
            Section("2D: rendered features", "lerf-2d", (Variant(""),), of_paper=False),
        ),
    ),
    "ablation": Plan(
        "scan",
        "variants",
        (
            Section(
                "after Splat",
                _SPLAT,
                (
                    Variant("baseline", measure=after_splat),
                    Variant("without subsampling", measure=after_splat, subsampled=False),
                    # No view has so many Gaussians that it would be looked at.
                    Variant("without mask refinement", ("splat.refine.min_visible=1000000000",), after_splat),
                    Variant("hints, with propagation", measure=after_splat, hints=True),
                ),
            ),
            Section(
                "after Split",
                _SPLIT,
                (
                    Variant("baseline", measure=after_split),
                    Variant("hints, without propagation", measure=by_clicks_alone, hints=True),
                    Variant("hints, with propagation", measure=after_split, hints=True),
                ),
                of_paper=False,
            ),
        ),
    ),
    "tau_depth": Plan("scan", "variants", (Section("after Split", _SPLIT, _values("tau_depth", after_split)),)),
    "background": Plan("labels", "variants", (Section("oracle", "lerf-oracle", _values("background")),)),
    "tau_corr": Plan("labels", "variants", (Section("oracle", "lerf-oracle", _values("tau_corr")),)),
    "instances": Plan("scan", "instances", (Section("after Splat", _SPLAT, (Variant("", measure=each_instance),)),)),
}
"""By the name of the table in paper.toml."""


def scenes_of(data: Path, kind: Literal["scan", "labels"], *, one: bool) -> list[Path]:
    """The scenes of a data set's folder that have what a table needs: an annotated mesh, or label files.

    one: whether the table is of the paper's one scene; it alone is taken where it is there.
    Raises InputError when there is none.
    """
    places = [data / "scans", data] if (data / "scans").is_dir() else [data]
    folders = [p for place in places for p in sorted(place.iterdir()) if p.is_dir()] if data.is_dir() else []
    found = [folder for folder in folders if _has(folder, kind)]
    if not found:
        what = "NAME_vh_clean_2.ply and its annotation" if kind == "scan" else "label/NAME.json, in it or beside it"
        raise InputError(f"{data} holds no scene with {what}.")
    known = [folder for folder in found if folder.name == _ABLATED_SCENE]
    return known if one and known else found


def _has(folder: Path, kind: str) -> bool:
    if kind == "scan":
        return (folder / f"{folder.name}_vh_clean_2.ply").is_file()
    own, beside = folder / "label", folder.parent / "label" / folder.name
    return own.is_dir() or (beside.is_dir() and folder.name != "label")


def opened(folder: Path, variant: Variant) -> SceneFiles:
    """A scene as a variant runs it. Raises InputError when it has not been clicked into and the variant needs that."""
    if not variant.hints:
        return open_scene(folder)
    if not (folder / CLICKS).is_file():
        raise InputError(f"{folder} has no {CLICKS}, the points that hint-based masks grow from.")
    return open_scene(folder, hints=folder / CLICKS)


def measured(
    nodes: Mapping[str, Any],
    section: Section,
    variant: Variant,
    folder: Path,
    reference: Reference,
    labelled: LabelledScene | None,
) -> Any:
    """The node of what a variant's results come to. labelled: the scene's label files, where the section is by them."""
    if labelled is not None:
        return LERF[section.protocol](nodes, labelled)["splat"]
    assert variant.measure is not None
    return variant.measure(nodes, scan_truth(folder, reference))
