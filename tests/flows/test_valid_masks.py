"""The folder `valid/` beside a capture says which pixels are to be ignored, whatever the capture's layout."""

from __future__ import annotations

import capture_folders as made
import cv2
import numpy as np
from tiny_runs import run_tiny

from ss_flow.cache.store import Store
from ss_flow.tasks.geometry.images import decode_valid


def test_it_counts_beside_a_recording_too(tmp_path):
    folder, store = tmp_path / "room", tmp_path / "store"
    folder.mkdir()
    made.sens(folder / "scan.sens")
    valid = np.full((made.HEIGHT, made.WIDTH), 255, np.uint8)
    valid[:, :6] = 0
    made.write(folder / "valid" / "frame-000000.png", valid)
    alone = "--set", "capture.refine_poses=never", "--set", "capture.completion.below=0"
    results = {}
    for step in ("ingest", "depth"):
        called = run_tiny(folder, store, *alone, "--calibrate", "none", "--until", step)
        assert called.code == 0, called.err
        results |= called.results()
    masked, whole = map(Store(store).get, results["ingest"])
    np.testing.assert_array_equal(decode_valid(masked), valid > 0)
    assert decode_valid(whole).all()
    masked, whole = (Store(store).get(found).depth for found in results["depth"])
    np.testing.assert_array_equal(masked > 0, cv2.resize(valid, masked.shape[::-1], interpolation=cv2.INTER_AREA) > 0)
    assert whole.all()
