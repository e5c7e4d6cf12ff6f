"""A vector for every Gaussian of an object, from pictures of it alone (Split&Splat, appendix "Dense Semantic
Embeddings"; spec rows 42-44, A32, A33)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    FROM_NEIGHBOURS,
    FROM_PICTURES,
    NO_VECTOR,
    Bool,
    Cameras,
    DenseDescriptors,
    Float64,
    Gaussians,
    Int32,
    UInt8,
)
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, level_axes, looking, up_of
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import box_diagonal
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.models.patches import patch_encoder_of
from ss_flow.tasks.ranges import Count, Positive

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_GREY = (0.5, 0.5, 0.5)
_COVERED = 0.5
"""How far a pixel must be covered for its vector to count: below, it shows the grey around the object more."""
_SHARE_OF_PICTURE = 0.9
"""How much of a picture's side the diagonal of the object's box takes up."""


@dataclass(frozen=True)
class DenseDescribeParams:
    """From where an object is looked at, and how its Gaussians get their vectors."""

    elevations: Count = 6
    """Rings of views, from level on upwards to short of straight down."""
    azimuths: Count = 12
    """Views on each ring."""
    distance: Positive = 2.0
    """From the object's centre to the views, in diagonals of its box; farther off where it is tiny."""
    side: Count = 560
    """Of the square pictures, pixels."""
    neighbours: Count = 5
    """Described Gaussians whose mean one gets that no view shows."""


@task(name="semantics.dense_describe.apart")
def apart(scene: Gaussians) -> tuple[Gaussians, ...]:
    """The Gaussians of each instance, by ascending id, without the background."""
    return tuple(select(scene, rows) for i, rows in sorted(rows_by_label(scene.instance_id).items()) if i != 0)


@task(
    resources=Resources(cores=1, memory_mb=1500, gpus=0.1),
    environment=lambda: network_identity() | backend_identity(),
)
def dense_describe(
    own: Gaussians, cameras: Cameras, *, network: Model, params: DenseDescribeParams = DenseDescribeParams()
) -> DenseDescriptors:
    """The vector of each Gaussian of one instance.

    The instance is rendered alone on grey, from views on a half sphere above it. In each picture the vector of a patch
    goes to the Gaussian with the largest weight in the pixel, bilinear between patches; a Gaussian's vectors are
    averaged in each picture, then over the pictures that it won a pixel of. One that won none gets the mean of the
    nearest that did, and is flagged (Split&Splat, Eq. 8).

    own: Gaussians of one instance, one at least. cameras: the input views; they tell which way is up. network: DINOv2,
    or a segmenter.
    Raises InputError when the network's file is not what the catalogue says.
    """
    encoder = patch_encoder_of(network)
    views = around(own, cameras, params)
    total, seen_by = np.zeros((len(own), 0)), np.zeros(len(own), np.int32)
    for done, camera in enumerate(views):
        seen = render(own, camera, background=_GREY)
        patches = encoder.encode(np.asarray(np.clip(seen.rgb, 0, 1) * 255 + 0.5, np.uint8))
        height, width, length = patches.shape
        means = _assignment(seen.top_contributor, seen.alpha >= _COVERED, len(own), (height, width))
        won = np.diff(means.indptr) > 0
        if not done:
            total = np.zeros((len(own), length))
        total += means @ patches.reshape(-1, length).astype(np.float64)
        seen_by += won
        progress(done + 1, len(views), f"instance {int(own.instance_id[0])}")
    features = total / np.maximum(seen_by, 1)[:, None]
    origin = np.where(seen_by > 0, FROM_PICTURES, NO_VECTOR).astype(np.uint8)
    _fill(features, origin, own.means.astype(np.float64), params.neighbours)
    return DenseDescriptors(own.instance_id, features.astype(np.float32), origin, network.name)


