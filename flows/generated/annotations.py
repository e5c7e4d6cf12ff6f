"""The ground truth of a generated room in the files of public data sets: ScanNet's scans and LERF-OVS's labels."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.flows.generated.room import Room

_WALL, _OTHER = 1, 40
"""NYU40's wall, and "other"."""


def write_scan(room: Room, folder: Path, name: str) -> None:
    """Write the room's points and what they belong to as ScanNet annotates a scan, into the scene's folder.

    NAME_vh_clean_2.ply (vertices, no faces), NAME_vh_clean_2.labels.ply (NYU40 classes: the structure is wall),
    NAME_vh_clean_2.0.010000.segs.json and NAME.aggregation.json, in which every object is one segment; the structure
    comes last. name: what the scene's folder is or will be called.
    """
    labels = np.where(room.point_ids == 0, _WALL, _OTHER)
    _write_vertices(folder / f"{name}_vh_clean_2.ply", room)
    _write_vertices(folder / f"{name}_vh_clean_2.labels.ply", room, labels)
    segments = {"sceneId": name, "segIndices": room.point_ids.tolist()}
    groups = [
        {"id": number, "objectId": number, "segments": [one.instance_id], "label": one.name}
        for number, one in enumerate((*room.objects, room.structure))
    ]
    (folder / f"{name}_vh_clean_2.0.010000.segs.json").write_text(json.dumps(segments), encoding="utf-8")
    aggregation = {"sceneId": name, "appId": "Aggregator.v2", "segGroups": groups}
    (folder / f"{name}.aggregation.json").write_text(json.dumps(aggregation), encoding="utf-8")


def write_labels(room: Room, folder: Path, views: Sequence[int]) -> None:
    """Write label/NAME.json of some views in LERF-OVS's format: outlines of all that is visible, by name."""
    import cv2

    (folder / "label").mkdir(exist_ok=True)
    height, width = room.ids.shape[1:]
    for view in views:
        objects: list[dict[str, Any]] = []
        for one in room.objects:
            mask = (room.ids[view] == one.instance_id).astype(np.uint8)
            outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            for outline in (o[:, 0] for o in outlines if len(o) >= 3):
                box = [*outline.min(axis=0).tolist(), *outline.max(axis=0).tolist()]
                objects.append({"category": one.name, "segmentation": outline.tolist(), "bbox": box})
        name = room.cameras.names[view]
        info = {"name": f"{name}.jpg", "width": width, "height": height}
        document = {"info": info, "objects": objects}
        (folder / "label" / f"{name}.json").write_text(json.dumps(document), encoding="utf-8")


def write_clicks(room: Room, file: Path) -> None:
    """Write hints (see `tasks.capture.hints`): a click in the middle of every object, in the three of every second view
    that show most of it."""
    import cv2

    clicks: dict[str, dict[str, list[list[float]]]] = {}
    for one in room.objects:
        masks = {view: room.ids[view] == one.instance_id for view in range(0, len(room), 2)}
        for view in sorted(masks, key=lambda view: -int(masks[view].sum()))[:3]:
            if masks[view].any():
                inside = cv2.distanceTransform(np.pad(masks[view], 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
                row, column = np.unravel_index(int(inside.argmax()), inside.shape)
                clicks.setdefault(room.cameras.names[view], {})[one.name] = [[float(column) + 0.5, float(row) + 0.5]]
    file.write_text(json.dumps(clicks, indent=1), encoding="utf-8")


def _write_vertices(path: Path, room: Room, labels: np.ndarray | None = None) -> None:
    """As ScanNet writes them: binary, float positions, uchar colours, and a ushort label in the labels' file."""
    fields: list[tuple[str, str, str]] = [
        *((axis, "<f4", "float") for axis in "xyz"),
        *((color, "u1", "uchar") for color in ("red", "green", "blue", "alpha")),
        *([("label", "<u2", "ushort")] if labels is not None else []),
    ]
    rows = np.zeros(len(room.points), [(name, kind) for name, kind, _ in fields])
    for i, axis in enumerate("xyz"):
        rows[axis] = room.points[:, i]
    for i, color in enumerate(("red", "green", "blue")):
        rows[color] = room.point_colors[:, i]
    rows["alpha"] = 255
    if labels is not None:
        rows["label"] = labels
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {kind} {name}" for name, _, kind in fields]
    header += ["element face 0", "property list uchar int vertex_indices", "end_header"]
    path.write_bytes("\n".join(header).encode("ascii") + b"\n" + rows.tobytes())
