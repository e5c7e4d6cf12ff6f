"""Runs on strongly distorted photos: masks lie in the pixels of the photos, going in and coming out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from distorted_room import BARREL, FISHEYE, HEIGHT, WIDTH, covered, write_distorted_room
from tiny_runs import bytes_of, run_tiny

from ss_flow.cache.store import Store
from ss_flow.tasks.capture.scene import open_scene


def read(folder):
    return np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted(folder.iterdir())])


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize(
    ("distortion", "more", "least"),
    [(BARREL, (), 0.99), (FISHEYE, ("--set", "ingest.max_side=128"), 0.95)],
    ids=["barrel", "fisheye, scaled down"],
)
def test_masks_come_out_in_the_pixels_of_the_distorted_photos_and_go_in_again_as_they_are(
    distortion, more, least, tmp_path
):
    truth = write_distorted_room(tmp_path / "room", distortion)
    shown = covered(distortion)
    assert 0.8 < shown.mean() < 0.9
    called = run_tiny(tmp_path / "room", tmp_path / "store", *more, out=tmp_path / "out")
    assert called.code == 0, called.err
    ours = read(tmp_path / "out/masks_split")
    assert ours.dtype == np.uint16 and ours.shape == (5, HEIGHT, WIDTH)
    for stage in ("masks_split", "masks"):
        assert not read(tmp_path / "out" / stage)[:, ~shown].any()
    large = [i for i in range(1, 6) if ((truth == i) & shown).sum() > 1000]
    assert len(large) == 4
    for number in large:
        true = (truth == number) & shown
        own, count = np.unique(ours[true], return_counts=True)
        assert own[count.argmax()] > 0
        assert iou(ours == own[count.argmax()], true) > least

    given = tmp_path / "out/masks_split"
    again = run_tiny(tmp_path / "room", tmp_path / "store", *more, "--masks", given, out=tmp_path / "again")
    assert again.code == 0, again.err
    twice = read(tmp_path / "again/masks_split")
    assert set(np.unique(twice)) == set(np.unique(ours))
    for number in np.unique(ours):
        assert iou((twice == number) & shown, (ours == number) & shown) > 0.99


def test_the_undistorted_photos_are_a_capture_that_gives_the_frames_and_cameras_of_the_run(tmp_path):
    write_distorted_room(tmp_path / "room", BARREL)
    plain, out = tmp_path / "plain", tmp_path / "out"
    first = run_tiny(tmp_path / "room", tmp_path / "store", out=plain)
    called = run_tiny(tmp_path / "room", tmp_path / "store", "--undistorted", out=out)
    assert (called.code, called.computed()) == (0, {}), called.err
    files, written = bytes_of(plain), bytes_of(out)
    assert written.keys() - files.keys() == {name for name in written if name.startswith("undistorted/")} != set()
    assert all(written[name] == files[name] for name in files if name not in ("run.json", "report.html"))

    scene = open_scene(out / "undistorted")
    assert scene.kind == "colmap" and all(lens.pinhole for lens in scene.lenses)
    store = Store(tmp_path / "store")
    results = called.results()
    ids = read(out / "undistorted/masks")
    np.testing.assert_array_equal(ids, [store.get(value).ids for value in results["masks"]])
    found = {}
    for step in ("ingest", "cameras", "segment"):
        more = ["--masks", out / "undistorted/masks", "--until", step]
        straight = run_tiny(out / "undistorted", tmp_path / "store", *more)
        assert straight.code == 0, straight.err
        found |= straight.results()
    assert found["ingest"] == results["ingest"] == first.results()["ingest"]
    before, after = store.get(results["cameras"]), store.get(found["cameras"])
    np.testing.assert_array_equal(after.intrinsics, before.intrinsics)
    np.testing.assert_allclose(after.world_to_camera, before.world_to_camera, atol=1e-12)
    for masks, image in zip(found["segment"], ids, strict=True):
        np.testing.assert_array_equal(store.get(masks).dense(), [image == i for i in np.unique(image[image > 0])])

    # Asked for no longer, the folder is gone.
    assert run_tiny(tmp_path / "room", tmp_path / "store", out=out).code == 0
    assert not (out / "undistorted").exists()
