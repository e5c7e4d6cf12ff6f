"""Every kind of bad capture is refused with one sentence that names what is wrong."""

import json
import re
import shutil
import struct
from pathlib import Path
from types import SimpleNamespace

import capture_folders as made
import cv2
import numpy as np
import pytest
from capture_folders import ref, refs
from PIL import Image

from ss_flow.errors import InputError
from ss_flow.tasks.capture.id_images import ground_truth, ready_masks
from ss_flow.tasks.capture.ingest import cameras, frames
from ss_flow.tasks.capture.recordings import sens_depth, sens_frames, video_frames
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.sensor_depth import depth


def read_all(path: Path) -> None:
    """What a run does first: open the capture and read everything of it."""
    scene = open_scene(path)
    if scene.kind == "video":
        video_frames(video=ref(scene.recording))
        return
    if scene.kind == "sens":
        entries = {"recording": ref(scene.recording), "names": scene.names, "entries": scene.entries}
        sens_depth(sens_frames(**entries), **entries)
        return
    names, lenses = scene.names, scene.lenses
    views = frames(names=names, photos=refs(scene.photos), valid=refs(scene.valid), lenses=lenses)
    if scene.poses:
        cameras(views, names=names, lenses=lenses, poses=scene.poses, metric=scene.metric, sparse=ref(scene.sparse))
    if scene.depths:
        depth(
            views,
            names=names,
            files=refs(scene.depths),
            scale=scene.depth_scale,
            metric=scene.metric,
            lenses=lenses,
            depth_lens=scene.depth_lens,
        )
    if scene.ready_masks:
        ready_masks(views, made.cameras_of(views), names=names, files=refs(scene.ready_masks), lenses=lenses)
    if scene.ground_truth:
        ground_truth(views, made.cameras_of(views), names=names, files=refs(scene.ground_truth), lenses=lenses)


CASES = {}


def case(named: str, says: str):
    """Register a way to spoil a capture: it makes one below a folder, and returns the path to open."""

    def register(spoil):
        CASES[spoil.__name__] = (spoil, named, says)
        return spoil

    return register


def cut(path: Path, keep: float = 0.6) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def edit_json(root: Path, change) -> None:
    document = json.loads((root / "transforms.json").read_text())
    change(document)
    (root / "transforms.json").write_text(json.dumps(document))


@case("nowhere", "does not exist")
def path_that_does_not_exist(root):
    return root / "nowhere"


@case("scene", "holds no photo")
def empty_folder(root):
    return root


@case("scene", "its folder walk/ holds 3 of them, so give that.")
def folder_of_a_folder_of_photos(root):
    made.photos(root / "walk")
    (root / "notes").mkdir()
    return root


@case(
    "scene",
    "(.bmp .heic .heif .jfif .jpeg .jpg .pgm .png .pnm .ppm .tif .tiff .webp) and no capture that is known; give a",
)
def folder_of_two_folders_of_photos(root):
    made.photos(root / "walk")
    made.photos(root / "talk")
    return root


@case("scene", "holds depth maps beside its photos, such as frame-000000.depth.png; lay them out as color/, depth/ and")
def photos_and_depth_maps_in_one_folder(root):
    for i in range(3):
        made.write(root / f"frame-{i:06d}.color.png", made.photo(i))
        made.write(root / f"frame-{i:06d}.depth.png", made.depth_image())
    return root


@case("scene", "its folder dense/ is a capture with poses, so give that.")
def folder_of_a_workspace_among_others(root):
    made.colmap(root / "dense")
    made.photos(root / "walk")
    return root


@case("scene", "holds photos (3), and so does its folder images/ (3); give ")
def photos_here_and_there(root):
    made.photos(root / "images")
    return made.photos(root)


@case("transforms_train.json", "poses are read from transforms.json only; copy it to that name, or move it away")
def transforms_under_another_name(root):
    (made.nerfstudio(root) / "transforms.json").rename(root / "transforms_train.json")
    return root


@case("transforms_train.json", "is not read under this name; copy it to ")
def transforms_named_by_another_name(root):
    return transforms_under_another_name(root) / "transforms_train.json"


@case("notes.txt", "is no scene; give ")
def file_of_another_kind(root):
    (root / "notes.txt").write_text("hello")
    return root / "notes.txt"


@case("walk.wmv", "videos end in .3gp .avi .m2ts ")
def video_of_another_ending(root):
    (root / "walk.wmv").write_bytes(b"")
    return root / "walk.wmv"


@case("color", "holds no photo")
def scannet_without_photos(root):
    made.scannet(root)
    for file in (root / "color").iterdir():
        file.unlink()
    return root


