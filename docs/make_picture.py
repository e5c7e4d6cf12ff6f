"""Draw one view of a finished run: photo, masks, Gaussians by instance, rendering.

`python docs/make_picture.py RUN VIEW FILE.jpg`, where RUN is an output folder and VIEW the name of a photo.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from ss_flow.cache.location import open_store
from ss_flow.tasks.deliver.palette import instance_colors, paint_ids
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, rasterize
from ss_flow.tasks.geometry.cameras import camera_of

WIDTH = 420
"""Of one picture, pixels."""
GAP = 6


def draw(run: Path, view: str) -> np.ndarray:
    """The four pictures side by side, RGB. run: output folder. view: name of a photo."""
    document = json.loads((run / "run.json").read_text(encoding="utf-8"))
    store = open_store(document["store"])
    scene, cameras = (store.get(document["results"][name]) for name in ("scene", "cameras"))
    number = cameras.names.index(view)
    camera = camera_of(cameras, number)
    frame, masks = (store.get(document["results"][name][number]) for name in ("ingest", "masks"))
    photo = cv2.cvtColor(cv2.imdecode(frame.encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    ids = masks.ids

    def rendered(gaussians: GaussianTensors) -> np.ndarray:
        image = rasterize(gaussians, camera, background=(1.0, 1.0, 1.0)).rgb
        return (image.clamp(0, 1).numpy() * 255).round().astype(np.uint8)

    whole = GaussianTensors.of(scene)
    painted = GaussianTensors.of(scene)
    colors = instance_colors(int(scene.instance_id.max()) + 1)[scene.instance_id] / 255
    painted.sh.zero_()
    painted.sh[:, 0] = painted.sh.new_tensor((colors - 0.5) / 0.28209479)
    pictures = [photo, paint_ids(ids, photo), rendered(painted), rendered(whole)]
    height = WIDTH * camera.height // camera.width
    small = [cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA) for picture in pictures]
    gap = np.full((height, GAP, 3), 255, np.uint8)
    return np.hstack([part for picture in small for part in (picture, gap)][:-1])


if __name__ == "__main__":
    folder, name, target = sys.argv[1:]
    cv2.imwrite(target, cv2.cvtColor(draw(Path(folder), name), cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])
