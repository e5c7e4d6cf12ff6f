"""Copies of captures that are worse than they were, in the ways in which captures are."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from bent_room import straight_places


def altered(capture: Path, name: str, change: Callable[[Path], object], place: Path | None = None) -> Path:
    """A copy of a capture, changed where it lies: in a place, or beside the capture; made first if it is not there."""
    folder = (place or capture.parent) / f"{capture.name}-{name}"
    if not folder.exists():
        shutil.copytree(capture, folder)
        change(folder)
    return folder


def lay_down(folder: Path) -> None:
    """Turn photos, and all else, on their right side."""
    for file in (*folder.rglob("*.jpg"), *folder.rglob("*.png")):
        quality = [cv2.IMWRITE_JPEG_QUALITY, 98] if file.suffix == ".jpg" else []
        cv2.imwrite(str(file), np.ascontiguousarray(np.rot90(read_image(file), -1)), quality)
    for file in folder.glob("pose/*.txt"):
        pose = np.loadtxt(file)
        pose[:3, :2] = np.column_stack([-pose[:3, 1], pose[:3, 0]])
        np.savetxt(file, pose)
    for file in folder.glob("intrinsic/intrinsic_*.txt"):
        matrix = np.loadtxt(file)
        (fx, _, cx), (_, fy, cy) = matrix[:2, :3]
        width = read_image(next((folder / file.stem.removeprefix("intrinsic_")).iterdir())).shape[1]
        matrix[:2, :3] = (fy, 0, width - 1 - cy), (0, fx, cx)
        np.savetxt(file, matrix)


def shake(folder: Path, off: str, drift: bool) -> None:
    """Make poses inexact. off: millimetres and degrees, with a comma between them."""
    metres, angle = np.array([float(number) for number in off.split(",")]) / (1000, 180 / np.pi) / np.sqrt(3)
    turned, moved, noise = np.eye(3), np.zeros(3), np.random.default_rng(7)
    for file in sorted(folder.glob("pose/*.txt")):
        turn, step = cv2.Rodrigues(angle * noise.normal(size=3))[0], metres * noise.normal(size=3)
        turned, moved = (turn @ turned, moved + step) if drift else (turn, step)
        pose = np.loadtxt(file)
        pose[:3, :3] @= turned
        pose[:3, 3] += moved
        np.savetxt(file, pose)


def enlarge(folder: Path, factor: float) -> None:
    """Give depth another scale than the poses have."""
    for file in folder.glob("depth/*.png"):
        depth = read_image(file)
        cv2.imwrite(str(file), np.rint(depth * factor).astype(depth.dtype))


def bend(folder: Path, radial: float) -> None:
    """Photos, and what is drawn on them, as a lens of such a first radial coefficient shows them; depth stays that of a
    pinhole."""
    fx, fy, cx, cy = np.loadtxt(folder / "intrinsic" / "intrinsic_color.txt")[[0, 1, 0, 1], [0, 1, 2, 2]]
    for place, how in (("color", cv2.INTER_LANCZOS4), ("instance", cv2.INTER_NEAREST), ("part", cv2.INTER_NEAREST)):
        for file in sorted((folder / place).iterdir()):
            image = read_image(file)
            height, width = image.shape[:2]
            source = straight_places((fx, fy, cx + 0.5, cy + 0.5), width, height, radial).astype(np.float32)
            quality = [cv2.IMWRITE_JPEG_QUALITY, 95] if file.suffix == ".jpg" else []
            cv2.imwrite(str(file), cv2.remap(image, source, None, how, borderMode=cv2.BORDER_REPLICATE), quality)


def zoom(folder: Path, factor: float) -> None:
    """State focal lengths so many times as long as they are."""
    for file in folder.glob("intrinsic/intrinsic_*.txt"):
        matrix = np.loadtxt(file)
        matrix[[0, 1], [0, 1]] *= factor
        np.savetxt(file, matrix)


def reach_in(folder: Path, every: int = 1) -> np.ndarray:
    """Let an arm reach into every so many photos, elsewhere in each, nearer than all that it hides; it is no instance.

    Returns where it is: [photos, H, W].
    """
    random = np.random.default_rng(3)
    photos = sorted(folder.glob("color/*"))
    height, width = read_image(photos[0]).shape[:2]
    arms = np.zeros((len(photos), height, width), np.uint8)
    for photo, arm in zip(photos[::every], arms[::every], strict=True):
        start = np.array([random.uniform(0.1, 0.9) * width, height - 1])
        tip = np.array([start[0] + random.normal(0, 0.12) * width, 0.6 * height])
        cv2.line(arm, *(tuple(map(int, end)) for end in (start, tip)), 1, int(0.11 * height))
        cv2.circle(arm, tuple(map(int, tip)), int(0.085 * height), 1, -1)
        image, inside = read_image(photo).astype(np.float32), arm > 0
        shade = 0.55 + 0.5 * cv2.GaussianBlur(arm.astype(np.float32), (0, 0), 8)[..., None]
        skin = np.array([120.0, 150.0, 205.0]) * shade + random.normal(0, 4, image.shape)
        image[inside] = skin[inside]
        cv2.imwrite(str(photo), np.clip(image, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 95])
        for kind in ("depth", "instance", "instance_masks", "part"):
            file = folder / kind / f"{photo.stem}.png"
            if file.exists():
                values = read_image(file)
                there = cv2.resize(arm, values.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
                known = values[there & (values > 0)]
                values[there] = 0.7 * known.min() if kind == "depth" and len(known) else 0
                cv2.imwrite(str(file), values)
    return arms > 0


def darken(folder: Path) -> None:
    """Photos half as bright, blurred by a pixel, with noise of 8 grey values, as JPEG of quality 85."""
    noise = np.random.default_rng(3)

    def change(photo: np.ndarray) -> np.ndarray:
        return 0.5 * cv2.GaussianBlur(photo, (0, 0), 1.0) + noise.normal(0, 8, photo.shape)

    _change_photos(folder, change, 85)


def add_noise(folder: Path, deviation: float) -> None:
    """Photos with noise of so many grey values, as JPEG of quality 90."""
    noise = np.random.default_rng(5)
    _change_photos(folder, lambda photo: photo + noise.normal(0, deviation, photo.shape), 90)


def expose_each(folder: Path) -> None:
    """Each photo at an exposure (a quarter more or less, in general) and a white balance (6 %) of its own."""
    noise = np.random.default_rng(3)

    def change(photo: np.ndarray) -> np.ndarray:
        return photo * np.exp(noise.normal(0, 0.25)) * np.exp(noise.normal(0, 0.06, 3))

    _change_photos(folder, change, 95)


def _change_photos(folder: Path, change: Callable[[np.ndarray], np.ndarray], quality: int) -> None:
    for file in sorted(file for place in ("color", "images") for file in (folder / place).glob("*.jpg")):
        photo = change(read_image(file).astype(np.float32))
        cv2.imwrite(str(file), np.clip(photo, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])


def read_image(path: Path) -> np.ndarray:
    """An image as its file has it, of any depth."""
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
