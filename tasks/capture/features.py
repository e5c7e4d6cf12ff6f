"""SIFT features of one photo, found by COLMAP; they depend on no other photo."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Float32, Frame, UInt8
from ss_flow.tasks.capture.colmap import load_pycolmap
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, size_within
from ss_flow.tasks.ranges import Count, Positive

UNIT = 512.0
"""Length of a descriptor as COLMAP stores it: the root of a SIFT histogram, in bytes."""


@dataclass(frozen=True)
class FeatureParams:
    """Which features are found."""

    max_features: Count = 4096
    """The most SIFT features a photo, the largest first; comparing two photos takes time as their square."""
    peak_threshold: Positive = 0.003
    """Contrast that a SIFT feature needs; COLMAP's own default, 0.0067, finds too few in dim or blurred rooms."""
    max_image_side: Count = 1600
    """Features are found in photos scaled down to this longer side, in pixels."""


@dataclass(frozen=True)
class Features:
    """The features of one photo, from the largest on."""

    name: str
    width: int
    height: int
    """Size of the frame."""
    points: Float32
    """[N, 2] x, y in pixels of the frame."""
    descriptors: UInt8
    """[N, 128] RootSIFT, of length 512."""
    focal: float = 0.0
    """That of the frame."""

    def light(self) -> Features:
        """Without descriptors, which take most of the memory."""
        return replace(self, descriptors=self.descriptors[:0].copy())  # a view would keep them all


@task(name="capture.features")
def features(frame: Frame, *, params: FeatureParams = FeatureParams()) -> Features:
    """The features of a photo, without those on pixels that do not count."""
    import cv2

    pycolmap = load_pycolmap()
    gray = cv2.cvtColor(decode_rgb(frame), cv2.COLOR_RGB2GRAY)
    size = size_within(params.max_image_side, frame.width, frame.height)
    if size != (frame.width, frame.height):
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.max_image_size = params.max_image_side
    options.sift.max_num_features = params.max_features
    options.sift.peak_threshold = params.peak_threshold
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, found = extractor.extract_from_uint8_array(gray)
    shapes = pycolmap.keypoints_to_matrix(keypoints).reshape(-1, 4)
    points = shapes[:, :2] * np.array([frame.width / gray.shape[1], frame.height / gray.shape[0]], np.float32)
    pixel = np.clip(points.astype(int), 0, (frame.width - 1, frame.height - 1))
    counts = decode_valid(frame)[pixel[:, 1], pixel[:, 0]]
    # By place where sizes are equal: a photo's features never come in another order.
    order = np.lexsort((shapes[:, 0], shapes[:, 1], -shapes[:, 2]))
    rows = order[counts[order]][: params.max_features]
    descriptors = np.asarray(found.data, np.uint8).reshape(-1, 128)
    return Features(frame.name, frame.width, frame.height, points[rows], descriptors[rows], frame.focal)