@case("depth", "lacks the depth map of 10.jpg")
def depth_of_one_view_missing(root):
    (made.scannet(root) / "depth" / "10.png").unlink()
    return root


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


@case("10.png", "both belong to view 10; every view needs its own stem")
def two_photos_of_one_stem(root):
    made.write(made.photos(root) / "10.png", made.photo())
    return root


@case("10.jpg", "links to /nowhere/10.jpg, which is no file")
def photo_that_is_a_dead_link(root):
    (made.photos(root) / "10.jpg").unlink()
    (root / "10.jpg").symlink_to("/nowhere/10.jpg")
    return root


@case("10.png", "links to away.png, which is no file")
def ready_mask_that_is_a_dead_link(root):
    made.photos(root)
    for name in made.NAMES:
        made.write(root / "instance_masks" / f"{name}.png", np.zeros((24, 32), np.uint16))
    (root / "instance_masks" / "10.png").unlink()
    (root / "instance_masks" / "10.png").symlink_to("away.png")
    return root


@case("transforms.json", "not valid JSON")
def transforms_that_is_no_json(root):
    (made.nerfstudio(root) / "transforms.json").write_text("{")
    return root


@case("transforms.json", "lacks a list `frames`")
def transforms_without_frames(root):
    edit_json(made.nerfstudio(root), lambda d: d.pop("frames"))
    return root


@case("transforms.json", "no transform_matrix")
def transforms_without_a_pose(root):
    edit_json(made.nerfstudio(root), lambda d: d["frames"][1].pop("transform_matrix"))
    return root


@case("transforms.json", "shape (3, 4)")
def transforms_with_a_pose_of_three_rows(root):
    edit_json(made.nerfstudio(root), lambda d: d["frames"][1]["transform_matrix"].pop())
    return root


@case("transforms.json", "no intrinsics")
def transforms_without_intrinsics(root):
    edit_json(made.nerfstudio(root), lambda d: d.pop("fl_x"))
    return root


@case("transforms.json", "lists no frame")
def transforms_with_no_frame(root):
    edit_json(made.nerfstudio(root), lambda d: d.update(frames=[]))
    return root


@case("transforms.json", "no depth_file_path for images/10.png")
def transforms_with_depth_for_some(root):
    edit_json(made.nerfstudio(root), lambda d: d["frames"][1].pop("depth_file_path"))
    return root


@case("transforms.json", "EQUIRECTANGULAR")
def transforms_of_a_panorama(root):
    return made.nerfstudio(root, camera_model="EQUIRECTANGULAR")


@case("transforms.json", "has `is_fisheye` true and the camera_model OPENCV; take away the one that is wrong")
def transforms_of_two_lenses(root):
    return made.nerfstudio(root, camera_model="OPENCV", is_fisheye=True)


@case("transforms.json", "has `k4`, which is read of a fisheye only")
def transforms_with_a_coefficient_that_is_not_read(root):
    return made.nerfstudio(root, k1=0.1, k4=0.01)


@case("transforms.json", "none of them exists; the first is looked for at ")
def listed_photos_missing(root):
    shutil.rmtree(made.nerfstudio(root) / "images")
    return root


@case("images/0000, also with .png, .jpg or .jpeg at its end", "none of them exists; the first is looked for at ")
def listed_photos_without_an_ending_missing(root):
    edit_json(made.nerfstudio(root), lambda d: [f.update(file_path="images\\0000") for f in d["frames"]])
    return root


@case("10.png", "does not exist; put it there or drop the view.")
def listed_depth_missing(root):
    (made.nerfstudio(root) / "depth" / "10.png").unlink()
    return root


@case("10.png", "does not exist; 10.PNG lies there, which is spelt differently: rename it.")
def listed_depth_in_capitals(root):
    place = made.nerfstudio(root) / "depth"
    (place / "10.png").rename(place / "10.PNG")
    return root


@case("10.png", "does not exist; 10.tif lies there, which is spelt differently: rename it.")
def listed_depth_of_another_ending(root):
    place = made.nerfstudio(root) / "depth"
    (place / "10.png").rename(place / "10.tif")
    return root


@case("K\u00fcche.png", "does not exist; Ku\u0308che.png lies there, which is spelt differently: rename it.")
def listed_depth_with_its_accent_apart(root):
    place = made.nerfstudio(root) / "depth"
    (place / "10.png").rename(place / "Ku\u0308che.png")
    edit_json(root, lambda d: d["frames"][1].update(depth_file_path="depth/K\u00fcche.png"))
    return root


@case("10.jpg", "cut short or damaged")
def photo_that_is_a_cut_jpeg(root):
    cut(made.photos(root) / "10.jpg")
    return root


