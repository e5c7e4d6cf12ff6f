"""A generated room photographed through a strongly distorting lens, with true masks and depth in the photos' pixels.

Where a pixel of a photo looks is worked out here from the formulas of the lens alone, without the code under test.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ss_flow.flows.generated import RoomParams, generate

WIDTH, HEIGHT = 192, 144
FX, FY, CX, CY = 250.0, 245.0, 97.5, 70.25


@dataclass(frozen=True)
class Distortion:
    """A radially symmetric lens, with the longest rays that it can still take."""

    name: str
    k1: float
    k2: float

    def bent(self, radius: np.ndarray) -> np.ndarray:
        """How far from the axis a ray of slope `radius` lands, in focal lengths (OpenCV's documentation)."""
        angle = np.arctan(radius) if self.name == "OPENCV_FISHEYE" else radius
        return angle * (1 + self.k1 * angle**2 + self.k2 * angle**4)


BARREL = Distortion("OPENCV", -0.45, 0.02)
CUSHION = Distortion("OPENCV", 0.9, 0.3)
FISHEYE = Distortion("OPENCV_FISHEYE", -0.4, 0.05)


def rays(distortion: Distortion) -> np.ndarray:
    """[HEIGHT, WIDTH, 2] the slopes x, y of the ray through each pixel's centre, by bisection."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    x, y = (u - CX) / FX, (v - CY) / FY
    landed = np.hypot(x, y)
    low, high = np.zeros_like(landed), np.full_like(landed, 0.75)
    assert (distortion.bent(high) > landed).all() and (np.diff(distortion.bent(np.linspace(0, 0.75, 999))) > 0).all()
    for _ in range(60):
        middle = (low + high) / 2
        below = distortion.bent(middle) < landed
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    stretch = low / np.maximum(landed, 1e-12)
    return np.stack([x * stretch, y * stretch], axis=-1)


def covered(distortion: Distortion) -> np.ndarray:
    """[HEIGHT, WIDTH] which pixels of a photo the pinhole camera of the same intrinsics and size sees."""
    x, y = np.moveaxis(rays(distortion) * (FX, FY) + (CX, CY), -1, 0)
    return (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)


def write_distorted_room(root: Path, distortion: Distortion) -> np.ndarray:
    """Write the room in nerfstudio's layout; returns the true ids, [5, HEIGHT, WIDTH] in the photos' pixels."""
    room = generate(RoomParams(objects=2, views=5, width=480, height=360, held_out=0))
    slopes = rays(distortion)
    frames, ids = [], []
    for k, name in enumerate(room.cameras.names):
        fx, fy, cx, cy = room.cameras.intrinsics[k]
        place = (slopes * (fx, fy) + (cx, cy)).astype(np.float32)
        column, row = np.moveaxis(np.floor(place).astype(int), -1, 0)
        assert column.min() >= 0 and row.min() >= 0 and column.max() < 480 and row.max() < 360
        photo = cv2.remap(room.rgb[k], place - np.float32(0.5), None, cv2.INTER_LINEAR)
        ids.append(room.ids[k][row, column])
        millimetres = np.round(room.depth[k][row, column] * 1000).astype(np.uint16)
        for folder, image in (
            ("images", photo[..., ::-1]),
            ("depth", millimetres),
            ("instance_masks", ids[-1]),
            ("instance", ids[-1]),
        ):
            (root / folder).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / folder / f"{name}.png"), image)
        pose = np.linalg.inv(room.cameras.world_to_camera[k]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "depth_file_path": f"depth/{name}.png",
                "transform_matrix": pose.tolist(),
            }
        )
    lens = {"camera_model": distortion.name, "k1": distortion.k1, "k2": distortion.k2}
    size = {"w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY}
    (root / "transforms.json").write_text(json.dumps({**lens, **size, "frames": frames}))
    return np.stack(ids)
