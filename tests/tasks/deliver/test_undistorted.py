"""The frames and cameras of a run as a COLMAP workspace."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from capture_folders import cameras_of, photo, pose

from ss_flow.tasks.artifacts import Frame, LabelMap
from ss_flow.tasks.capture.colmap import load_pycolmap
from ss_flow.tasks.capture.layout_colmap import read_points
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.deliver.undistorted import write_undistorted
from ss_flow.tasks.geometry.images import encode_png

NAMES = ("Foto mit Leer zeichen 1", "Küche 2", "3")


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are UTF-8 there")
def test_photos_whose_names_are_no_text_are_found_again(tmp_path):
    frame = Frame("a\udcff", 32, 24, encode_png(photo(0)), np.zeros(0, np.uint8), 32, 24)
    ids = LabelMap(frame.name, np.zeros((24, 32), np.uint16))
    write_undistorted(tmp_path, [frame], cameras_of((frame,)), [ids])
    assert open_scene(tmp_path).names == ("a\udcff",)


def test_colmap_and_we_read_the_photos_whatever_their_names(tmp_path):
    frames = tuple(
        Frame(name, 32, 24, encode_png(photo(i)), np.zeros(0, np.uint8), 32, 24) for i, name in enumerate(NAMES)
    )
    poses = np.stack([np.linalg.inv(pose(i)) for i in range(3)])
    points = np.array([[0.5, 1.5, 2.5], [3, 4, 5]], np.float32)
    cameras = replace(cameras_of(frames), world_to_camera=poses, sparse_points=points)
    maps = [LabelMap(name, np.zeros((24, 32), np.uint16)) for name in NAMES]
    write_undistorted(tmp_path, frames, cameras, maps)

    model = load_pycolmap().Reconstruction(str(tmp_path / "sparse/0"))
    found = {image.name: image for image in model.images.values()}
    assert found.keys() == {f"{name}.png" for name in NAMES} and model.num_reg_images() == 3
    for name, expected in zip(NAMES, poses, strict=True):
        image = found[f"{name}.png"]
        np.testing.assert_allclose(image.cam_from_world().matrix(), expected[:3], atol=1e-12)
        assert (tmp_path / "images" / image.name).is_file()
    (camera,) = model.cameras.values()
    assert (camera.model.name, camera.width, camera.height) == ("PINHOLE", 32, 24)
    np.testing.assert_array_equal(camera.params, cameras.intrinsics[0])
    np.testing.assert_array_equal([point.xyz for _, point in sorted(model.points3D.items())], points)

    scene = open_scene(tmp_path)
    assert sorted(scene.names) == sorted(NAMES)
    np.testing.assert_array_equal(read_points(scene.sparse), points)
