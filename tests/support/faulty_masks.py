"""Masks of a generated room with the same faults in all views, so that Split cannot find them: a pair, and halves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ss_flow.flows.generated import Room
from ss_flow.tasks.geometry.cameras import backproject, camera_of
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
