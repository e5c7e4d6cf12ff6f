"""Layouts with poses, each opened: its cameras, its depth, and what belongs to which photo."""

import json
import shutil
from dataclasses import replace

import capture_folders as made
import numpy as np
import pytest
from capture_folders import WORLD_TO_CAMERA

from ss_flow.errors import InputError
from ss_flow.tasks.capture.layout_colmap import read_points
from ss_flow.tasks.capture.scene import open_scene


def assert_cameras(scene, fy=30.0):
    np.testing.assert_allclose(scene.world_to_camera, WORLD_TO_CAMERA, atol=1e-6)
    for lens in scene.lenses:
        assert (lens.fx, lens.fy, lens.cx, lens.cy) == (30.0, fy, 16.0, 12.0)


def test_scannet_has_metric_poses_and_half_a_pixel_is_added_to_its_centres(tmp_path):
    scene = open_scene(made.scannet(tmp_path))
    assert scene.kind == "scannet" and scene.metric and scene.depth_scale == 0.001
    assert_cameras(scene)
    assert (scene.depth_lens.fx, scene.depth_lens.cx, scene.depth_lens.cy) == (15.0, 8.0, 6.0)
    assert [p.name for p in scene.depths] == ["2.png", "10.png", "11.png"]
    assert [p.parent.name for p in scene.ground_truth] == ["instance"] * 3
    assert [p.parent.name for p in scene.valid] == ["valid"] * 3


def test_scannets_sample_of_frames_has_its_intrinsics_in_no_folder(tmp_path):
    export = open_scene(made.scannet(tmp_path))
    for sensor in ("color", "depth"):
        (tmp_path / f"intrinsic/intrinsic_{sensor}.txt").rename(tmp_path / f"intrinsics_{sensor}.txt")
    (tmp_path / "intrinsic").rmdir()
    assert open_scene(tmp_path) == export
    (tmp_path / "intrinsics_color.txt").unlink()
    with pytest.raises(InputError, match=r"intrinsic/intrinsic_color\.txt is missing"):
        open_scene(tmp_path)


def test_nerfstudio_cameras_look_the_other_way(tmp_path):
    scene = open_scene(made.nerfstudio(tmp_path))
    assert scene.kind == "nerfstudio" and scene.metric
    assert_cameras(scene, fy=31.0)
    assert scene.lenses[0].pinhole


def test_instant_ngps_word_for_a_fisheye_means_the_same_as_nerfstudios(tmp_path):
    bent = {"k1": 0.08, "k2": -0.02, "k3": 0.005, "k4": -0.001}
    named = open_scene(made.nerfstudio(tmp_path / "named", camera_model="OPENCV_FISHEYE", **bent))
    told = open_scene(made.nerfstudio(tmp_path / "told", is_fisheye=True, **bent))
    assert told.lenses == named.lenses and told.lenses[0].fisheye
    assert not open_scene(made.nerfstudio(tmp_path / "plain", is_fisheye=False)).lenses[0].fisheye


def test_depth_is_read_under_instant_ngps_names_too_in_the_unit_that_belongs_to_them(tmp_path):
    made.nerfstudio(tmp_path, integer_depth_scale=10 / 65535, depth_unit_scale_factor=0.5)
    text = (tmp_path / "transforms.json").read_text()
    nerfstudios = open_scene(tmp_path)
    assert nerfstudios.depth_scale == 0.5
    (tmp_path / "transforms.json").write_text(text.replace("depth_file_path", "depth_path"))
    ngps = open_scene(tmp_path)
    assert ngps.depths == nerfstudios.depths and ngps.metric and ngps.depth_scale == 10 / 65535


def test_text_of_two_bytes_a_letter_as_windows_shell_writes_it_is_read(tmp_path):
    for layout, text in (("nerfstudio", "transforms.json"), ("tum", "groundtruth.txt"), ("stray", "odometry.csv")):
        file = getattr(made, layout)(tmp_path / layout) / text
        before = open_scene(tmp_path / layout)
        file.write_bytes(file.read_text().replace("\n", "\r\n").encode("utf-16"))
        assert open_scene(tmp_path / layout) == before


def test_nerfstudio_without_depth_is_not_metric_and_may_be_named_by_its_file(tmp_path):
    made.nerfstudio(tmp_path)
    text = (tmp_path / "transforms.json").read_text().replace("depth_file_path", "unused")
    (tmp_path / "transforms.json").write_text(text)
    scene = open_scene(tmp_path / "transforms.json")
    assert scene.depths is None and not scene.metric


