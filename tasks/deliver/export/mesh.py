"""The surface of an instance as triangles: its rendered depth, fused (Curless and Levoy 1996) and cut at zero."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ss_flow.running import progress, warn
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Cameras, Float32, Float64, Gaussians, Int32, UInt8
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import Rendering, render
from ss_flow.tasks.geometry.cameras import Camera, cameras_by_view, looking, pixels_in_view, project
from ss_flow.tasks.geometry.open3d import load_open3d

_CELLS = 128
"""Cells along the longest side of an instance's box."""
_TRUNCATION = 4
"""Cells on either side of a surface that hold its distance."""
_SOLID = 0.5
"""Alpha from which a pixel has a depth."""
_PICTURE = 320
"""Longest side of a rendering, pixels."""
_WIDEST = 1.5
"""Slope of the outermost rays of a rendering; what lies further out is left to other views."""
_MARGIN = 0.06
_STRAY = 0.005
"""Share of the Gaussians at each end of each axis that may lie outside the box."""
_SMALLEST_PIECE = 0.2
"""Share of the largest piece's diagonal below which another piece is taken for floating debris: a leg whose seat no
view shows is a piece of few triangles, but a long one."""


@dataclass(frozen=True)
class TriangleMesh:
    """Coloured triangles."""

    instance_id: int
    vertices: Float32
    """[V, 3] world."""
    colors: UInt8
    """[V, 3] RGB."""
    triangles: Int32
    """[T, 3] rows of `vertices`, anticlockwise from outside."""
    watertight: bool
    """Whether each edge belongs to exactly two triangles."""


@task(
    name="deliver.export.mesh",
    resources=Resources(cores=1, memory_mb=900, gpus=0.1),
    environment=backend_identity,
)
def mesh(own: Gaussians, cameras: Cameras, *, instance_id: int, holes: Literal["open", "closed"]) -> TriangleMesh:
    """The surface of one instance as the input views would see it if it stood alone.

    own: its Gaussians only. holes: "open" leaves open what no view shows; "closed" takes for solid what no view sees
    through (Kutulakos and Seitz 2000), within the instance's box, and so gives a solid whose far side is a guess.
    Colours are those that the views see, averaged.
    """
    views = [view for view in (_turned(own, camera) for camera in cameras_by_view(cameras)) if view is not None]
    if not views:
        warn(f"instance {instance_id} has no Gaussian that an input view sees; its mesh is empty")
        return _empty(instance_id)
    o3d = load_open3d()
    low, high = np.quantile(own.means.astype(np.float64), (_STRAY, 1 - _STRAY), axis=0)
    side = max(float((high - low).max()) * (1 + 2 * _MARGIN), 1e-6)
    cell = side / _CELLS
    corner = (low + high) / 2 - side / 2
    volume = o3d.pipelines.integration.UniformTSDFVolume(
        length=side,
        resolution=_CELLS,
        sdf_trunc=_TRUNCATION * cell,
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.RGB8,
        origin=corner[:, None],
    )
    middles = corner + (np.indices((_CELLS,) * 3).reshape(3, -1).T + 0.5) * cell if holes == "closed" else None
    empty = np.zeros(_CELLS**3, bool)
    for done, view in enumerate(views):
        progress(done, len(views), f"instance {instance_id}")
        depth = _fuse(o3d, volume, render(own, view), view)
        if middles is not None:
            _carve(empty, middles, depth, view, _TRUNCATION * cell)
    surface = volume.extract_triangle_mesh()
    if holes == "closed":
        surface = _closed(o3d, volume, surface, empty, (low - corner) / cell, (high - corner) / cell)
    _drop_debris(surface)
    if not len(surface.triangles):
        warn(f"instance {instance_id} is nowhere solid enough for a surface; its mesh is empty")
        return _empty(instance_id)
    return TriangleMesh(
        instance_id,
        np.asarray(surface.vertices, np.float32),
        np.rint(255 * np.clip(np.asarray(surface.vertex_colors), 0, 1)).astype(np.uint8),
        np.asarray(surface.triangles, np.int32),
        bool(surface.is_edge_manifold(allow_boundary_edges=False)),
    )


def _empty(instance_id: int) -> TriangleMesh:
    none = np.zeros((0, 3))
    return TriangleMesh(
        instance_id, none.astype(np.float32), none.astype(np.uint8), none.astype(np.int32), watertight=False
    )


