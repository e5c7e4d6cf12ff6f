"""Poses and lenses of a capture that cannot be true, or are not all there, are refused with one sentence."""

import shutil
import struct

import capture_folders as made
import numpy as np
import pytest
from spoilt_captures import Cases, cut

case = Cases()


@case("10.txt", "is missing")
def pose_of_one_view_missing(root):
    (made.scannet(root) / "pose" / "10.txt").unlink()
    return root


@case("10.txt", "holds 12 numbers")
def pose_that_is_3_by_4(root):
    np.savetxt(made.scannet(root) / "pose" / "10.txt", made.pose(0)[:3])
    return root


@case("10.txt", "not rigid")
def pose_with_scale(root):
    np.savetxt(made.scannet(root) / "pose" / "10.txt", made.pose(0) @ np.diag([1.01, 1.01, 1.01, 1]))
    return root


@case("10.txt", "not rigid")
def pose_that_mirrors(root):
    np.savetxt(made.scannet(root) / "pose" / "10.txt", made.pose(0) @ np.diag([1, 1, -1, 1]))
    return root


@case("10.txt", "no number")
def pose_with_words(root):
    (made.scannet(root) / "pose" / "10.txt").write_text("one two")
    return root


@case("pose", "every view as lost")
def every_pose_lost(root):
    for file in (made.scannet(root) / "pose").iterdir():
        np.savetxt(file, np.full((4, 4), -np.inf))
    return root


@case("intrinsic_color.txt", "is missing")
def intrinsics_missing(root):
    (made.scannet(root) / "intrinsic" / "intrinsic_color.txt").unlink()
    return root


@case("intrinsic_color.txt", "not positive")
def focal_length_not_positive(root):
    np.savetxt(made.scannet(root) / "intrinsic" / "intrinsic_color.txt", np.diag([-30.0, 30, 1, 1]))
    return root


@case("extrinsic_depth.txt", "sets the depth camera apart")
def depth_camera_elsewhere(root):
    matrix = np.eye(4)
    matrix[0, 3] = 0.05
    np.savetxt(made.scannet(root) / "intrinsic" / "extrinsic_depth.txt", matrix)
    return root


@case("intrinsic_color.txt", "is missing; the capture needs it")
def frames_of_a_depth_sensor_without_their_lens(root):
    made.scannet(root)
    shutil.rmtree(root / "intrinsic")
    shutil.rmtree(root / "pose")
    return root


@case("10.jpg", "share one camera's intrinsics")
def two_sizes_with_one_camera(root):
    made.write(made.scannet(root) / "color" / "10.jpg", made.photo(0, 64, 48))
    for folder in ("valid", "instance"):
        shutil.rmtree(root / folder)
    return root


@case("images.bin", "ends too early")
def colmap_images_cut(root):
    cut(made.colmap(root) / "sparse" / "1" / "images.bin")
    return root


@case("points3D.bin", "ends too early")
def colmap_points_cut(root):
    cut(made.colmap(root) / "sparse" / "1" / "points3D.bin", 0.3)
    return root


@case("cameras.bin", "ends too early")
def colmap_cameras_cut(root):
    cut(made.colmap(root) / "sparse" / "0" / "cameras.bin")
    return root


@case("images.bin", "is missing")
def colmap_images_missing(root):
    (made.colmap(root) / "sparse" / "1" / "images.bin").unlink()
    return root


@case("cameras.bin", "is missing")
def colmap_cameras_missing(root):
    (made.colmap(root) / "sparse" / "1" / "cameras.bin").unlink()
    return root


@case("cameras.txt", "is missing")
def colmap_points_alone(root):
    made.write(root / "images" / "1.png", made.photo())
    (root / "points3D.txt").write_text("")
    return root


@case("cameras.bin", "has a camera of model EUCM; undistort the images first")
def colmap_lens_of_a_newer_version(root):
    made.colmap(root, binary=True)
    cameras = root / "sparse" / "1" / "cameras.bin"
    cameras.write_bytes(struct.pack("<QIiQQ6d", 1, 7, 16, 32, 24, 30, 30, 16, 12, 0.5, 1))
    return root


@case("cameras.txt", "model FOV")
def colmap_lens_unknown(root):
    made.colmap(root, binary=False)
    (root / "sparse" / "1" / "cameras.txt").write_text("7 FOV 32 24 30 30 16 12 0.1\n")
    return root


@case("images.txt", "lacks the line of image points below that of 2.png")
def colmap_images_without_their_points(root):
    file = made.colmap(root, binary=False) / "sparse" / "1" / "images.txt"
    file.write_text("\n".join(line for line in file.read_text().splitlines() if ".png" in line))
    return root


@case("10.png", "does not exist")
def colmap_photo_missing(root):
    (made.colmap(root) / "images" / "10.png").unlink()
    return root


@case("sparse", "no registered image")
def colmap_with_no_image(root):
    shutil.rmtree(made.colmap(root, registered=0) / "sparse" / "0")
    return root


@case("groundtruth.txt", "is missing")
def tum_without_poses_or_depth(root):
    made.tum(root)
    for name in ("groundtruth.txt", "depth.txt"):
        (root / name).unlink()
    return root


@case("rgb.txt", "0.02 s")
def tum_of_two_clocks(root):
    text = (made.tum(root) / "rgb.txt").read_text().replace("10", "90")
    (root / "rgb.txt").write_text(text.replace("rgb/90", "rgb/10"))
    return root


@case("groundtruth.txt", "tx ty tz qx qy qz qw")
def tum_with_a_short_pose(root):
    (made.tum(root) / "groundtruth.txt").write_text("100 1 2 3\n101 1 2 3\n102 1 2 3\n")
    return root


@case("groundtruth.txt for rgb/10.png", "has a quaternion of length 0")
def tum_with_a_quaternion_of_zeros(root):
    track = made.tum(root) / "groundtruth.txt"
    lines = track.read_text().splitlines()
    lines[2] = "101.005 1 0.5 -1 0 0 0 0"
    track.write_text("\n".join(lines))
    return root


@case("2.png", "its intrinsics are those of a photo of 640x480")
def tum_of_another_size_without_intrinsics(root):
    return made.tum(root)


@case("camera.txt", "four numbers")
def tum_with_bad_intrinsics(root):
    (made.tum(root) / "camera.txt").write_text("525 525")
    return root


@pytest.mark.parametrize("name", case.known)
def test_a_bad_capture_is_refused_with_one_sentence_that_names_it(name, tmp_path):
    case.assert_refused(name, tmp_path)
