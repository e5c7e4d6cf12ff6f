"""Meshes as files: PLY and OBJ with an object each, glTF with a node for each object."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras
from ss_flow.tasks.deliver.export.content import FileContent
from ss_flow.tasks.deliver.export.gltf import VERTEX_DATA, Buffer, glb, linear_colors, node_of, scene_of
from ss_flow.tasks.deliver.export.mesh import TriangleMesh

_INDICES, _UNSIGNED = 34963, 5125


@task(name="deliver.export.mesh_ply")
def mesh_ply(mesh: TriangleMesh) -> FileContent:
    """A binary PLY file: x y z, red green blue, triangles."""
    vertices = np.zeros(len(mesh.vertices), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = mesh.vertices, mesh.colors
    faces = np.zeros(len(mesh.triangles), [("corners", "u1"), ("rows", "<i4", 3)])
    faces["corners"], faces["rows"] = 3, mesh.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment instance_id {mesh.instance_id}",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    return FileContent.of("\n".join(header).encode("ascii"), vertices.tobytes(), faces.tobytes())


@task(name="deliver.export.mesh_obj")
def mesh_obj(mesh: TriangleMesh, *, name: str) -> FileContent:
    """An OBJ file; colours stand behind the coordinates (0..1), where most readers find them."""
    rows = zip(*mesh.vertices.T.tolist(), *np.round(mesh.colors / 255, 4).T.tolist(), strict=True)
    one_line = " ".join(name.split()).rstrip("\\")  # a backslash at its end would join it with the next line
    lines = [f"o {one_line}"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g} {red:g} {green:g} {blue:g}" for x, y, z, red, green, blue in rows]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.triangles + 1).tolist()]
    return FileContent.of("\n".join(lines).encode(), b"\n")


@task(name="deliver.export.mesh_glb")
def mesh_glb(meshes: tuple[TriangleMesh, ...], cameras: Cameras, *, names: Mapping[str, str]) -> FileContent:
    """A .glb file with a node for each mesh that has triangles; names: of the instances, by their ids as text."""
    buffer, nodes, entries = Buffer(), [], list[dict[str, Any]]()
    # Colours are those of the photos: the material is not to be lit, and glTF's colours are linear.
    for mesh in (mesh for mesh in meshes if len(mesh.triangles)):
        attributes = {
            "POSITION": buffer.add(mesh.vertices.astype("<f4"), VERTEX_DATA, ends=True),
            "COLOR_0": buffer.add(linear_colors(mesh.colors / 255).astype("<f4"), VERTEX_DATA),
        }
        indices = buffer.add(mesh.triangles.astype("<u4").ravel(), _INDICES, _UNSIGNED)
        nodes.append(node_of(mesh.instance_id, names, len(entries)))
        primitive = {"attributes": attributes, "indices": indices, "material": 0}
        entries.append({"name": nodes[-1]["name"], "primitives": [primitive]})
    if not entries:
        return glb(scene_of([], cameras), buffer)
    material = {
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
    }
    document = {"extensionsUsed": ["KHR_materials_unlit"], "meshes": entries, "materials": [material]}
    return glb({**document, **scene_of(nodes, cameras)}, buffer)
