"""Frames of a depth sensor without poses: a run finds them, and goes on with those that have one."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from bent_room import bent, least_fit
from tiny_runs import run_tiny, ss_flow, write_room

from ss_flow.cache.store import Store
from ss_flow.flows.generated import RoomParams, generate, write_scene


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A room whose poses are lost, and of which the fourth frame shows nothing."""
    params = RoomParams(objects=6, views=8, width=320, height=240, held_out=0)
    folder = write_room(tmp_path_factory.mktemp("unposed") / "room", params=params)
    shutil.copytree(folder, folder.with_name("posed"))
    shutil.rmtree(folder / "pose")
    photo = sorted((folder / "color").iterdir())[3]
    cv2.imwrite(str(photo), np.full((240, 320, 3), 90, np.uint8))
    return folder, photo.stem


def apart(store, called):
    """[V, V] distances of the cameras of a run from each other, metres; and their names."""
    cameras = Store(store).get(called.results()["cameras"])
    poses = cameras.world_to_camera
    places = -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])
    return np.linalg.norm(places[:, None] - places, axis=2), cameras.names


def test_poses_are_found_and_a_frame_without_one_is_left_out_with_its_depth(room, tmp_path):
    folder, blank = room
    store = tmp_path / "store"
    called = run_tiny(folder, store, out=tmp_path / "out")
    assert called.code == 0, called.err
    assert f"1 view is left out, for which no pose was found: {blank}." in called.err
    found, names = apart(store, called)
    true, all_names = apart(store, run_tiny(folder.with_name("posed"), store, "--until", "cameras"))
    rows = [row for row, name in enumerate(all_names) if name != blank]
    assert names == tuple(all_names[row] for row in rows)
    assert np.abs(found - true[np.ix_(rows, rows)]).max() < 0.02 * true.max()
    depths = [Store(store).get(depth).name for depth in called.results()["depth"]]
    assert tuple(depths) == names
    assert {file.stem for file in (tmp_path / "out" / "masks").iterdir()} == set(names)
    assert called.document()["metrics"]["split"]["miou"] > 0.8
    again = run_tiny(folder, store, out=tmp_path / "out")
    assert again.computed() == {}


def test_refining_poses_that_are_not_there_is_refused(room, tmp_path):
    refused = ss_flow("run", room[0], "--refine-poses", "--out", tmp_path / "out", "--cache", tmp_path / "store")
    assert refused.code == 2
    assert "has no poses that could be refined" in refused.err


@pytest.mark.parametrize("told", [False, True], ids=["a lens that is not told of", "a lens that is told of"])
def test_masks_follow_photos_whose_poses_are_found_without_the_sensor(told, tmp_path):
    k, width, height = -0.15, 480, 360
    room = generate(RoomParams(objects=8, views=10, width=width, height=height, held_out=0))
    folder, store = tmp_path / "room", tmp_path / "store"
    write_scene(bent(room, k), folder, masks="truth")
    shutil.rmtree(folder / "pose")
    if told:
        fx, fy, cx, cy = room.cameras.intrinsics[0]
        files = {"file_path": "color/{}.jpg", "depth_file_path": "depth/{}.png"}
        frames = [{key: file.format(name) for key, file in files.items()} for name in room.cameras.names]
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": k, "w": width, "h": height}
        (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    found = {}
    for step in ("cameras", "segment"):
        called = run_tiny(folder, store, "--set", "capture.depth=mvs", "--until", step)
        assert called.code == 0, called.err
        found |= called.results()
    cameras = Store(store).get(found["cameras"])
    assert (len(cameras.radial) == 0) if told else np.abs(cameras.radial - k).max() < 0.02
    for masks in map(Store(store).get, found["segment"]):
        assert least_fit(room, masks.name, masks.dense()) > 0.93
