"""instances.json: what each instance is called, where it is, and which file holds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ss_flow.tasks.artifacts import Float32, Gaussians, Hierarchy, InstanceMasks
from ss_flow.tasks.deliver.palette import instance_color
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.semantics.name import InstanceNames
from ss_flow.tasks.splat.collisions import group_box

_FAINT = 0.15
"""Opacity below which a Gaussian does not widen a box: strays far off all points are hardly to be seen."""
_CRUMB = 0.001
"""Share of the views that show an instance which it must fill not to be a crumb."""
DOUBTFUL = 0.1
"""Confidence below which lists put a thing last: of twenty such, one is right."""


def instances_document(
    instances: Sequence[InstanceMasks], gaussians: Gaussians, names: InstanceNames, tree: Hierarchy
) -> dict[str, Any]:
    """The content of instances.json, ready for `json.dumps`.

    instances: after Split or refinement; the background (id 0) is left out. gaussians: the whole scene; the box of an
    instance without any is that of its points. names: where they know nothing, an instance is "object 7" by its id.
    tree: what the instances are parts of, and which are stuff.

    Each instance has: id, name, named_by (the encoder, "hints" for a name of the user's own, or null), kind ("thing" or
    "stuff"), color [r, g, b], parent (the smallest group that holds it, or null), parts (part_id, num_points, bbox and
    centroid of each), bbox {min, max} and centroid in world units (see `gaussians_placed`; null without points and
    Gaussians), views (names),
    confidence, num_parts, num_points, num_gaussians, weak, crumb (weak, or it hardly fills anything of the views that
    show it), and file ("instances/0007.ply", null for a crumb and without Gaussians). Names are unique: of several
    "red object" the later ones, by id, are "red object 2" and so on; the user's own stay. The groups follow: id,
    parent, agreement (share of the views which show it as one thing), instances (ids).
    """
    known = sorted((i for i in instances if i.instance_id != 0), key=lambda i: i.instance_id)
    called = _unique_names([i.instance_id for i in known], names)
    rows_of = rows_by_label(gaussians.instance_id)
    stuff = set(tree.node[tree.stuff].tolist())
    parents = {int(node): int(parent) for node, parent in zip(tree.node, tree.parent, strict=True) if parent}
    entries = []
    for instance in known:
        rows = rows_of.get(instance.instance_id, np.zeros(0, np.intp))
        crumb = is_crumb(instance)
        entry = {
            "id": instance.instance_id,
            "name": called[instance.instance_id],
            "named_by": _named_by(instance.instance_id, names),
            "kind": "stuff" if instance.instance_id in stuff else "thing",
            "color": list(instance_color(instance.instance_id)),
            "parent": parents.get(instance.instance_id),
            "parts": _parts(instance),
            **(gaussians_placed(select(gaussians, rows)) if len(rows) else placed(instance.points)),
            "views": list(instance.views),
            "confidence": round(float(instance.confidence), 4),
            "num_parts": int(instance.point_part.max(initial=0)),
            "num_points": len(instance.points),
            "num_gaussians": len(rows),
            "weak": bool(instance.weak),
            "crumb": crumb,
            "file": instance_file(instance.instance_id) if len(rows) and not crumb else None,
        }
        entries.append(entry)
    return {
        "version": 1,
        "background_id": 0,
        "num_crumbs": sum(entry["crumb"] for entry in entries),
        "instances": entries,
        "groups": _groups([entry["id"] for entry in entries], tree, parents),
    }


def is_doubtful(entry: Mapping[str, Any]) -> bool:
    """Whether an instance of the document is no crumb, but hardly a whole thing; walls and floors are none anyway."""
    return bool(entry["kind"] == "thing" and not entry["crumb"] and entry["confidence"] < DOUBTFUL)


def instance_file(instance_id: int) -> str:
    """Where an instance's own PLY lies in the output folder: "instances/0007.ply"."""
    return f"instances/{instance_id:04d}.ply"


def _groups(ids: Sequence[int], tree: Hierarchy, parents: dict[int, int]) -> list[dict[str, Any]]:
    """What the instances are parts of, the smallest groups first."""
    members: dict[int, list[int]] = {}
    for instance_id in ids:
        above = parents.get(instance_id)
        while above is not None:
            members.setdefault(above, []).append(instance_id)
            above = parents.get(above)
    return [
        {
            "id": int(node),
            "parent": parents.get(int(node)),
            "agreement": round(float(share), 4),
            "instances": members[int(node)],
        }
        for node, share in zip(tree.node, tree.agreement, strict=True)
        if int(node) in members
    ]


def _parts(instance: InstanceMasks) -> list[dict[str, Any]]:
    found = []
    for part in range(1, int(instance.point_part.max(initial=0)) + 1):
        own = instance.points[instance.point_part == part]
        found.append({"part_id": part, "num_points": len(own), **placed(own)})
    return found


def is_crumb(instance: InstanceMasks) -> bool:
    """Whether an instance is weak, or hardly fills anything of the views that show it."""
    return instance.weak or int(instance.areas().sum()) < _CRUMB * int(instance.sizes.prod(axis=1).sum())


def _named_by(instance_id: int, names: InstanceNames) -> str | None:
    if instance_id not in names.instance_id:
        return None
    return "hints" if instance_id in names.given else names.encoder


def _unique_names(ids: Sequence[int], names: InstanceNames) -> dict[int, str]:
    words = dict(zip(names.instance_id.tolist(), names.names, strict=True))
    own = set(names.given.tolist())
    called: dict[int, str] = {}
    taken: set[str] = set()
    for instance_id in sorted(ids, key=lambda i: i not in own):  # what the user said stays as it was said
        word = words.get(instance_id, "object")
        name = f"object {instance_id}" if word == "object" else word
        number = 1
        while name in taken:
            number += 1
            name = f"{word} {number}"
        taken.add(name)
        called[instance_id] = name
    return called


def placed(points: Float32) -> dict[str, Any]:
    """The box and the mean of points [N, 3] as instances.json gives them; null without points."""
    if not len(points):
        return {"bbox": None, "centroid": None}
    return _placed(points.min(axis=0), points.max(axis=0), points)


def gaussians_placed(gaussians: Gaussians) -> dict[str, Any]:
    """The same of at least one Gaussian: the mean of all centres, and the box of those that can be seen, of an opacity
    of at least 0.15; of all where none has."""
    low, high = group_box(gaussians, min_opacity=_FAINT, quantile=0.0)
    return _placed(low, high, gaussians.means)


def _placed(low: np.ndarray, high: np.ndarray, centers: Float32) -> dict[str, Any]:
    corners = {"min": _rounded(low), "max": _rounded(high)}
    return {"bbox": corners, "centroid": _rounded(centers.mean(axis=0, dtype=np.float64))}


def _rounded(point: np.ndarray) -> list[float]:
    return [round(float(x), 6) for x in point]