@case("20.heic", "cut short or damaged")
def photo_that_is_a_cut_heic(root):
    made.photos(root)
    (root / "20.heic").write_bytes((Path(made.__file__).parent / "quarters.heic").read_bytes())
    cut(root / "20.heic")
    return root


@case("10.png", "cut short or damaged")
def photo_that_is_a_cut_png(root):
    cut(made.nerfstudio(root) / "images" / "10.png")
    return root


@case("10.pgm", "no image that can be read")
def photo_that_is_a_cut_pgm(root):
    for name in made.NAMES:
        made.write(root / f"{name}.pgm", made.photo()[..., 0])
    cut(root / "10.pgm")
    return root


@case("10.jpg", "no image that can be read")
def photo_that_is_text(root):
    (made.photos(root) / "10.jpg").write_text("hello")
    return root


@case("10.jpg", "no image that can be read")
def photo_that_is_empty(root):
    (made.photos(root) / "10.jpg").write_bytes(b"")
    return root


@case("2.png", "its intrinsics are those of a photo of 64x48")
def intrinsics_of_another_size(root):
    return made.nerfstudio(root, w=64, h=48)


@case("10.jpg", "share one camera's intrinsics")
def two_sizes_with_one_camera(root):
    made.write(made.scannet(root) / "color" / "10.jpg", made.photo(0, 64, 48))
    for folder in ("valid", "instance"):
        shutil.rmtree(root / folder)
    return root


@case("10.png", "uint8 pixels")
def depth_of_8_bits(root):
    made.write(made.nerfstudio(root) / "depth" / "10.png", np.full((24, 32), 9, np.uint8))
    return root


@case("10.png", "3 channels")
def depth_in_colour(root):
    made.write(made.nerfstudio(root) / "depth" / "10.png", made.photo())
    return root


@case("10.png", "has a palette; an image of one channel is expected, so save it as gray")
def valid_mask_with_a_palette(root):
    image = Image.fromarray(np.ones((24, 32), np.uint8))
    image.putpalette(bytes(6))
    image.save(made.scannet(root) / "valid" / "10.png")
    return root


@case("depth", "0 everywhere")
def depth_without_a_known_pixel(root):
    made.nerfstudio(root)
    for name in made.NAMES:
        made.write(root / "depth" / f"{name}.png", made.depth_image(0))
    return root


@case("depth", "valid masks (0 = ignored) or the photos' alpha channels leave out every one")
def valid_masks_that_leave_out_everything(root):
    made.scannet(root)
    for name in made.NAMES:
        made.write(root / "valid" / f"{name}.png", np.zeros((24, 32), np.uint8))
    return root


@case("10.npy", "is no image file by its name; PNG of 16 bits or TIFF of 32-bit floats is expected")
def depth_as_an_array_of_numpy(root):
    (made.nerfstudio(root) / "depth" / "10.npy").write_bytes(b"")
    edit_json(root, lambda d: d["frames"][1].update(depth_file_path="depth/10.npy"))
    return root


@case("intrinsic_color.txt", "is missing; the capture needs it")
def frames_of_a_depth_sensor_without_their_lens(root):
    made.scannet(root)
    shutil.rmtree(root / "intrinsic")
    shutil.rmtree(root / "pose")
    return root


@case("10.png", "is listed twice; every view needs a photo of its own")
def a_photo_that_is_listed_twice(root):
    edit_json(made.nerfstudio(root), lambda d: d["frames"].append(d["frames"][1]))
    return root


@case("transforms.json", "`depth_unit_scale_factor` -0.001; world units per unit")
def depth_in_a_negative_unit(root):
    return made.nerfstudio(root, depth_unit_scale_factor=-0.001)


@case("transforms.json", "`depth_unit_scale_factor` 0; world units per unit")
def depth_in_no_unit(root):
    return made.nerfstudio(root, depth_unit_scale_factor=0)


@case("transforms.json", "`depth_unit_scale_factor` inf; a finite number is expected")
def depth_in_an_endless_unit(root):
    return made.nerfstudio(root, depth_unit_scale_factor=np.inf)


@case("transforms.json", "`w` nan; a finite number is expected")
def transforms_of_a_width_that_is_no_number(root):
    return made.nerfstudio(root, w=np.nan)


@case("2.png", "median depth of 2000 m")
def depth_in_the_wrong_unit(root):
    return made.nerfstudio(root, depth_unit_scale_factor=1.0)


@case("2.png", "median depth of 0.002 m")
def depth_in_too_small_a_unit(root):
    return made.nerfstudio(root, depth_unit_scale_factor=1e-6)


