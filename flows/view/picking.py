"""Which instance a click meets: the one that weighs most in the clicked pixel."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ss_flow.flows.view.session import Piece
from ss_flow.tasks.artifacts import EditedScene, Float64
from ss_flow.tasks.gaussians.initialise import concatenate, select
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera

_REACH = 3.4
"""In standard deviations: exp(-3.4^2 / 2) is below 1/255, what counts at the highest opacity."""
_BLUR = 0.3
"""Squared pixels that the rasterizer widens a Gaussian by on the screen."""


class Picker:
    """The Gaussians that are shown, ready to be asked about many pixels."""

    def __init__(self, pieces: Mapping[int, Piece]) -> None:
        """pieces: those that are shown."""
        shown = [piece.gaussians for piece in pieces.values()]
        self._scene: EditedScene | None = concatenate(shown) if shown else None
        self._sigma = np.exp(self._scene.log_scales.max(axis=1)) if self._scene is not None else np.zeros(0)

    def met(self, pixel: Camera) -> tuple[int, Float64] | None:
        """The instance with the largest weight in a picture's pixel, and the place [3] on the ray, world, that is as
        deep as the middle of its Gaussian with the largest; None where nothing is.

        pixel: the picture's camera, cropped to the one pixel: what is drawn in it does not depend on the others.
        """
        if self._scene is None:
            return None
        near = select(self._scene, self._rows_near(pixel))
        ids = np.unique(near.instance_id)
        drawn = render(near, pixel, label_ids=ids.tolist())
        if not drawn.max_contribution.any():
            return None
        instance = int(ids[drawn.label_masks[:, 0, 0].argmax()])
        row = int(np.where(near.instance_id == instance, drawn.max_contribution, -1).argmax())
        turn = pixel.world_to_camera[:3, :3]
        depth = turn[2] @ near.means[row] + pixel.world_to_camera[2, 3]
        ray = np.array([(0.5 - pixel.cx) / pixel.fx, (0.5 - pixel.cy) / pixel.fy, 1.0])
        return instance, pixel.center + depth * (ray @ turn)

    def _rows_near(self, pixel: Camera) -> NDArray[np.intp]:
        """The rows that may reach the pixel: all others are spared the rendering.

        With t = (x, y) / z, the screen covariance of a Gaussian is at most (focal sigma / z)^2 (1 + |t|^2) in any
        direction (EWA splatting), and the blur.
        """
        assert self._scene is not None
        pose = pixel.world_to_camera.astype(np.float32)
        local = self._scene.means @ pose[:3, :3].T + pose[:3, 3]
        ahead = np.flatnonzero(local[:, 2] > NEAR_PLANE)
        depth = local[ahead, 2]
        t = local[ahead, :2] / depth[:, None]
        away = np.linalg.norm(pixel.fx * t + np.array([pixel.cx - 0.5, pixel.cy - 0.5], np.float32), axis=1)
        variance = (pixel.fx * self._sigma[ahead] / depth) ** 2 * (1 + (t * t).sum(axis=1)) + _BLUR
        return ahead[away < 1 + _REACH * np.sqrt(variance)]


def pixel_met(origin: Float64, direction: Float64, wxyz: Float64, focal: float, size: tuple[int, int]) -> Camera | None:
    """The pixel of a picture that a ray goes through; None for a ray that points away from it.

    origin: [3] where the camera stands, world. direction: [3] the ray, world, of any length but 0. wxyz: [4] the
    camera's turn, camera-to-world. focal: the picture's focal length, pixels. size: its width and height, pixels.
    """
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(wxyz, scalar_first=True).as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ origin
    x, y, z = pose[:3, :3] @ (direction / np.abs(direction).max())
    if z <= 0:
        return None
    right, lower = np.array(size) / (2 * focal)
    borders = (float(-right), float(-lower), float(right), float(lower))
    return Camera(1, 1, focal, focal, 0.5 - focal * x / z, 0.5 - focal * y / z, pose, borders)
