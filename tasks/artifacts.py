"""What flows between the steps: frozen dataclasses of arrays, which the store keeps as Zarr groups.

Conventions (said once, used everywhere):

- The world frame is the one the poses use. A camera looks along +z, x right, y down (OpenCV).
  Stored poses are world-to-camera.
- Pixel centres lie at (i + 0.5, j + 0.5); the pixel that holds image point (u, v) is (floor(u), floor(v)).
- Instance ids: 1..L, assigned once and never re-used; 0 is background or unlabelled.
- Quaternions are (w, x, y, z). Images in memory are RGB.

All in one module: the digest of an artifact names the module of its class, so one that moves is another artifact.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.packed import PhotoMasks, ViewLists, ViewMasks

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Frame:
    """One view's photo, kept encoded (a decoded image is ten times the size)."""

    name: str
    """Stem of the input file; unique in a scene."""
    width: int
    height: int
    encoded: UInt8
    """[n] the bytes of a JPEG or PNG file of `width` x `height` pixels."""
    valid: UInt8
    """[m] the bytes of a one-channel PNG, 0 where a pixel is to be ignored; empty when all pixels count."""
    source_width: int
    source_height: int
    """Size of the input photo; larger than `width`, `height` when it was scaled down on the way in."""
    focal: float = 0.0
    """Focal length that the input photo's EXIF tells, in millimetres; 0 where it tells none."""


@dataclass(frozen=True)
class Cameras:
    """The pinhole cameras of all views, in the order of the frames."""

    names: tuple[str, ...]
    sizes: Int32
    """[K, 2] width, height of the frame that the intrinsics refer to."""
    intrinsics: Float64
    """[K, 4] fx, fy, cx, cy in pixels."""
    world_to_camera: Float64
    """[K, 4, 4] rigid."""
    metric: bool
    """Whether one world unit is one metre."""
    sparse_points: Float32 = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """[S, 3] points triangulated by structure from motion; empty where the poses were given."""
    radial: Float64 = field(default_factory=lambda: np.zeros(0, np.float64))
    """[K] first radial distortion coefficient of the photos that these cameras were estimated from, which
    `capture.registered` takes out of the frames; empty where there is none."""

    def __len__(self) -> int:
        return len(self.names)

    def row_of(self) -> dict[str, int]:
        """The row of each view by its name."""
        return {name: row for row, name in enumerate(self.names)}


@dataclass(frozen=True)
class DepthMap:
    """Depth of one view, registered to its frame's camera, possibly at a lower resolution.

    Frame pixel (u, v) falls on depth pixel (u * depth width / frame width, v * depth height / frame height).
    """

    name: str
    depth: Float32
    """[h, w] z-depth in world units, 0 where unknown."""
    source: str
    """Where it came from: "sensor", "mvs" (photos compared), "completed" (the sensor, and mvs where it knows nothing),
    "mono" or "rendered"."""


@dataclass(frozen=True)
class SceneUnit:
    """The unit of length that plays the part of one metre in an average room."""

    length: float
    """In world units; 1.0 where these are metres."""


@dataclass(frozen=True)
class ColourTransform:
    """What turns the colours of one photo into those of the scene: its exposure and white balance taken out."""

    name: str
    """Of the view."""
    reference: str
    """The view whose colours are the scene's; its own transform changes nothing. "" where all photos stay as they are,
    whose transforms change nothing either."""
    matrix: Float64
    """[3, 4] affine: RGB (r, g, b, 1) of the photo, 0..1, to RGB of the scene, which may lie beyond 0..1."""


@dataclass(frozen=True)
class Registration:
    """How the depth maps must be moved for their edges to lie on those of the photos: frame point x goes to
    scale * (x - principal point) + principal point + shift."""

    scale: float
    shift: Float64
    """[2] x, y in pixels of the frames."""
    gain: float
    """0..1 share of the agreement between edges of depth and of photo that is lost where the maps stay as they are."""

    @property
    def moves(self) -> bool:
        """Whether there is anything to move them by."""
        return self.scale != 1 or bool(self.shift.any())


