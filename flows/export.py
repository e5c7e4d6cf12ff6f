"""From a finished run to files of other formats: what `ss-flow export` adds to a flow."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from ss_flow.graph import labelled
from ss_flow.tasks.artifacts import Cameras, Gaussians
from ss_flow.tasks.deliver.export import mesh_files
from ss_flow.tasks.deliver.export.compressed_ply import compressed_ply
from ss_flow.tasks.deliver.export.content import FileContent, chosen
from ss_flow.tasks.deliver.export.gaussian_ply import gaussian_ply
from ss_flow.tasks.deliver.export.gltf import gltf
from ss_flow.tasks.deliver.export.mesh import TriangleMesh, mesh
from ss_flow.tasks.deliver.export.sog import sog
from ss_flow.tasks.deliver.export.splat import splat
from ss_flow.tasks.deliver.export.spz import spz
from ss_flow.tasks.deliver.export.usda import usda

Gaussian = Literal["ply", "labelled-ply", "compressed-ply", "splat", "spz", "sog", "gltf", "gltf-flat", "usda"]
Surface = Literal["mesh-ply", "mesh-obj", "mesh-glb"]
Workspace = Literal["colmap", "nerfstudio"]
Format = Literal[Gaussian, Surface, "coco", Workspace]  # a union of them would be told of in any order
SURFACES, WORKSPACES = get_args(Surface), get_args(Workspace)


@dataclass(frozen=True)
class Source:
    """What is exported: nodes of a finished run, and which of its instances."""

    scene: Gaussians
    cameras: Cameras
    names: Mapping[str, str]
    """Of the instances, by their ids as text."""
    instances: tuple[int, ...] | None
    """Their ids; None = the whole scene, the background included."""

    def gaussians(self) -> Gaussians:
        """The node of the Gaussians that are asked for."""
        return self.scene if self.instances is None else chosen(self.scene, instances=self.instances)

    def mesh(self, instance_id: int, holes: Literal["open", "closed"]) -> TriangleMesh:
        """The node of an instance's surface."""
        with labelled(str(instance_id)):
            own = chosen(self.scene, instances=(instance_id,))
            return mesh(own, self.cameras, instance_id=instance_id, holes=holes)


GAUSSIANS: dict[str, tuple[str, Callable[[Source], FileContent]]] = {
    "ply": (".ply", lambda source: gaussian_ply(source.gaussians(), labelled=False)),
    "labelled-ply": (".ply", lambda source: gaussian_ply(source.gaussians(), labelled=True)),
    "compressed-ply": (".compressed.ply", lambda source: compressed_ply(source.gaussians())),
    "splat": (".splat", lambda source: splat(source.gaussians())),
    "spz": (".spz", lambda source: spz(source.gaussians())),
    "sog": (".sog", lambda source: sog(source.gaussians())),
    "gltf": (".glb", lambda source: gltf(source.gaussians(), source.cameras, names=source.names)),
    "gltf-flat": (".glb", lambda source: gltf(source.gaussians(), source.cameras, names=source.names, flat=True)),
    "usda": (".usda", lambda source: usda(source.gaussians(), source.cameras, names=source.names)),
}
"""The formats of Gaussians: what their files end in, and the node of a file."""
MESHES = {"mesh-ply": ".ply", "mesh-obj": ".obj"}
"""The formats with a file for each surface, and what it ends in."""
OTHERS = {"mesh-glb": ".glb", "coco": ".json", "colmap": "", "nerfstudio": ""}


def suffix_of(format: str) -> str:
    """What a file of a format ends in."""
    return GAUSSIANS[format][0] if format in GAUSSIANS else (MESHES | OTHERS)[format]


def one_file(source: Source, format: str, holes: Literal["open", "closed"]) -> FileContent:
    """The node of one file with all that is asked for."""
    if format in GAUSSIANS:
        return GAUSSIANS[format][1](source)
    ids = source.instances or ()
    if format == "mesh-glb":
        surfaces = tuple(source.mesh(instance_id, holes) for instance_id in ids)
        return mesh_files.mesh_glb(surfaces, source.cameras, names=source.names)
    (instance_id,) = ids
    surface = source.mesh(instance_id, holes)
    if format == "mesh-ply":
        return mesh_files.mesh_ply(surface)
    return mesh_files.mesh_obj(surface, name=source.names.get(str(instance_id), "object"))


def a_file_each(source: Source, format: str, holes: Literal["open", "closed"]) -> dict[str, Any]:
    """The nodes of a file for each instance that is asked for, by its id as text."""
    files = {}
    for instance_id in source.instances or ():
        with labelled(str(instance_id)):
            files[str(instance_id)] = one_file(replace(source, instances=(instance_id,)), format, holes)
    return files
