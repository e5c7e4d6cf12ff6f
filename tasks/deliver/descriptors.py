"""The vectors of single Gaussians in the output folder: their numbers, and a picture of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ss_flow.tasks.artifacts import NO_VECTOR, Cameras, DenseDescriptors, Float32, Float64, Gaussians
from ss_flow.tasks.gaussians.initialise import SH_ZERO
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import encode_png

_VIEWS = 3
_MAX_WIDTH = 640
_GREY = 0.35
"""Of what has no vector."""


def write_descriptors(folder: Path, scene: Gaussians, dense: DenseDescriptors, cameras: Cameras) -> None:
    """Write descriptors.npz, row by row as scene.ply, and descriptors.png.

    The npz holds `features` [N, D] float16, `origin` [N] uint8 (0 no vector, 1 from pictures, 2 from neighbours),
    `instance_id` [N] int32, and `network`, the name of what made them.
    """
    np.savez(
        folder / "descriptors.npz",
        features=dense.features.astype(np.float16),
        origin=dense.origin,
        instance_id=dense.instance_id,
        network=np.array(dense.network),
    )
    (folder / "descriptors.png").write_bytes(encode_png(descriptor_picture(scene, dense, cameras)).tobytes())


def descriptor_picture(scene: Gaussians, dense: DenseDescriptors, cameras: Cameras) -> np.ndarray:
    """The scene from three of its input views, coloured by its vectors: [H, 3 W, 3] RGB.

    Like colours are like vectors; the background is grey.
    """
    coloured = replace(scene, sh=((principal_colours(dense) - 0.5) / SH_ZERO)[:, None].astype(np.float32))
    chosen = np.unique(np.linspace(0, len(cameras) - 1, _VIEWS).round().astype(int))
    first = camera_of(cameras, int(chosen[0]))
    shrink = min(1.0, _MAX_WIDTH / first.width)
    size = max(1, round(first.width * shrink)), max(1, round(first.height * shrink))
    shown = [camera_of(cameras, int(view)).fitted(first.width, first.height).scaled(*size) for view in chosen]
    views = [render(coloured, camera).rgb for camera in shown]
    return np.asarray(np.clip(np.concatenate(views, axis=1), 0, 1) * 255 + 0.5, np.uint8)


def principal_colours(dense: DenseDescriptors) -> Float32:
    """[N, 3] 0..1 the vectors' first three principal components as red, green and blue; grey where there is none."""
    colours = np.full((len(dense.origin), 3), _GREY, np.float32)
    known = dense.origin != NO_VECTOR
    if known.sum() < 2:
        return colours
    centred = dense.features[known].astype(np.float64)
    centred -= centred.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1][:, :3]
    # The sign of an axis is a matter of chance: its largest entry is made positive.
    axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(axes.shape[1])])
    shares: Float64 = centred @ axes
    low, high = np.quantile(shares, (0.02, 0.98), axis=0)
    scaled = np.clip((shares - low) / np.maximum(high - low, 1e-12), 0, 1)
    colours[known, : scaled.shape[1]] = scaled
    return colours