@dataclass(frozen=True)
class CaptureChecks:
    """How well each view fits its neighbours; NaN where it shares too little with any."""

    names: tuple[str, ...]
    """Of the views."""
    depth_error: Float64
    """[K] relative difference between its depth, carried to a neighbour, and the neighbour's: median."""
    likeness: Float64
    """[K] correlation of its grey values with a neighbour's, -1..1."""
    exposure: Float64
    """[K] factor of its brightness; 1 on average."""
    depth_scale: float
    """The factor on all depth by which neighbours agree clearly better; 1 where there is none."""
    duplicates: tuple[str, ...]
    """Views whose photo is that of an earlier one."""


@dataclass(frozen=True)
class MaskSet(PhotoMasks):
    """The 2D instance masks that a segmenter found in one view (Split&Splat, M_k); they may overlap."""

    predicted_iou: Float32
    """[N] the segmenter's own estimate of each mask's quality."""
    stability: Float32
    """[N] IoU of the mask cut at a higher and at a lower threshold."""
    grid: Int32
    """[N] index of the prompt grid that gave the mask, 0 = coarsest."""
    parent: Int32
    """[N] index of the smallest mask that holds this one, -1 at the top."""
    source: str
    """Name of the segmenter."""

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def quality(self) -> Float32:
        """[N] how sure the segmenter is of each mask: its own estimate of the IoU, times the mask's stability."""
        return np.minimum(self.predicted_iou, 1) * self.stability


@dataclass(frozen=True)
class PointCloud:
    """Dense points of the scene (Split&Splat, P_dense)."""

    points: Float32
    """[N, 3] world."""
    colors: UInt8
    """[N, 3] RGB."""
    unit: float
    """The length, in world units, that plays the part of one metre in an average room (1.0 when metric)."""
    spacing: Float32
    """[N] distance at which neighbours lie there, in world units: larger where views look only from far away, or from
    the side."""
    noise: float = 0.0
    """Standard deviation of the views' depth from the points, as a share of the depth."""

    def spacing_of(self, rows: NDArray[np.integer] | slice = slice(None)) -> float:
        """The usual spacing, by its median, of some of the points; 0.0 where there are none."""
        spacing = self.spacing[rows]
        return float(np.median(spacing)) if len(spacing) else 0.0


@dataclass(frozen=True)
class Visibility:
    """The surface-consistent points of one view (Split&Splat, Eq. 1-2: P_k)."""

    name: str
    point_index: Int32
    """[M] rows of the point cloud, ascending."""
    pixel: Int32
    """[M] flat index v * W + u of the frame pixel each point falls on."""
    depth: Float32
    """[M] z-depth of the point in this view."""
    height: int
    width: int
    """Size of the frame."""


@dataclass(frozen=True)
class Observation:
    """What the masks of one view say about the points that it sees (Split&Splat, Eq. 3: P_{k,j} for every mask j)."""

    name: str
    point_index: Int32
    """[M] rows of the point cloud that the view sees, ascending."""
    mask: Int32
    """[J] index of each mask in the view's MaskSet, in canonical order."""
    first: Int32
    """[J + 1] where the points of each mask begin: mask j has entries first[j] .. first[j + 1]."""
    row: Int32
    """[A] which of the view's points lie under the masks, as rows of `point_index`; ascending within each mask."""
    standing: UInt8
    """[A] how each of them stands under its mask: 0 at its border, 1 inside but strayed from the rest, 2 inside."""

    def inside(self, j: int) -> Int32:
        """Points of the cloud that lie inside the j-th mask, ascending."""
        return self.point_index[self.rows_inside(j)]

    def rows_inside(self, j: int) -> Int32:
        """The same as rows of `point_index`."""
        row, standing = self.under(j)
        return row[standing == INSIDE]

    def under(self, j: int) -> tuple[Int32, UInt8]:
        """The points under the j-th mask as rows of `point_index`, ascending, and how each of them stands there."""
        part = slice(self.first[j], self.first[j + 1])
        return self.row[part], self.standing[part]