def test_a_room_of_replica_has_its_lens_beside_or_above_it_or_that_of_all_such_rooms(tmp_path):
    scene = open_scene(made.replica(tmp_path / "office0"))
    assert (scene.kind, scene.metric, scene.depth_scale) == ("replica", True, 1 / 6553.5)
    assert scene.names == ("frame000000", "frame000001", "frame000002")
    assert_cameras(scene)
    assert [p.name for p in scene.depths] == ["depth000000.png", "depth000001.png", "depth000002.png"]
    (tmp_path / "office0/cam_params.json").rename(tmp_path / "cam_params.json")
    assert open_scene(tmp_path / "office0").lenses == scene.lenses
    (tmp_path / "cam_params.json").unlink()
    lens = open_scene(tmp_path / "office0").lenses[0]
    assert (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy) == (1200, 680, 600, 600, 600, 340)


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda root: (root / "results/depth000001.png").unlink(), "lacks the depth map of frame000001.jpg"),
        (lambda root: (root / "results/frame000001.jpg").unlink(), "traj.txt holds 3 poses, and .*results 2 photos"),
        (lambda root: (root / "traj.txt").write_text("1 2 3"), "traj.txt does not hold 16 numbers for each photo"),
        (lambda root: made.replica(root, scale=0), "cam_params.json has no `camera` with a number `scale`"),
        (lambda root: made.replica(root, fy=None), "cam_params.json has no `camera` with a number `fy`"),
    ],
)
def test_a_room_of_replica_that_makes_no_sense_is_refused(spoil, message, tmp_path):
    spoil(made.replica(tmp_path))
    with pytest.raises(InputError, match=message):
        open_scene(tmp_path)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".JPEG"])
def test_nerfstudio_names_may_lack_their_ending_and_have_the_backslashes_of_windows(ending, tmp_path):
    whole = open_scene(made.nerfstudio(tmp_path))
    document = json.loads((tmp_path / "transforms.json").read_text())
    for frame in document["frames"]:
        file = tmp_path / frame["file_path"]
        file.rename(file.with_suffix(ending))
        frame |= {"file_path": f".\\images\\{file.stem}", "depth_file_path": f"depth\\{file.name}", "mask_path": ""}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    scene = open_scene(tmp_path)
    assert (scene.names, scene.depths, scene.poses) == (whole.names, whole.depths, whole.poses)
    assert [photo.suffix for photo in scene.photos] == [ending] * 3
    (tmp_path / "images/10").with_suffix(ending).unlink()
    assert open_scene(tmp_path).skipped == ("10",)


@pytest.mark.parametrize("layout", ["nerfstudio", "tum", "colmap"])
def test_the_mark_that_windows_puts_in_front_of_a_text_is_no_part_of_it(layout, tmp_path):
    more = {"binary": False} if layout == "colmap" else {}
    scene = open_scene(getattr(made, layout)(tmp_path, **more))
    texts = [file for ending in ("*.txt", "*.json") for file in tmp_path.rglob(ending)]
    assert texts
    for file in texts:
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert open_scene(tmp_path) == scene


@pytest.mark.parametrize("binary", [True, False])
def test_the_largest_colmap_model_is_taken(tmp_path, binary):
    scene = open_scene(made.colmap(tmp_path, binary))
    assert scene.kind == "colmap" and not scene.metric
    assert scene.names == ("2", "10", "11")
    assert_cameras(scene)
    np.testing.assert_allclose(read_points(scene.sparse), [[0.5, 1.5, 2.5], [3, 4, 5]])


def test_a_colmap_model_may_lie_in_a_folder_colmap_as_nerfstudio_leaves_it(tmp_path):
    made.colmap(tmp_path)
    (tmp_path / "colmap").mkdir()
    (tmp_path / "sparse").rename(tmp_path / "colmap" / "sparse")
    scene = open_scene(tmp_path)
    assert scene.kind == "colmap" and scene.names == ("2", "10", "11")
    assert_cameras(scene)


def test_a_list_of_photos_named_images_txt_makes_no_colmap_model(tmp_path):
    (made.photos(tmp_path) / "images.txt").write_text("2.jpg\n10.jpg\n")
    assert open_scene(tmp_path).kind == "photos"


def test_a_colmap_model_that_pycolmap_wrote_reads_the_same(tmp_path):
    import zlib  # noqa: F401

    import pycolmap

    made.colmap(tmp_path, binary=False)
    scene = open_scene(tmp_path)
    points = read_points(scene.sparse)
    model = pycolmap.Reconstruction()
    model.read_text(tmp_path / "sparse" / "1")
    for folder in ("0", "1"):
        for file in (tmp_path / "sparse" / folder).iterdir():
            file.unlink()
    model.write_binary(tmp_path / "sparse" / "1")
    again = open_scene(tmp_path)
    assert again.lenses == scene.lenses and again.names == scene.names
    np.testing.assert_allclose(again.world_to_camera, scene.world_to_camera, atol=1e-12)
    np.testing.assert_allclose(read_points(again.sparse), points)