@case("10.png", "proportions")
def depth_of_another_shape(root):
    made.write(made.nerfstudio(root) / "depth" / "10.png", made.depth_image(2000, 24, 24))
    return root


@case("10.png", "valid mask must have its photo's size")
def valid_mask_of_another_size(root):
    made.write(made.scannet(root) / "valid" / "10.png", np.zeros((5, 5), np.uint8))
    return root


@case("10.png", "must have its photo's size")
def ground_truth_of_another_size(root):
    made.write(made.scannet(root) / "instance" / "10.png", np.zeros((5, 5), np.uint16))
    return root


@case("11.png", "must have its photo's size")
def ready_masks_of_another_size(root):
    made.photos(root)
    for name, size in zip(made.NAMES, (24, 24, 5), strict=True):
        made.write(root / "instance_masks" / f"{name}.png", np.zeros((size, 32), np.uint16))
    return root


@case("instance_masks", "lacks the masks of view 10")
def ready_masks_missing_for_a_view(root):
    made.photos(root)
    made.write(root / "instance_masks" / "2.png", np.zeros((24, 32), np.uint16))
    return root


@case("instance", "no image named after a view")
def ground_truth_named_otherwise(root):
    made.write(made.photos(root) / "instance" / "other.png", np.zeros((24, 32), np.uint16))
    return root


@case("walk.mp4", "cannot be opened as a video")
def video_that_is_none(root):
    (root / "walk.mp4").write_bytes(b"nothing")
    return root / "walk.mp4"


@case("walk.mp4", "it is cut short or damaged, or holds no pictures; copy it again.")
def video_of_no_bytes(root):
    (root / "walk.mp4").write_bytes(b"")
    return root / "walk.mp4"


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


@case("camera.txt", "four numbers")
def tum_with_bad_intrinsics(root):
    (made.tum(root) / "camera.txt").write_text("525 525")
    return root


@case("scan.sens", "ends too early")
def sens_that_is_cut(root):
    cut(made.sens(root / "scan.sens"))
    return root / "scan.sens"


@case("scan.sens", "version")
def sens_of_another_version(root):
    (root / "scan.sens").write_bytes(b"\7\0\0\0" + bytes(400))
    return root / "scan.sens"


@pytest.mark.parametrize("name", list(CASES))
def test_a_bad_capture_is_refused_with_one_sentence_that_names_it(name, tmp_path):
    spoil, named, says = CASES[name]
    root = tmp_path / "scene"
    root.mkdir()
    path = spoil(root)
    with pytest.raises(InputError) as refusal:
        read_all(path)
    sentence = str(refusal.value)
    assert says in sentence
    assert named in sentence
    assert "\n" not in sentence and sentence.endswith(".")


@pytest.mark.parametrize("make", [made.photos, made.scannet, made.nerfstudio, made.colmap, made.tum])
def test_the_captures_that_the_cases_spoil_are_sound(make, tmp_path):
    if make is made.tum:
        (tmp_path / "camera.txt").write_text("30 30 15.5 11.5")
    read_all(make(tmp_path))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("file_path", value) for value in (3, None, "", ["a"])),
        *((key, value) for key in ("depth_file_path", "mask_path") for value in (5, True, False, [])),
    ],
)
def test_a_name_of_a_file_that_is_none_is_refused(key, value, tmp_path):
    edit_json(made.nerfstudio(tmp_path), lambda d: d["frames"][1].update({key: value}))
    says = re.escape(f"transforms.json has `{key}` {value!r} in frame 1; the name of a file is expected.")
    with pytest.raises(InputError, match=says):
        open_scene(tmp_path)


def test_a_video_without_a_frame_is_said_to_be_of_a_codec_that_is_not_read(tmp_path, monkeypatch):
    video = made.video(tmp_path / "my walk.avi", count=2)
    whole = SimpleNamespace(isOpened=lambda: True, get=lambda what: 48, grab=lambda: False, release=lambda: None)
    monkeypatch.setattr(cv2, "VideoCapture", lambda file: whole)
    with pytest.raises(InputError, match=r"such as AV1; convert it to H.264 \(ffmpeg -i 'my walk.avi' -c:v libx264"):
        video_frames(video=ref(video))


def test_an_infinite_pose_is_refused_without_a_warning_before(tmp_path):
    edit_json(made.nerfstudio(tmp_path), lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(3, np.inf))
    with pytest.raises(InputError, match=r"transforms\.json for images/10\.png holds NaN or infinite numbers"):
        open_scene(tmp_path)


def test_opencv_alone_would_read_a_cut_jpeg(tmp_path):
    cut(made.photos(tmp_path) / "10.jpg")
    assert cv2.imread(str(tmp_path / "10.jpg")) is not None
