"""glTF with `KHR_gaussian_splatting`: a node for each instance, or one mesh for viewers that sort mesh by mesh."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, Float64, Gaussians
from ss_flow.tasks.deliver.export.content import FileContent, base_colors, name_of, y_up
from ss_flow.tasks.gaussians.initialise import select

_EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _POINTS = 5126, 0
VERTEX_DATA = 34962
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class Buffer:
    """The binary part of a .glb file, and the tables that say what lies where in it."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.size = 0

    def add(self, array: np.ndarray, target: int, component: int = _FLOAT, *, ends: bool = False) -> int:
        """Add an array [N] or [N, C] of 4-byte numbers; returns its accessor. ends: tell its range, as positions do."""
        data = array.tobytes()
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data), "target": target})
        kind = _KINDS[1 if array.ndim == 1 else array.shape[1]]
        accessor = {"bufferView": len(self.views) - 1, "componentType": component, "count": len(array), "type": kind}
        if ends:
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.accessors.append(accessor)
        self.parts.append(data)
        self.size += len(data)
        return len(self.accessors) - 1


def glb(document: Mapping[str, Any], buffer: Buffer) -> FileContent:
    """A .glb file of a document, to which what the buffer holds is added."""
    whole = {"asset": {"version": "2.0", "generator": "ss-flow"}, "scene": 0, **document}
    if buffer.size:
        whole |= {"buffers": [{"byteLength": buffer.size}], "bufferViews": buffer.views, "accessors": buffer.accessors}
    text = json.dumps(whole, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if buffer.size:
        chunks += struct.pack("<I4s", buffer.size, b"BIN\0") + b"".join(buffer.parts)
    return FileContent.of(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)), chunks)


def scene_of(nodes: list[dict[str, Any]], cameras: Cameras) -> dict[str, Any]:
    """A scene of nodes in the world's axes, under one node that turns them to glTF's, where y points up."""
    root: dict[str, Any] = {"name": "scene", "rotation": y_up(cameras).tolist()}
    if nodes:
        root["children"] = list(range(1, len(nodes) + 1))
    return {"scenes": [{"nodes": [0]}], "nodes": [root, *nodes]}


def node_of(instance_id: int, names: Mapping[str, str], mesh: int) -> dict[str, Any]:
    """The node of an instance; names: of the instances, by their ids as text."""
    return {"name": name_of(instance_id, names), "mesh": mesh, "extras": {"instance_id": instance_id}}


def linear_colors(display: Float64) -> Float64:
    """Colours 0..1 as glTF wants them, in linear light; display: in sRGB."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


@task(name="deliver.export.gltf")
def gltf(gaussians: Gaussians, cameras: Cameras, *, names: Mapping[str, str], flat: bool = False) -> FileContent:
    """A .glb file with all that the Gaussians hold, in float32; part ids are lost.

    Each instance is a node with its name and `extras.instance_id`, which any scene graph can move or hide. Some viewers
    sort the Gaussians of each mesh by depth, but not those of several among each other, so that objects vanish behind
    the background. For these there is one mesh (`flat`), whose attribute `_INSTANCE_ID` (float32, as glTF allows no
    32-bit integers there) tells the instance of each Gaussian, and `extras.instances` of its node their names.

    names: of the instances, by their ids as text.
    """
    buffer, meshes = Buffer(), []
    ids = np.unique(gaussians.instance_id).tolist()
    if flat and ids:
        known = [{"id": instance_id, "name": name_of(instance_id, names)} for instance_id in ids]
        parts = [({"name": "instances", "mesh": 0, "extras": {"instances": known}}, gaussians)]
    else:
        parts = [
            (node_of(instance_id, names, mesh), select(gaussians, gaussians.instance_id == instance_id))
            for mesh, instance_id in enumerate(ids)
        ]
    for node, own in parts:
        attributes = _attributes(own, buffer)
        if flat:
            attributes["_INSTANCE_ID"] = buffer.add(own.instance_id.astype("<f4"), VERTEX_DATA)
        appearance = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        appearance |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
        primitive = {"mode": _POINTS, "attributes": attributes, "extensions": {_EXTENSION: appearance}}
        meshes.append({"name": node["name"], "primitives": [primitive]})
    document = {"extensionsUsed": [_EXTENSION], "meshes": meshes} if meshes else {}
    return glb({**document, **scene_of([node for node, _ in parts], cameras)}, buffer)


def _attributes(own: Gaussians, buffer: Buffer) -> dict[str, int]:
    opacities = own.opacities.astype("<f4")
    linear = linear_colors(base_colors(own).clip(0, 1))
    columns = {
        f"{_EXTENSION}:ROTATION": own.unit_quaternions[:, [1, 2, 3, 0]],
        f"{_EXTENSION}:SCALE": np.exp(own.log_scales),
        f"{_EXTENSION}:OPACITY": opacities,
        "COLOR_0": np.column_stack([linear, opacities]),  # what viewers without the extension show, as points
    }
    for degree in range(own.sh_degree + 1):
        for n in range(2 * degree + 1):
            columns[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = own.sh[:, degree**2 + n]
    found = {"POSITION": buffer.add(own.means.astype("<f4"), VERTEX_DATA, ends=True)}
    return found | {name: buffer.add(column.astype("<f4"), VERTEX_DATA) for name, column in columns.items()}
