"""How each artifact is drawn in a scene of viser.

viser draws in the world frame of the poses, and takes cameras as we do (x right, y down, z forward) and quaternions as
w x y z. Nothing here loads viser: a scene comes in as `viser.SceneApi` (`server.scene`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.flows.view.thinning import thinned
from ss_flow.tasks.artifacts import (
    Cameras,
    DepthMap,
    Float32,
    Frame,
    Gaussians,
    InstanceMasks,
    LabelMap,
    MaskSet,
    PointCloud,
    PointLabels,
    PointParts,
    UInt8,
    Visibility,
)
from ss_flow.tasks.deliver.draw import draw as picture_of
from ss_flow.tasks.deliver.export.content import base_colors
from ss_flow.tasks.deliver.palette import depth_colors, instance_colors, paint_ids, turbo
from ss_flow.tasks.gaussians.densification import rotations
from ss_flow.tasks.geometry.cameras import (
    backproject,
    camera_extent,
    camera_of,
    cameras_by_view,
)
from ss_flow.tasks.geometry.images import decode_rgb

if TYPE_CHECKING:
    from viser import CameraFrustumHandle, GaussianSplatHandle, PointCloudHandle, SceneApi

_UNLABELLED = (190, 190, 190)
_PICTURE_HEIGHT = 240
"""Of the pictures in frusta, pixels."""
_MOST_POINTS = 1_500_000
"""More are thinned out: the browser draws them at every frame."""
_LARGEST_SCALE = 200.0
"""Standard deviation, in the node's own units, of the largest Gaussian: its square still fits a 16-bit float, and those
a million times smaller are not yet 0."""
_OF_EXTENT = 0.05
"""Size of a camera's frustum, as a share of how far the cameras spread."""


@dataclass(frozen=True)
class Around:
    """What artifacts are drawn with; each says what it needs."""

    frames: Sequence[Frame] = ()
    """Of all views: photos in frusta, and behind masks."""
    cameras: Cameras | None = None
    """Where views stand."""
    points: PointCloud | None = None
    """The dense points, which labels refer to."""
    share: float = 1.0
    """Of the Gaussians, how many are drawn (`thinned`)."""

    def frame(self, name: str) -> Frame | None:
        """The photo of a view."""
        return next((frame for frame in self.frames if frame.name == name), None)

    def placed(self) -> Cameras:
        """The cameras. Raises InputError where there are none."""
        if self.cameras is None:
            raise InputError("what belongs to one view can be placed only with the run's cameras, and none are known.")
        return self.cameras

    def labelled_points(self, labels: np.ndarray) -> PointCloud:
        """The points that these labels are about. Raises InputError where they are not known."""
        if self.points is None or len(self.points.points) != len(labels):
            raise InputError("labels can be placed only with the dense points that they are about.")
        return self.points


def add_gaussians(scene: SceneApi, name: str, gaussians: Gaussians, colors: UInt8 | None = None) -> GaussianSplatHandle:
    """Gaussians as splats, without the change of their colour with the direction, which viser does not draw.

    gaussians: N > 0. colors: [N, 3] RGB to draw them in, instead of their own.
    """
    arrays, scale = _splats(gaussians, colors)
    return scene.add_gaussian_splats(name, **arrays, scale=scale)


def change_gaussians(node: GaussianSplatHandle, gaussians: Gaussians, colors: UInt8 | None = None) -> None:
    """Let a node show others; a new node in its place would have the browser build all splats anew.

    gaussians, colors: as for `add_gaussians`.
    """
    arrays, scale = _splats(gaussians, colors)
    node.set_gaussians(**arrays)
    node.scale = scale


def _splats(gaussians: Gaussians, colors: UInt8 | None) -> tuple[dict[str, Any], float]:
    """What viser calls Gaussians, and the scale of the node that they are to have."""
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    enlarged = _LARGEST_SCALE / max(float(scales.max(initial=0)), 1e-12)
    axes = rotations(gaussians.quaternions) * (enlarged * scales[:, None, :])
    arrays = {
        "centers": (enlarged * gaussians.means.astype(np.float64)).astype(np.float32),
        "covariances": axes @ axes.transpose(0, 2, 1),
        "rgbs": base_colors(gaussians).clip(0, 1) if colors is None else colors,
        "opacities": gaussians.opacities[:, None],
    }
    return arrays, 1 / enlarged


