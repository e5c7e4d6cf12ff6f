"""How structure from motion grows: processor seconds of each step, and memory, at 50, 100, 200 and 400 photos.

    python tests/bench/bench_growth.py [--photos 50 100 200 400] [--width 200]

A walk along a wall with boxes before it, 5 cm a photo, taken in random order under random names, so that no name helps
to choose pairs. The photos are added one by one, without the engine; mapping is done anew at each number. Printed:
pairs that are matched; CPU seconds so far of features, of choosing pairs and of matching, and those of mapping; the
peak of memory so far; how many photos found their pose, and how far these lie from their true places, in metres.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections import defaultdict
from collections.abc import Callable
from functools import cache
from typing import TypeVar

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ss_flow.tasks.artifacts import Cameras, Float32, Float64, Frame
from ss_flow.tasks.capture.features import features
from ss_flow.tasks.capture.matches import match
from ss_flow.tasks.capture.pairs import PairParams, look, partners
from ss_flow.tasks.capture.sfm import sfm
from ss_flow.tasks.geometry.cameras import Camera, cameras_by_view, looking
from ss_flow.tasks.geometry.images import encode_png

T = TypeVar("T")

STEP = 0.05
"""Metres from photo to photo."""
PERIOD, GRID = 21.0, 63
SURFACES = ((2.6, 1), (3.3, 2), (4.0, 3))
"""Distance of each, and what its texture is made from: two rows of boxes before a wall."""


@cache
def grid(salt: int, octave: int) -> Float32:
    size = GRID * 2**octave
    return np.random.default_rng((salt, octave)).uniform(-1, 1, (size, size)).astype(np.float32)


def texture(x: Float64, y: Float64, salt: int) -> Float64:
    """Noise in four octaves at places in metres, the same for the same `salt`; it repeats after PERIOD metres."""
    value = np.zeros_like(x)
    for octave in range(4):
        scale = GRID * 2**octave / PERIOD
        place = [np.asarray(t % PERIOD * scale, np.float32) for t in (x, y)]
        value += cv2.remap(grid(salt, octave), *place, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP) / 1.6**octave
    return value


def photo(name: str, camera: Camera) -> Frame:
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    rays = local @ camera.world_to_camera[:3, :3]
    nearest, gray = np.full(u.shape, np.inf), np.zeros(u.shape)
    for z, salt in SURFACES:
        distance = (z - camera.center[2]) / rays[..., 2]
        x, y, _ = np.moveaxis(camera.center + distance[..., None] * rays, -1, 0)
        is_box = (np.abs((x + 1.7 * salt) % 3.4 - 1.7) < 0.55) & (np.abs(y) < 0.7)
        shown = (is_box | (z == SURFACES[-1][0])) & (distance > 0) & (distance < nearest)
        nearest, gray = np.where(shown, distance, nearest), np.where(shown, texture(x, y, salt), gray)
    level = np.clip(128 + 50 * gray, 0, 255)
    image = np.stack([level, level * 0.8, 255 - level], axis=-1).astype(np.uint8)
    return Frame(
        name, camera.width, camera.height, encode_png(image), np.zeros(0, np.uint8), camera.width, camera.height
    )


def walk(row: int, width: int, random: np.random.Generator) -> Camera:
    """The camera of one photo; each fifty of them cover the next part of the wall, in mixed order."""
    x = STEP * (row // 50 * 50 + row * 17 % 50)
    eye = np.array([x, *random.uniform(-0.3, 0.3, 2)])
    gaze = np.array([x + random.uniform(-0.4, 0.4), 0, 4]) - eye
    pose = looking(eye, gaze / np.linalg.norm(gaze), np.array([0.0, -1.0, 0.0]))
    height, focal = width * 3 // 4, 0.95 * width
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def distances(found: Cameras, truth: dict[str, Camera]) -> Float64:
    """How far the places of cameras lie from the true ones, after the best similarity."""
    places = np.array([c.center for c in cameras_by_view(found)])
    true = np.array([truth[name].center for name in found.names])
    mean, true_mean = places.mean(axis=0), true.mean(axis=0)
    turn, _ = Rotation.align_vectors(true - true_mean, places - mean)
    turned = turn.apply(places - mean)
    scale = (turned * (true - true_mean)).sum() / (turned**2).sum()
    return np.linalg.norm(scale * turned + true_mean - true, axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, nargs="+", default=[50, 100, 200, 400])
    parser.add_argument("--width", type=int, default=200)
    options = parser.parse_args()
    params, random, seconds = PairParams(), np.random.default_rng(0), defaultdict[str, float](float)

    def timed(step: str, work: Callable[[], T]) -> T:
        begun = time.process_time()
        result = work()
        seconds[step] += time.process_time() - begun
        return result

    truth, found, looks, matches, pairs = {}, [], [], [], 0
    for row in range(max(options.photos)):
        name = "".join(random.choice(list("abcdefghij"), 8))
        truth[name] = walk(row, options.width, random)
        frame = photo(name, truth[name])
        found.append(timed("features", lambda frame=frame: features(frame)))
        looks.append(look(found[row], count=params.look_features))
        chosen = timed("choice", lambda: partners(looks[-1], looks[:-1], place=len(looks) - 1, params=params)).row
        others = [found[k] for k in chosen]
        matches.append(timed("matching", lambda others=others: match(found[-1], others)))
        pairs += len(chosen)
        if row + 1 in options.photos:
            seconds["mapping"] = 0
            cameras = timed("mapping", lambda: sfm(found, tuple(matches), ()))
            off = distances(cameras, truth)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
            steps = ", ".join(f"{step} {spent:.1f}" for step, spent in seconds.items())
            print(f"{row + 1} photos: {pairs} pairs; CPU s: {steps}; {peak} MB; {len(cameras)} placed,", end=" ")
            print(f"off by {np.median(off):.4f}, at most {off.max():.4f}", flush=True)


if __name__ == "__main__":
    main()