@task(name="semantics.dense_describe.together")
def together(scene: Gaussians, described: tuple[DenseDescriptors, ...], *, network: str) -> DenseDescriptors:
    """The vectors of a whole scene, row by row; zeros for the background and for instances without vectors.

    described: of some of the instances, each in the scene's order. network: its name.
    """
    length = max((d.features.shape[1] for d in described), default=0)
    features = np.zeros((len(scene), length), np.float32)
    origin = np.full(len(scene), NO_VECTOR, np.uint8)
    rows = rows_by_label(scene.instance_id)
    for of_one in described:
        own = rows[int(of_one.instance_id[0])]
        features[own], origin[own] = of_one.features, of_one.origin
    return DenseDescriptors(scene.instance_id, features, origin, network)


def around(own: Gaussians, cameras: Cameras, params: DenseDescribeParams) -> tuple[Camera, ...]:
    """Views on a half sphere above an object that look at its centre, ring by ring from below.

    The centre is the mean of its Gaussians' centres, the diagonal that of their box.
    """
    center = own.means.mean(axis=0, dtype=np.float64)
    diagonal = max(box_diagonal(own.means), float(np.exp(own.log_scales.max())))
    up = up_of(cameras.world_to_camera)
    east, north = level_axes(up)
    # What is nearer than the near plane is not drawn: views of a tiny thing stand farther off and look more closely.
    away = params.distance * max(diagonal, NEAR_PLANE)
    focal = _SHARE_OF_PICTURE * params.side * (away / diagonal)
    middle = params.side / 2
    lens = Camera(params.side, params.side, focal, focal, middle, middle, np.eye(4))
    found = []
    for elevation in np.pi / 2 * np.arange(params.elevations) / params.elevations:
        for azimuth in 2 * np.pi * np.arange(params.azimuths) / params.azimuths:
            level = np.cos(azimuth) * east + np.sin(azimuth) * north
            outwards = np.cos(elevation) * level + np.sin(elevation) * up
            eye = center + away * outwards
            found.append(replace(lens, world_to_camera=looking(eye, -outwards, up)))
    return tuple(found)


def _assignment(top: Int32, counted: Bool, gaussians: int, patches: tuple[int, int]) -> csr_array:
    """[N, h * w] what takes the vectors of patches to the mean over the pixels that each Gaussian won.

    A pixel's vector goes to the Gaussian that weighs most there (Split&Splat, Eq. 7; spec A32).
    top: [H, W] the Gaussian that each pixel shows. counted: [H, W]. patches: h, w.
    """
    from scipy.sparse import coo_array

    rows, columns = np.nonzero(counted & (top >= 0))
    winner = top[rows, columns]
    (row, next_row, down), (column, next_column, right) = (
        _between(pixels, size, count) for pixels, size, count in zip((rows, columns), top.shape, patches, strict=True)
    )
    corners = (
        (row, column, (1 - down) * (1 - right)),
        (row, next_column, (1 - down) * right),
        (next_row, column, down * (1 - right)),
        (next_row, next_column, down * right),
    )
    patch = np.concatenate([r * patches[1] + c for r, c, _ in corners])
    pixels_of = np.bincount(winner, minlength=gaussians)
    share = np.concatenate([weight / pixels_of[winner] for *_, weight in corners])
    return coo_array((share, (np.tile(winner, 4), patch)), shape=(gaussians, patches[0] * patches[1])).tocsr()


def _between(pixels: np.ndarray, size: int, count: int) -> tuple[np.ndarray, np.ndarray, Float64]:
    """The patches before and after each pixel along one axis, and how far it is to the second: 0..1.

    size: pixels along the axis. count: patches.
    """
    place = np.clip((pixels + 0.5) * count / size - 0.5, 0, count - 1)
    first = np.floor(place).astype(np.intp)
    return first, np.minimum(first + 1, count - 1), place - first


def _fill(features: Float64, origin: UInt8, means: Float64, neighbours: int) -> None:
    """Give Gaussians without a vector the mean of the nearest that have one, in place."""
    from scipy.spatial import cKDTree

    seen = np.flatnonzero(origin == FROM_PICTURES)
    lacking = np.flatnonzero(origin == NO_VECTOR)
    if not len(seen) or not len(lacking):
        return
    nearest = cKDTree(means[seen]).query(means[lacking], k=range(1, min(neighbours, len(seen)) + 1))[1]
    features[lacking] = features[seen[nearest]].mean(axis=1)
    origin[lacking] = FROM_NEIGHBOURS