BORDER, STRAY, INSIDE = 0, 1, 2
"""How a point stands under a mask."""


@dataclass(frozen=True)
class PointLabels:
    """The labelled dense points (Split&Splat, P_labeled) and how each mask was matched."""

    label: Int32
    """[N] instance id of each dense point, 0 = unlabelled."""
    confidence: Float32
    """[N] the winning label's share of the point's votes, 0 where there were none."""
    num_labels: int
    """The highest id ever given; ids of labels that did not survive stay unused."""
    match_view: Int32
    """[A] view of each matched mask."""
    match_mask: Int32
    """[A] index of the mask in its view's MaskSet."""
    match_label: Int32
    """[A] id that the mask votes for."""


@dataclass(frozen=True)
class Tally:
    """How many of each label's points every mask of one view holds; a point under nested masks counts in each."""

    name: str
    label: Int32
    """[V] the labels that the view sees, ascending."""
    seen: Int32
    """[V] points of each that the view sees."""
    held: Int32
    """[M, V] those of them under each mask of the view's MaskSet."""
    beside: Int32
    """[V, V] pixels at which the area of each label meets that of each other one."""
    quality: Float32
    """[M] `MaskSet.quality`."""


@dataclass(frozen=True)
class Hierarchy:
    """What is part of what, over all views: a tree for each thing, with the labels of `split.propagate` as leaves."""

    node: Int32
    """[T] id of each node: the labels, ascending, then higher numbers for what they make up, children first."""
    parent: Int32
    """[T] id of the smallest node that holds it, 0 at the top."""
    agreement: Float32
    """[T] share of the views which show it as one thing, of those that could; 1 for the leaves."""
    stuff: Bool
    """[T] whether it is a wall, a floor or the like rather than a thing."""

    def row_of(self) -> dict[int, int]:
        """The row of each node."""
        return {int(node): row for row, node in enumerate(self.node)}


@dataclass(frozen=True)
class PointParts:
    """Which part of its object each dense point belongs to."""

    part: Int32
    """[N] 0 = the whole object; 1.. within each label, from the largest part on."""


@dataclass(frozen=True)
class Clicks:
    """The points that a user clicked in one view to say where objects are; none in most views."""

    name: str
    label: Int32
    """[N] the object that each point is about, numbered from 1 on over all views."""
    points: Float64
    """[N, 2] x, y in pixels of the frame."""
    inside: Int32
    """[N] 1 = on the object, 0 = outside of it."""


@dataclass(frozen=True)
class PromptedMasks(PhotoMasks):
    """Masks that the segmenter gave in one view when asked for certain labels."""

    label: Int32
    """[N] instance id of each mask, ascending."""
    predicted_iou: Float32
    """[N] the segmenter's own estimate of each mask's quality."""


@dataclass(frozen=True)
class InstancesInView(PhotoMasks):
    """The masks of all instances that one view shows, which do not overlap; the background's are the pixels of none."""

    label: Int32
    """[N] instance id of each mask, ascending, 0 = background."""
    origin: UInt8
    """[N] where the mask came from: FOUND, PROMPTED or DRAWN."""


@dataclass(frozen=True)
class InstanceMasks(ViewMasks):
    """One instance after Split: its points and view-consistent masks, exclusive between instances (Split&Splat,
    M~_{k,l}). Id 0 is background."""

    instance_id: int
    points: Float32
    """[N, 3] its labelled points, world."""
    colors: UInt8
    """[N, 3] RGB."""
    point_confidence: Float32
    """[N] share of votes."""
    point_part: Int32
    """[N] part of the instance, 0 = the whole."""
    confidence: float
    """Probability that it is one whole thing."""
    origin: UInt8
    """[V] where the mask came from: FOUND, PROMPTED, REFINED or DRAWN."""
    weak: bool
    """Seen in too few views to be reconstructed: kept as points only."""


@dataclass(frozen=True)
class PartMasks(ViewMasks):
    """One part of an instance, where the finished scene shows it; exclusive between parts."""

    instance_id: int
    part_id: int
    """1.. within the instance, as `Gaussians.part_id`."""


