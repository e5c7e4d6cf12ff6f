"""Masks of a generated room with the same faults in all views, so that Split cannot find them: a pair, and halves."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ss_flow.flows.generated import Room
from ss_flow.flows.results import FinishedRun
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import backproject, camera_of, cameras_by_view
from ss_flow.tasks.geometry.images import encode_png


def write_faulty_masks(room: Room, folder: Path, *, joined: tuple[int, int], broken: int) -> None:
    """Write NNNN.png of every view: the true masks, but two things have one mask, and one has two.

    joined: ids of the two. broken: id of the one, which falls apart in a vertical plane through its middle.
    """
    height, width = room.ids.shape[1:]
    places = [
        backproject(room.depth[k], camera_of(room.cameras, k)).reshape(height, width, 3) for k in range(len(room))
    ]
    own = np.concatenate([place[ids == broken] for place, ids in zip(places, room.ids, strict=True)])
    middle = own.mean(axis=0)
    across = np.linalg.svd((own - middle)[:, :2], full_matrices=False)[2][0]  # its longer side
    folder.mkdir(parents=True)
    for name, ids, place in zip(room.cameras.names, room.ids, places, strict=True):
        faulty = np.where(ids == joined[1], joined[0], ids)
        beyond = (place - middle)[..., :2] @ across > 0
        faulty = np.where((ids == broken) & beyond, room.ids.max() + 1, faulty)
        (folder / f"{name}.png").write_bytes(encode_png(faulty.astype(np.uint16)))


def places_to_click(run: FinishedRun, *, joined: tuple[int, int], broken: int) -> list[tuple[int, int, int, int]]:
    """Where somebody clicks who sees the faults: number of the thing, and view, row and column of a pixel.

    run: of such masks, and with the truth. On each of the pair, and on both halves, in the middle of what the scene
    shows of it in the photo that shows most.
    """
    real, found = (np.stack([one.ids for one in run.results.all(name)]) for name in ("truth", "masks_split"))
    scene, cameras = run.results.one("scene"), run.results.one("cameras")
    top = np.stack([render(scene, camera).top_contributor for camera in cameras_by_view(cameras)])
    drawn = np.where(top < 0, 0, scene.instance_id[top])
    pair = np.bincount(found[np.isin(real, joined)]).argmax()
    halves = np.argsort(-np.bincount(found[real == broken]))[:2]
    shown = [(thing, (real == one) & (drawn == pair)) for thing, one in enumerate(joined, start=1)]
    return [(thing, *_middle(pixels)) for thing, pixels in (*shown, *((3, drawn == half) for half in halves))]


def _middle(shown: np.ndarray) -> tuple[int, int, int]:
    """View, row and column of the pixel farthest from the border of [K, H, W] pixels, where most are shown."""
    view = int(shown.sum(axis=(1, 2)).argmax())
    inner = cv2.distanceTransform(np.pad(shown[view], 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(inner.argmax()), inner.shape)
    return view, int(row), int(column)
