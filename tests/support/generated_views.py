"""A textured scene whose depth is known exactly: a wall and a box before it, ray-cast from any camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame
from ss_flow.tasks.capture.features import features
from ss_flow.tasks.capture.matches import match
from ss_flow.tasks.capture.pose_fit import pose_pairs
from ss_flow.tasks.geometry.cameras import Camera, looking
from ss_flow.tasks.geometry.images import encode_png


def looking_at(eye, target) -> np.ndarray:
    """World-to-camera of a camera at `eye`; world y points down."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    return looking(eye, forward, np.array([0.0, -1.0, 0.0]))


def _texture(u, v, salt):
    """Value noise of four octaves: smooth, random, without repetition."""
    random = np.random.default_rng(salt)
    value = np.zeros_like(u)
    for octave in range(4):
        grid = random.uniform(-1, 1, (64, 64))
        x, y = u * 3 * 2**octave, v * 3 * 2**octave
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        a, b = x - i, y - j
        a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
        corner = [grid[(j + dj) % 64, (i + di) % 64] for dj in (0, 1) for di in (0, 1)]
        top, bottom = corner[0] * (1 - a) + corner[1] * a, corner[2] * (1 - a) + corner[3] * a
        value += (top * (1 - b) + bottom * b) / 1.6**octave
    return value


def render(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """RGB [H, W, 3] uint8 and z-depth [H, W]: a slanted wall near z = 4, and a square of side 1.6 at z = 2.5."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    rays = local @ camera.world_to_camera[:3, :3]
    eye = camera.center
    normal, offset = np.array([0.2, 0.1, 1.0]), 4.0
    wall = (offset - eye @ normal) / (rays @ normal)
    box = (2.5 - eye[2]) / rays[..., 2]
    on_box = eye + box[..., None] * rays
    hit = (np.abs(on_box[..., :2]) < 0.8).all(axis=-1) & (box > 0)
    depth = np.where(hit, box, wall)
    point = eye + depth[..., None] * rays
    gray = np.where(hit, _texture(point[..., 0], point[..., 1], 1), _texture(point[..., 0], point[..., 1], 2))
    level = np.clip(128 + 50 * gray, 0, 255)
    return np.stack([level, level * 0.8, 255 - level], axis=-1).astype(np.uint8), depth


def around(items, view):
    """One view's of some items, then the others': as the steps take them that compare a view with its neighbours."""
    return (items[view], *(item for k, item in enumerate(items) if k != view))


def views(eyes, width=160, height=120, focal=150.0):
    """Frames, cameras and the true depth maps of the scene, seen from some places."""
    cameras = [
        Camera(width, height, focal, focal, width / 2, height / 2, looking_at(np.array(eye, float), (0.0, 0.0, 3.5)))
        for eye in eyes
    ]
    rendered = [render(c) for c in cameras]
    none = np.zeros(0, np.uint8)
    frames = tuple(
        Frame(f"view{k}", width, height, encode_png(image), none, width, height)
        for k, (image, _) in enumerate(rendered)
    )
    artifact = Cameras(
        names=tuple(f.name for f in frames),
        sizes=np.array([(width, height)] * len(frames), np.int32),
        intrinsics=np.array([(focal, focal, width / 2, height / 2)] * len(frames)),
        world_to_camera=np.stack([c.world_to_camera for c in cameras]),
        metric=True,
    )
    return frames, artifact, [depth for _, depth in rendered]


def compared():
    """The cameras of eight views, and what `pose_fit` takes: pairs, features, matches and the true depth."""
    eyes = [(x, y, 0.1 * x) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.3, 0.3)]
    frames, cameras, depths = views(eyes, width=320, height=240, focal=300.0)
    pairs = pose_pairs(cameras)[-1]
    photos = [features(frames[row]) for row in pairs.view]
    matches = [match(photos[a], [photos[b]]) for a, b in pairs.pair]
    measured = [DepthMap(cameras.names[row], depths[row].astype(np.float32), "sensor") for row in pairs.view]
    return cameras, pairs, photos, matches, measured


def jittered(cameras, distance, degrees):
    """The cameras with poses that are off by so much on (quadratic) average."""
    import cv2

    rng = np.random.default_rng(0)
    poses = cameras.world_to_camera.copy()
    for pose in poses:
        off = np.eye(4)
        off[:3, :3] = cv2.Rodrigues(np.radians(rng.normal(0, degrees / np.sqrt(3), 3)))[0]
        off[:3, 3] = rng.normal(0, distance / np.sqrt(3), 3)
        pose[:] = off @ pose
    return replace(cameras, world_to_camera=poses)