FOUND, PROMPTED, REFINED, DRAWN = 0, 1, 2, 3
"""Where an instance's mask came from: the view's own masks, the segmenter when asked again, refinement in Splat, or the
instance's points in the view."""


@dataclass(frozen=True)
class Gaussians:
    """3D Gaussians with an instance id each."""

    means: Float32
    """[N, 3] world."""
    quaternions: Float32
    """[N, 4] w x y z; of unit length where they were trained here, of any but 0 where a file brought them."""
    log_scales: Float32
    """[N, 3] natural logarithm of the standard deviations, world units."""
    opacity_logits: Float32
    """[N]."""
    sh: Float32
    """[N, (degree + 1)^2, 3] spherical-harmonic coefficients of the colour; colour = 0.5 + sum of basis * sh."""
    instance_id: Int32
    """[N] 0 = background."""
    instance_conf: Float32
    """[N] 0..1."""
    part_id: Int32
    """[N] part of the instance, 0 = the whole."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Of the spherical harmonics."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def opacities(self) -> Float64:
        """[N] 0..1."""
        return 1 / (1 + np.exp(-self.opacity_logits.astype(np.float64)))

    @property
    def unit_quaternions(self) -> Float32:
        """[N, 4] w x y z, of unit length; those that are so already are the same to the bit."""
        length = np.linalg.norm(self.quaternions, axis=1, keepdims=True)
        return np.where(np.abs(length - 1) < 1e-6, self.quaternions, self.quaternions / np.maximum(length, 1e-12))


@dataclass(frozen=True)
class EditedScene(Gaussians):
    """A scene that was edited after it was made."""

    filled: UInt8
    """[N] 1 for Gaussians that fill a hole: guessed from what lies around it, measured by no view."""


@dataclass(frozen=True)
class Descriptors:
    """The semantic descriptor of one instance (Split&Splat, Sec. 5.2: f_obj)."""

    instance_id: int
    embedding: Float32
    """[D] unit length; zeros when no view showed the instance well enough."""
    views: tuple[str, ...]
    """[V] names of the views that went in."""
    weights: Float32
    """[V] visible area of the instance in each of them, in pixels; 1 each where views weigh the same."""
    encoder: str
    """Name of the text-image encoder."""
    vectors: Float32
    """[V, D] of unit length, what the encoder says of each view."""


@dataclass(frozen=True)
class PartDescriptors(Descriptors):
    """The semantic descriptor of one part of an instance."""

    part_id: int
    """1.. within the instance."""


NO_VECTOR, FROM_PICTURES, FROM_NEIGHBOURS = 0, 1, 2
"""Where the vector of a Gaussian comes from."""


@dataclass(frozen=True)
class DenseDescriptors:
    """A vector for each of some Gaussians (Split&Splat, appendix "Dense Semantic Embeddings")."""

    instance_id: Int32
    """[N] of the Gaussians, in their order."""
    features: Float32
    """[N, D] of no particular length; zeros where there is none."""
    origin: UInt8
    """[N] NO_VECTOR, FROM_PICTURES, or FROM_NEIGHBOURS where no picture shows the Gaussian."""
    network: str
    """Name of the network."""


@dataclass(frozen=True)
class Appearances(ViewLists):
    """Which views show which instances: what the steps for one instance depend on."""

    instance_id: Int32
    """[I] ascending, of the rows."""

    def of(self, ids: Int32) -> list[int]:
        """The views that show any of these instances, ascending."""
        return sorted(
            {view for row in np.flatnonzero(np.isin(self.instance_id, ids)).tolist() for view in self.views(row)}
        )


@dataclass(frozen=True)
class LabelMap:
    """Instance ids of one view: ground truth, or a rendering of labelled Gaussians."""

    name: str
    ids: NDArray[np.uint16]
    """[H, W] 0 = background or not annotated."""


@dataclass(frozen=True)
class Metrics:
    """Figures measured against ground truth, as fractions 0..1 unless the name says otherwise."""

    values: dict[str, float]
