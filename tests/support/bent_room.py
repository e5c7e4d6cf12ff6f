"""Photos as a lens shows them that bends lines."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from ss_flow.flows.generated import Room


def straight_places(intrinsics: tuple[float, float, float, float], width: int, height: int, radial: float):
    """[H, W, 2] integer-centred (u, v): what a pinhole shows there, a lens of the same intrinsics (fx, fy, cx, cy) and
    such a first radial coefficient shows at a pixel."""
    fx, fy, cx, cy = intrinsics
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1, dtype=np.float64).reshape(-1, 1, 2)
    return cv2.undistortPoints(pixels, matrix, np.array([radial, 0, 0, 0]), P=matrix).reshape(height, width, 2)


def bent(room: Room, radial: float, depth: bool = False) -> Room:
    """The room with photos and ids of a lens of such a first radial coefficient; depth: with its depth, too."""
    height, width = room.ids[0].shape
    places = straight_places(room.cameras.intrinsics[0], width, height, radial)
    column, row = np.rint(places).astype(int).transpose(2, 0, 1)
    shown = row.clip(0, height - 1), column.clip(0, width - 1)
    measured = room.depth[:, *shown] if depth else room.depth
    return replace(room, rgb=room.rgb[:, *shown], ids=room.ids[:, *shown], depth=measured)


def least_fit(room: Room, name: str, masks: np.ndarray) -> float:
    """The least IoU, over the large things of a view of a room, with the best of some masks [N, H, W] of it."""
    ids = room.ids[room.cameras.names.index(name)]
    large = [i for i in np.unique(ids[ids > 0]) if (ids == i).sum() > 1000]
    return min(max((mask & (ids == i)).sum() / (mask | (ids == i)).sum() for mask in masks) for i in large)