def test_tum_takes_what_is_nearest_in_time(tmp_path):
    made.tum(tmp_path)
    (tmp_path / "intrinsics.txt").write_text("30 30 15.5 11.5")
    scene = open_scene(tmp_path)
    assert scene.kind == "tum" and scene.depth_scale == 1 / 5000
    assert_cameras(scene)
    text = (tmp_path / "depth.txt").read_text().replace("101.01", "101.03")
    (tmp_path / "depth.txt").write_text(text)
    assert open_scene(tmp_path).skipped == ("10",)


def test_tum_without_intrinsics_has_those_of_the_benchmark(tmp_path):
    lens = open_scene(made.tum(tmp_path)).lenses[0]
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (525, 525, 320, 240)


@pytest.mark.parametrize("layout", ["tum", "scannet", "nerfstudio"])
def test_frames_of_a_depth_sensor_may_come_without_poses(tmp_path, layout):
    posed = open_scene(getattr(made, layout)(tmp_path))
    if layout == "tum":
        (tmp_path / "groundtruth.txt").unlink()
    elif layout == "scannet":
        shutil.rmtree(tmp_path / "pose")
    else:
        document = json.loads((tmp_path / "transforms.json").read_text())
        for frame in document["frames"]:
            del frame["transform_matrix"]
        (tmp_path / "transforms.json").write_text(json.dumps(document))
    scene = open_scene(tmp_path)
    assert scene == replace(posed, poses=None)
    assert scene.depths is not None and scene.metric


def test_a_sens_file_lists_the_views_that_have_a_pose(tmp_path):
    scene = open_scene(made.sens(tmp_path / "scene0000_00.sens"))
    assert scene.kind == "sens" and scene.name == "scene0000_00" and scene.metric
    assert scene.names == ("frame-000000", "frame-000002") and scene.skipped == ("frame-000001",)
    assert scene.entries == (0, 2)
    np.testing.assert_allclose(scene.world_to_camera, WORLD_TO_CAMERA[[0, 2]], atol=1e-6)
    assert scene.depth_scale == pytest.approx(0.001)


def test_a_transforms_json_brings_what_lies_beside_it_as_its_folder_does(tmp_path):
    made.nerfstudio(tmp_path)
    for folder in ("instance", "valid", "instance_masks"):
        for name in made.NAMES:
            made.write(tmp_path / folder / f"{name}.png", np.zeros((made.HEIGHT, made.WIDTH), np.uint16))
    (tmp_path / "instances.json").write_text('{"0": "table"}')
    folder, file = open_scene(tmp_path), open_scene(tmp_path / "transforms.json")
    assert file.ready_masks and file.ground_truth and all(file.valid) and not file.zero_is_void
    assert replace(file, opened=tmp_path) == folder


@pytest.mark.parametrize("binary", [True, False])
def test_colmaps_photos_may_be_listed_with_windows_backslashes(tmp_path, binary):
    made.colmap(tmp_path, binary=binary)
    straight = open_scene(tmp_path)
    for file in tmp_path.glob("sparse/*/images.*"):
        data = file.read_bytes()
        for name in made.NAMES:
            before = b" " if not binary else b"\x07\0\0\0"
            data = data.replace(before + f"{name}.png".encode(), before + f"near\\{name}.png".encode())
        file.write_bytes(data)
    (tmp_path / "images").rename(tmp_path / "near")
    (tmp_path / "images").mkdir()
    (tmp_path / "near").rename(tmp_path / "images/near")
    scene = open_scene(tmp_path)
    assert scene.names == straight.names and scene.poses == straight.poses and scene.skipped == ()
    assert scene.photos == tuple(tmp_path / "images/near" / photo.name for photo in straight.photos)


def test_one_of_colmaps_models_may_be_named_and_finds_its_photos_above(tmp_path):
    made.colmap(tmp_path)
    whole, smaller = open_scene(tmp_path), open_scene(tmp_path / "sparse/0")
    assert len(whole.names) == 3 and smaller.names == ("2",) and smaller.skipped == ("10", "11")
    assert smaller.photos[0].samefile(whole.photos[0]) and smaller.poses == whole.poses[:1]
    shutil.copytree(tmp_path / "images", tmp_path / "sparse/0", dirs_exist_ok=True)
    assert open_scene(tmp_path / "sparse/0").photos == (tmp_path / "sparse/0/2.png",)
