"""A generated room as a capture whose photos differ in size and shape, as those of a phone held either way do."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from tiny_runs import write_room


def write_mixed_room(folder: Path) -> Path:
    """The tiny room in nerfstudio's layout, with depth, masks and truth: of its photos every second is upright, cut
    out of the middle, and every third is smaller."""
    plain = write_room(folder.parent / f"{folder.name}-plain")
    lens = np.loadtxt(plain / "intrinsic/intrinsic_color.txt")
    folders = {"color": "images", "depth": "depth", "instance_masks": "instance_masks", "instance": "instance"}
    for name in folders.values():
        (folder / name).mkdir(parents=True)
    frames = []
    for view, photo in enumerate(sorted((plain / "color").iterdir())):
        height, width = cv2.imread(str(photo)).shape[:2]
        left, right = (width // 4, width - width // 4) if view % 2 else (0, width)
        scale = 0.75 if view % 3 == 2 else 1.0
        size = (round((right - left) * scale), round(height * scale))
        for name, to in folders.items():
            (file,) = (plain / name).glob(f"{photo.stem}.*")
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[:, left:right]
            how = cv2.INTER_AREA if name == "color" else cv2.INTER_NEAREST_EXACT
            cv2.imwrite(str(folder / to / f"{photo.stem}.png"), cv2.resize(image, size, interpolation=how))
        frames.append(
            {
                "file_path": f"images/{photo.stem}.png",
                "depth_file_path": f"depth/{photo.stem}.png",
                "transform_matrix": (np.loadtxt(plain / f"pose/{photo.stem}.txt") @ np.diag([1, -1, -1, 1])).tolist(),
                **dict(zip(("w", "h"), size, strict=True)),
                "fl_x": lens[0, 0] * scale,
                "fl_y": lens[1, 1] * scale,
                "cx": (lens[0, 2] - left) * scale,
                "cy": lens[1, 2] * scale,
            }
        )
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    (folder / "instances.json").write_bytes((plain / "instances.json").read_bytes())
    return folder
