"""Changes of a finished scene, each a pure task: edited Gaussians in, edited Gaussians out.

Ids are resolved before (`flows/edit_script.py`): an operation meets no instance that is not there. Rows that an
operation does not name are the same to the bit afterwards, in the same order; new ones come last.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Bool, EditedScene, Float64, Gaussians
from ss_flow.tasks.gaussians.harmonics import rotated
from ss_flow.tasks.gaussians.initialise import SH_ZERO, concatenate, select
from ss_flow.tasks.geometry.shape import box_diagonal

_LUMA = (0.2126, 0.7152, 0.0722)
"""Rec. 709."""
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Motion:
    """A similarity: x goes to pivot + scale * R (x - pivot) + move, with R a rotation about `axis`."""

    move: Vector = (0.0, 0.0, 0.0)
    """World units."""
    axis: Vector = (0.0, 0.0, 1.0)
    """World, of any length but 0."""
    degrees: float = 0.0
    """By the right-hand rule."""
    scale: float = 1.0
    pivot: Vector | None = None
    """World; None is the mean of the centres of what is moved (`centroid` of instances.json)."""


@task(name="edit.begin")
def begin(scene: Gaussians) -> EditedScene:
    """A finished scene as the first of a chain of edits."""
    return edited(scene, filled=0)


@task(name="edit.remove")
def remove(scene: EditedScene, *, instances: tuple[int, ...]) -> EditedScene:
    """The scene without some instances."""
    return select(scene, ~np.isin(scene.instance_id, instances))


@task(name="edit.keep")
def keep(scene: EditedScene, *, instances: tuple[int, ...]) -> EditedScene:
    """The scene with nothing but some instances."""
    return select(scene, np.isin(scene.instance_id, instances))


@task(name="edit.duplicate")
def duplicate(scene: EditedScene, *, instance: int, new_id: int, motion: Motion) -> EditedScene:
    """The scene with one instance a second time, moved, under a new id."""
    copy = moved(select(scene, scene.instance_id == instance), motion)
    return concatenate([scene, replace(copy, instance_id=np.full(len(copy), new_id, np.int32))])


@task(name="edit.transform")
def transform(scene: EditedScene, *, instances: tuple[int, ...], motion: Motion) -> EditedScene:
    """The scene with some instances moved as one."""
    own = np.isin(scene.instance_id, instances)
    return with_rows(scene, own, moved(select(scene, own), motion))


@task(name="edit.recolour")
def recolour(scene: EditedScene, *, instances: tuple[int, ...], color: tuple[int, int, int]) -> EditedScene:
    """The scene with some instances in another colour, light and shade kept.

    color: RGB 0..255, what the instances have on the mean afterwards. In every direction a Gaussian gets this colour
    times its own luma over the mean luma; the mean is weighted by opacity and by the area of the two longest axes. An
    instance that is black all over has no light and shade to keep and becomes evenly coloured.
    """
    own = np.isin(scene.instance_id, instances)
    part = select(scene, own)
    sh = part.sh.astype(np.float64)
    sh[:, 0] += 0.5 / SH_ZERO  # so that the sum of basis * sh is the colour itself
    luma = sh @ np.array(_LUMA)
    area = np.exp(np.sort(part.log_scales.astype(np.float64), axis=1)[:, 1:].sum(axis=1))
    weights = part.opacities * area
    mean = float((luma[:, 0] * weights).sum() / max(weights.sum(), 1e-30)) * SH_ZERO
    if mean < 1 / 255:
        luma, mean = np.zeros_like(luma), SH_ZERO
        luma[:, 0] = 1
    sh = luma[..., None] / mean * (np.array(color) / 255)
    sh[:, 0] -= 0.5 / SH_ZERO
    return with_rows(scene, own, replace(part, sh=sh.astype(np.float32)))


@task(name="edit.read_object")
def read_object(*, file: FileRef) -> Gaussians:
    """The Gaussians of a PLY file. Raises InputError when it holds none."""
    from ss_flow.tasks.gaussians.read_ply import read_gaussians

    found = read_gaussians(file.path)
    if not len(found):
        raise InputError(f"{file.path} holds no Gaussians; name the PLY file of an object.")
    return found


@task(name="edit.replace")
def put_in_place(
    scene: EditedScene,
    other: Gaussians,
    *,
    instance: int,
    new_id: int,
    scale: float | None,
    turn: tuple[Vector, float],
) -> EditedScene:
    """The scene with another object, under a new id, in the place of an instance.

    The mean of its centres comes to lie where that of the instance was. scale: factor on its size; None makes the
    diagonal of its box (trimmed by 0.5 % on every side) that of the instance. turn: axis and degrees of a rotation into
    the scene's axes, which comes first.
    """
    old = scene.instance_id == instance
    other = moved(edited(other, filled=0), Motion(axis=turn[0], degrees=turn[1]))
    factor = _size(select(scene, old)) / _size(other) if scale is None else scale
    way = _centre(scene.means[old]) - _centre(other.means)
    placed = moved(other, Motion(move=vector(way), scale=float(factor)))
    renamed = replace(placed, instance_id=np.full(len(placed), new_id, np.int32))
    return concatenate([select(scene, ~old), renamed])


@task(name="edit.relabel")
def relabel(scene: EditedScene, *, rows: tuple[tuple[int, int, int, int], ...]) -> EditedScene:
    """The scene with other ids: what merging and splitting come to.

    rows: (instance_id, part_id, new instance_id, new part_id), each pair of old ids once.
    """
    instance_id, part_id = scene.instance_id.copy(), scene.part_id.copy()
    for old, old_part, new, new_part in rows:
        own = (scene.instance_id == old) & (scene.part_id == old_part)
        instance_id[own], part_id[own] = new, new_part
    return replace(scene, instance_id=instance_id, part_id=part_id)


def smallest_turn(one: Vector, other: Vector) -> tuple[Vector, float]:
    """Axis and degrees of the smallest rotation that takes one direction to another; both of length 1."""
    axis, cosine = np.cross(one, other), float(np.dot(one, other))
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:  # the same or opposite: about any axis across
        axis = np.cross(one, np.eye(3)[np.argmin(np.abs(one))])
    return vector(axis), float(np.degrees(np.arctan2(sine, cosine)))


def moved(part: EditedScene, motion: Motion) -> EditedScene:
    """Gaussians after a similarity: centres, orientations, sizes, and the directions of their colours."""
    from scipy.spatial.transform import Rotation

    axis = np.array(motion.axis) / np.linalg.norm(motion.axis)
    turn = Rotation.from_rotvec(np.radians(motion.degrees) * axis)
    pivot = _centre(part.means) if motion.pivot is None else np.array(motion.pivot)
    local = part.means.astype(np.float64) - pivot
    turns = motion.degrees % 360 != 0
    means = pivot + motion.scale * (turn.apply(local) if turns else local) + np.array(motion.move)
    changed = {"means": means.astype(np.float32)}
    if turns:
        own = Rotation.from_quat(part.quaternions, scalar_first=True)
        changed["quaternions"] = (turn * own).as_quat(scalar_first=True).astype(np.float32)
        changed["sh"] = rotated(part.sh, turn.as_matrix())
    if motion.scale != 1:
        changed["log_scales"] = (part.log_scales + np.log(motion.scale)).astype(np.float32)
    return replace(part, **changed)


def edited(gaussians: Gaussians, *, filled: int) -> EditedScene:
    """Gaussians as part of an edited scene, with one flag for all of them."""
    arrays = {f.name: getattr(gaussians, f.name) for f in fields(Gaussians)}
    return EditedScene(**arrays, filled=np.full(len(gaussians), filled, np.uint8))


def with_rows(scene: EditedScene, rows: Bool, changed: EditedScene) -> EditedScene:
    """The scene with other Gaussians in some rows."""
    arrays = {f.name: getattr(scene, f.name).copy() for f in fields(EditedScene)}
    for name, array in arrays.items():
        array[rows] = getattr(changed, name)
    return EditedScene(**arrays)


def _size(part: Gaussians) -> float:
    """The diagonal of the box of the centres, world units; a single Gaussian is as large as it is itself."""
    return max(box_diagonal(part.means), float(np.exp(part.log_scales.max())))


def _centre(means: NDArray[np.float32]) -> Float64:
    return means.mean(axis=0, dtype=np.float64)


def vector(values: Float64) -> Vector:
    """[3] as a parameter."""
    x, y, z = values.tolist()
    return x, y, z