def add_points(scene: SceneApi, name: str, points: Float32, colors: UInt8, spacing: float) -> PointCloudHandle:
    """Points as round dots of their spacing.

    points: [N, 3] world; colors: [N, 3] RGB; spacing: world units.
    """
    thin = slice(None, None, -(-len(points) // _MOST_POINTS) or 1)
    return scene.add_point_cloud(
        name, points[thin], colors[thin], point_size=spacing, point_shape="circle", precision="float32"
    )


def add_views(scene: SceneApi, name: str, cameras: Cameras, pictures: Mapping[str, UInt8]) -> list[CameraFrustumHandle]:
    """Cameras as frusta, each with a picture where there is one.

    pictures: [h, w, 3] RGB by the view's name, of any size.
    """
    from scipy.spatial.transform import Rotation

    size = _OF_EXTENT * camera_extent(cameras_by_view(cameras)) or 0.1
    handles = []
    for view, camera in enumerate(cameras_by_view(cameras)):
        picture = pictures.get(cameras.names[view])
        handles.append(
            scene.add_camera_frustum(
                f"{name}/{cameras.names[view]}",
                fov=2 * np.arctan(camera.height / 2 / camera.fy),
                aspect=camera.width / camera.height,
                scale=size,
                thickness=size / 100,
                image=None if picture is None else _small(picture),
                format="jpeg",
                wxyz=Rotation.from_matrix(camera.world_to_camera[:3, :3].T).as_quat(scalar_first=True),
                position=camera.center,
                cast_shadow=False,
                receive_shadow=False,
            )
        )
    return handles


def _small(picture: UInt8) -> UInt8:
    import cv2

    height, width = picture.shape[:2]
    if height <= _PICTURE_HEIGHT:
        return picture
    size = (round(width * _PICTURE_HEIGHT / height), _PICTURE_HEIGHT)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def label_colors(ids: np.ndarray) -> UInt8:
    """[N, 3] the colours of instance ids; 0 is light grey, since points on dark ones are not seen."""
    colors = instance_colors(int(ids.max(initial=0)) + 1)
    colors[0] = _UNLABELLED
    return colors[ids]


def agreement_colors(confidence: Float32) -> UInt8:
    """[N, 3] how far the views agree on a point: from red (contested) over yellow to blue (all agree), grey no votes.

    confidence: [N] share of the votes for the best label, 0 without votes (`PointLabels.confidence`).
    """
    colors = turbo()[np.rint(255 * (0.9 - 0.8 * confidence.clip(0, 1))).astype(np.intp)]
    colors[confidence <= 0] = _UNLABELLED
    return colors


def draw(scene: SceneApi, name: str, value: object, around: Around) -> None:
    """Draw an artifact, or a list of artifacts of one type, as nodes from `name` on.

    Raises InputError for what has no place in space, or when `around` lacks what places it.
    """
    _draw(value, scene, name, around)


def is_spatial(value: object) -> bool:
    """Whether `draw` can draw an artifact, or a list of them."""
    kind = type(value[0]) if isinstance(value, tuple | list) and value else type(value)
    return _draw.dispatch(kind) is not _draw.dispatch(object)


@singledispatch
def _draw(value: Any, scene: SceneApi, name: str, around: Around) -> None:
    raise InputError(f"{type(value).__name__} has no place in space.")


@_draw.register(tuple)
@_draw.register(list)
def _(value: Sequence[Any], scene: SceneApi, name: str, around: Around) -> None:
    if not value:
        raise InputError("an empty list cannot be drawn.")
    if isinstance(value[0], Frame | LabelMap | MaskSet):
        pictures = {item.name: view_picture(item, around) for item in value}
        add_views(scene, name, around.placed(), pictures)
        return
    for index, item in enumerate(value):
        _draw(item, scene, f"{name}/{getattr(item, 'name', index)}", around)


def view_picture(value: Frame | LabelMap | MaskSet, around: Around) -> UInt8:
    """What one view shows: its photo, or masks over the photo; [H, W, 3] RGB."""
    if isinstance(value, Frame):
        return decode_rgb(value)
    frame = around.frame(value.name)
    if isinstance(value, MaskSet):
        return picture_of(value, frame=frame)
    photo = decode_rgb(frame) if frame is not None and (frame.height, frame.width) == value.ids.shape else None
    return paint_ids(value.ids.astype(np.int32), photo)


@_draw.register(Frame)
@_draw.register(LabelMap)
@_draw.register(MaskSet)
def _(value: Frame | LabelMap | MaskSet, scene: SceneApi, name: str, around: Around) -> None:
    add_views(scene, name, around.placed(), {value.name: view_picture(value, around)})


@_draw.register(Cameras)
def _(value: Cameras, scene: SceneApi, name: str, around: Around) -> None:
    """The cameras with their photos, and what structure from motion triangulated."""
    add_views(scene, f"{name}/views", value, {frame.name: decode_rgb(frame) for frame in around.frames})
    if len(value.sparse_points):
        dots = np.full((len(value.sparse_points), 3), 90, np.uint8)
        add_points(scene, f"{name}/sparse", value.sparse_points, dots, spacing_of(value.sparse_points) / 2)


@_draw.register(DepthMap)
def _(value: DepthMap, scene: SceneApi, name: str, around: Around) -> None:
    """The points that the view's depth stands for, in the colours of its photo."""
    cameras = around.placed()
    camera = camera_of(cameras, cameras.names.index(value.name)).scaled(*value.depth.shape[::-1])
    points = backproject(value.depth, camera).astype(np.float32)
    known = value.depth.ravel() > 0
    frame = around.frame(value.name)
    if frame is None:
        colors = depth_colors(value.depth)[0]
    else:
        import cv2

        size = (camera.width, camera.height)
        colors = np.asarray(cv2.resize(decode_rgb(frame), size, interpolation=cv2.INTER_AREA), np.uint8)
    pixel = float(np.median(value.depth[value.depth > 0])) / camera.fx if known.any() else 1.0
    add_points(scene, name, points[known], colors.reshape(-1, 3)[known], pixel)


@_draw.register(PointCloud)
def _(value: PointCloud, scene: SceneApi, name: str, around: Around) -> None:
    add_points(scene, name, value.points, value.colors, value.spacing_of())


@_draw.register(PointLabels)
def _(value: PointLabels, scene: SceneApi, name: str, around: Around) -> None:
    """The dense points by their labels, and, as a node beside it, by how far the views agree."""
    dense = around.labelled_points(value.label)
    add_points(scene, f"{name}/labels", dense.points, label_colors(value.label), dense.spacing_of())
    agreement = agreement_colors(value.confidence)
    add_points(scene, f"{name}/agreement", dense.points, agreement, dense.spacing_of()).visible = False


@_draw.register(PointParts)
def _(value: PointParts, scene: SceneApi, name: str, around: Around) -> None:
    dense = around.labelled_points(value.part)
    add_points(scene, name, dense.points, label_colors(value.part), dense.spacing_of())


@_draw.register(Visibility)
def _(value: Visibility, scene: SceneApi, name: str, around: Around) -> None:
    """The dense points that the view sees, by their depth in it."""
    if around.points is None:
        raise InputError("what a view sees can be placed only with the dense points.")
    seen = around.points.points[value.point_index]
    add_points(scene, name, seen, depth_colors(value.depth)[0], around.points.spacing_of())


@_draw.register(InstanceMasks)
def _(value: InstanceMasks, scene: SceneApi, name: str, around: Around) -> None:
    """The instance's points, in their colours."""
    if len(value.points):
        add_points(scene, name, value.points, value.colors, spacing_of(value.points))


@_draw.register(Gaussians)
def _(value: Gaussians, scene: SceneApi, name: str, around: Around) -> None:
    if len(value):
        add_gaussians(scene, name, thinned(value, around.share))


def spacing_of(points: Float32) -> float:
    """The median distance to the nearest other point, found for some of them; world units."""
    from scipy.spatial import KDTree

    if len(points) < 2:
        return 0.01
    some = points[:: max(1, len(points) // 2000)]
    return max(float(np.median(KDTree(points).query(some, 2)[0][:, 1])), 1e-9)