def _turned(own: Gaussians, camera: Camera) -> Camera | None:
    """A view from the same place, turned towards the instance and filled by it; None where most of it lies beside.

    Turned, since far off its axis a view of the photo's own direction would shear the Gaussians and hang patches into
    the air (`Camera.borders`).
    """
    if not len(own):
        return None
    middle = np.median(own.means.astype(np.float64), axis=0)
    away = middle - camera.center
    distance = float(np.linalg.norm(away))
    if not distance or (camera.world_to_camera[2, :3] @ own.means.T + camera.world_to_camera[2, 3] > 0).mean() < 0.5:
        return None
    pose = looking(camera.center, away / distance, -camera.world_to_camera[1, :3])
    uv, depth = project(own.means, Camera(1, 1, 1, 1, 0, 0, pose))
    before = depth > 0
    if before.mean() < 0.5:
        return None
    low, high = np.quantile(uv[before], (_STRAY, 1 - _STRAY), axis=0).clip(-_WIDEST, _WIDEST)
    side = max(float((high - low).max()), 1e-6)
    border = 0.08 * side
    scale = _PICTURE / (side + 2 * border)
    width, height = np.ceil((high - low + 2 * border) * scale).astype(int).tolist()
    cx, cy = ((border - low) * scale).tolist()
    return Camera(width, height, scale, scale, cx, cy, pose)


def _fuse(o3d: Any, volume: Any, seen: Rendering, view: Camera) -> Float32:
    """Add a rendering's expected depth and colours to the volume; returns the depth, 0 where there is none."""
    alpha = np.maximum(seen.alpha, 1e-6)
    depth = np.where(seen.alpha > _SOLID, seen.depth / alpha, 0).astype(np.float32)
    colors = np.rint(255 * (seen.rgb / alpha[..., None]).clip(0, 1)).astype(np.uint8)
    image = o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(np.ascontiguousarray(colors)),
        o3d.geometry.Image(np.ascontiguousarray(depth)),
        depth_scale=1.0,
        depth_trunc=float(depth.max()) + 1,
        convert_rgb_to_intensity=False,
    )
    # Open3D's pixel centres are whole numbers.
    lens = (view.width, view.height, view.fx, view.fy, view.cx - 0.5, view.cy - 0.5)
    volume.integrate(
        image,
        o3d.camera.PinholeCameraIntrinsic(*lens),
        np.ascontiguousarray(view.world_to_camera),
    )
    return depth


def _carve(empty: Bool, middles: Float64, depth: Float32, view: Camera, margin: float) -> None:
    """Mark the cells [C] in front of a view's surfaces, and those beside them where it sees through."""
    left = np.flatnonzero(~empty)
    rows, column, row, z = pixels_in_view(middles[left], view)
    seen = depth[row, column]
    empty[left[rows[(seen == 0) | (z < seen - margin)]]] = True


def _drop_debris(surface: Any) -> None:
    pieces, counts, _ = surface.cluster_connected_triangles()
    if len(counts):
        piece = np.asarray(pieces)
        corners = np.asarray(surface.vertices)[np.asarray(surface.triangles)]
        low, high = np.full((len(counts), 3), np.inf), np.full((len(counts), 3), -np.inf)
        np.minimum.at(low, piece, corners.min(axis=1))
        np.maximum.at(high, piece, corners.max(axis=1))
        diagonal = np.linalg.norm(high - low, axis=1)
        small = diagonal < _SMALLEST_PIECE * diagonal[np.argmax(counts)]
        surface.remove_triangles_by_mask(small[piece])
        surface.remove_unreferenced_vertices()


def _closed(o3d: Any, volume: Any, surface: Any, empty: Bool, low: Float64, high: Float64) -> Any:
    """The surface of what is not empty; low, high: the instance's box in cells, beyond which all is."""
    from scipy.spatial import cKDTree

    known = np.asarray(volume.extract_volume_tsdf())
    place = np.indices((_CELLS,) * 3).reshape(3, -1).T
    empty = empty | ((place < np.floor(low) - 1) | (place > np.ceil(high) + 1)).any(axis=1)
    value = np.where(known[:, 1] > 0, known[:, 0], np.where(empty, 1.0, -1.0))
    value[((place == 0) | (place == _CELLS - 1)).any(axis=1)] = 1.0
    volume.inject_volume_tsdf(o3d.utility.Vector2dVector(np.column_stack([value, np.ones(len(value))])))
    whole = volume.extract_triangle_mesh()
    if len(surface.vertices):
        nearest = cKDTree(np.asarray(surface.vertices)).query(np.asarray(whole.vertices))[1]
        whole.vertex_colors = o3d.utility.Vector3dVector(np.asarray(surface.vertex_colors)[nearest])
    return whole
