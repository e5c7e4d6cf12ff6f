"""What an export comes to, and what formats of Gaussians share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, Float32, Float64, Gaussians, UInt8
from ss_flow.tasks.gaussians.initialise import SH_ZERO, select
from ss_flow.tasks.geometry.cameras import up_of


@dataclass(frozen=True)
class FileContent:
    """A file's content."""

    content: UInt8
    """[n] its bytes."""

    @classmethod
    def of(cls, *parts: bytes) -> FileContent:
        """The parts one after the other."""
        return cls(np.frombuffer(b"".join(parts), np.uint8))


@task(name="deliver.export.chosen")
def chosen(scene: Gaussians, *, instances: tuple[int, ...]) -> Gaussians:
    """The Gaussians of some instances, in the scene's order; of an edited scene with what says which fill holes."""
    return select(scene, np.isin(scene.instance_id, instances))


def base_colors(gaussians: Gaussians) -> Float64:
    """[N, 3] the colour without its change with the direction, RGB; may leave 0..1."""
    return 0.5 + SH_ZERO * gaussians.sh[:, 0].astype(np.float64)


def levels(values: Float32 | Float64, bits: int) -> NDArray[np.uint32]:
    """Values 0..1 as the nearest of 2^bits levels; those outside take the nearer end."""
    top = (1 << bits) - 1
    return np.floor(np.asarray(values, np.float64).clip(0, 1) * top + 0.5).astype(np.uint32)


def smallest_three(quaternions: Float32) -> tuple[NDArray[np.intp], Float64]:
    """Unit quaternions without their largest component: where it stood [N], and the other three in order [N, 3].

    quaternions: [N, 4]. A quaternion and its negative are the same rotation, so the one is taken whose largest
    component is positive; the others lie within 1 / sqrt 2 of zero.
    """
    unit = quaternions / np.maximum(np.linalg.norm(quaternions.astype(np.float64), axis=1, keepdims=True), 1e-12)
    largest = np.abs(unit).argmax(axis=1)
    unit *= np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.arange(3) + (np.arange(3) >= largest[:, None])
    return largest, np.take_along_axis(unit, others, axis=1)


def morton_order(means: Float32) -> NDArray[np.intp]:
    """Rows along a curve that keeps neighbours in space near each other (10 bits an axis); equal places keep theirs."""
    if not len(means):
        return np.zeros(0, np.intp)
    low = means.min(axis=0).astype(np.float64)
    cells = np.floor((means - low) / np.maximum(np.ptp(means, axis=0).astype(np.float64), 1e-12) * 1023.999)
    code = np.zeros(len(means), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis].astype(np.int64) >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def name_of(instance_id: int, names: Mapping[str, str]) -> str:
    """What an instance is called; names: of the instances, by their ids as text."""
    return names.get(str(instance_id), f"object {instance_id}" if instance_id else "background")


def y_up(cameras: Cameras) -> Float64:
    """[4] the rotation, x y z w, that turns the world so that y points up (photos are taken upright).

    Of all such rotations the one by the smallest angle; none where there are no photos.
    """
    if not len(cameras):
        return np.array([0.0, 0.0, 0.0, 1.0])
    up = up_of(cameras.world_to_camera)
    axis, cosine = np.cross(up, (0.0, 1.0, 0.0)), float(up[1])
    if cosine < -1 + 1e-9:  # upside down: half a turn about any level axis
        return np.array([1.0, 0.0, 0.0, 0.0])
    quaternion = np.append(axis, 1 + cosine)
    return quaternion / np.linalg.norm(quaternion)
