import json
import shutil
import sys
import time
import unicodedata
from dataclasses import replace
from pathlib import Path

import capture_folders as made
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.capture import ingest
from ss_flow.tasks.capture.layout_colmap import read_points
from ss_flow.tasks.capture.names import capture_name, natural_key
from ss_flow.tasks.capture.scene import open_scene

SHARED = Path(__file__).parents[3] / ".." / "shared" / "data"
WORLD_TO_CAMERA = np.stack([np.linalg.inv(made.pose(i)) for i in range(3)])


def assert_cameras(scene, fy=30.0):
    np.testing.assert_allclose(scene.world_to_camera, WORLD_TO_CAMERA, atol=1e-6)
    for lens in scene.lenses:
        assert (lens.fx, lens.fy, lens.cx, lens.cy) == (30.0, fy, 16.0, 12.0)


def test_a_folder_of_photos_is_sorted_as_people_count(tmp_path):
    scene = open_scene(made.photos(tmp_path))
    assert scene.kind == "photos"
    assert scene.names == ("2", "10", "11")
    assert scene.poses is None and scene.depths is None and not scene.metric
    assert scene.valid == (None, None, None)


def test_a_folder_named_like_a_photo_is_none_and_links_to_photos_are(tmp_path):
    made.photos(tmp_path / "away")
    (tmp_path / "scene/album.jpg").mkdir(parents=True)
    for name in made.NAMES:
        (tmp_path / f"scene/{name}.jpg").symlink_to(tmp_path / f"away/{name}.jpg")
    assert open_scene(tmp_path / "scene").names == ("2", "10", "11")


def test_photos_may_lie_in_a_folder_images(tmp_path):
    made.photos(tmp_path / "images")
    assert open_scene(tmp_path).names == ("2", "10", "11")


def test_pgm_and_its_kin_are_photos_unless_they_lie_beside_other_formats(tmp_path):
    for suffix in ("pgm", "ppm", "pnm"):
        for i, name in enumerate(made.NAMES):
            made.write(tmp_path / suffix / f"{name}.{suffix}", made.photo(i)[..., : 1 if suffix == "pgm" else 3])
        scene = open_scene(tmp_path / suffix)
        assert (scene.kind, scene.names, scene.skipped) == ("photos", ("2", "10", "11"), ())
        views = ingest.frames(names=scene.names, photos=made.refs(scene.photos))
        assert [(view.width, view.height) for view in views] == [(32, 24)] * 3
    made.photos(tmp_path / "rgbd")
    made.write(tmp_path / "rgbd/2.depth.pgm", made.depth_image())
    assert open_scene(tmp_path / "rgbd").names == ("2", "10", "11")


def test_scannet_has_metric_poses_and_half_a_pixel_is_added_to_its_centres(tmp_path):
    scene = open_scene(made.scannet(tmp_path))
    assert scene.kind == "scannet" and scene.metric and scene.depth_scale == 0.001
    assert_cameras(scene)
    assert (scene.depth_lens.fx, scene.depth_lens.cx, scene.depth_lens.cy) == (15.0, 8.0, 6.0)
    assert [p.name for p in scene.depths] == ["2.png", "10.png", "11.png"]
    assert [p.parent.name for p in scene.ground_truth] == ["instance"] * 3
    assert [p.parent.name for p in scene.valid] == ["valid"] * 3


@pytest.mark.parametrize("lost", [-np.inf, np.nan, "one number"])
def test_scannet_views_whose_tracking_was_lost_are_skipped(tmp_path, lost):
    made.scannet(tmp_path)
    pose = np.full((4, 4), lost) if lost != "one number" else made.pose(0)
    if lost == "one number":
        pose[0, 3] = np.nan
    np.savetxt(tmp_path / "pose" / "10.txt", pose)
    scene = open_scene(tmp_path)
    assert scene.names == ("2", "11") and scene.skipped == ("10",)
    assert len(scene.depths) == len(scene.ground_truth) == len(scene.valid) == 2


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


def test_photos_that_a_colmap_model_lacks_or_that_are_not_read_are_skipped(tmp_path):
    made.colmap(tmp_path / "colmap", binary=True)
    assert open_scene(tmp_path / "colmap").skipped == ()
    (tmp_path / "colmap/images/12.png").write_bytes((tmp_path / "colmap/images/2.png").read_bytes())
    assert open_scene(tmp_path / "colmap").skipped == ("12",)
    loose = made.photos(tmp_path / "loose")
    (next(loose.rglob("2.*")).parent / "IMG_3.DNG").write_bytes(b"")
    assert open_scene(loose).skipped == ("IMG_3.DNG",)


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


def test_a_video_is_known_by_its_name_alone(tmp_path):
    (tmp_path / "walk.MP4").write_bytes(b"")
    assert open_scene(tmp_path / "walk.MP4").kind == "video"
    assert open_scene(tmp_path).recording == tmp_path / "walk.MP4"
    for name in ("walk.mpg", "walk.mpeg", "walk.MTS", "walk.m2ts", "walk.ts", "walk.3gp"):
        (tmp_path / name).write_bytes(b"")
        assert open_scene(tmp_path / name).kind == "video"


def test_ready_masks_are_found_beside_any_layout_or_where_they_are_said_to_be(tmp_path):
    made.photos(tmp_path / "scene")
    for name in made.NAMES:
        made.write(tmp_path / "elsewhere" / f"{name}.png", np.zeros((made.HEIGHT, made.WIDTH), np.uint16))
    assert open_scene(tmp_path / "scene").ready_masks is None
    assert len(open_scene(tmp_path / "scene", masks=tmp_path / "elsewhere").ready_masks) == 3
    (tmp_path / "elsewhere").rename(tmp_path / "scene" / "instance_masks")
    assert open_scene(tmp_path / "scene").ready_masks[1].name == "10.png"


def test_a_transforms_json_brings_what_lies_beside_it_as_its_folder_does(tmp_path):
    made.nerfstudio(tmp_path)
    for folder in ("instance", "valid", "instance_masks"):
        for name in made.NAMES:
            made.write(tmp_path / folder / f"{name}.png", np.zeros((made.HEIGHT, made.WIDTH), np.uint16))
    (tmp_path / "instances.json").write_text('{"0": "table"}')
    folder, file = open_scene(tmp_path), open_scene(tmp_path / "transforms.json")
    assert file.ready_masks and file.ground_truth and all(file.valid) and not file.zero_is_void
    assert replace(file, opened=tmp_path) == folder


def test_every_second_view_keeps_everything_aligned(tmp_path):
    scene = open_scene(made.scannet(tmp_path)).every(2)
    assert scene.names == ("2", "11")
    assert [p.stem for p in (*scene.photos, *scene.depths, *scene.valid, *scene.ground_truth)] == ["2", "11"] * 4
    np.testing.assert_allclose(scene.world_to_camera, WORLD_TO_CAMERA[[0, 2]], atol=1e-9)


@pytest.mark.parametrize("layout", ["scannet", "nerfstudio", "tum", "colmap", "sens", "photos"])
def test_views_that_are_left_out_count_among_every_so_many(tmp_path, layout):
    if layout == "sens":  # whose second frame is lost
        place, names = made.sens(tmp_path / "a.sens", count=5), [f"frame-{i:06d}" for i in range(5)]
    else:
        place, names = getattr(made, layout)(tmp_path), ["2", "10", "11"]
    if layout == "scannet":
        np.savetxt(tmp_path / "pose" / "10.txt", np.full((4, 4), -np.inf))
    elif layout == "nerfstudio":
        (tmp_path / "images" / "10.png").unlink()
    elif layout == "tum":
        (tmp_path / "depth.txt").write_text((tmp_path / "depth.txt").read_text().replace("101.01", "101.03"))
    elif layout == "colmap":
        (tmp_path / "images" / "1.png").write_bytes((tmp_path / "images" / "2.png").read_bytes())
        names = ["1", *names]
    elif layout == "photos":
        (tmp_path / "10.jpg").rename(tmp_path / "10.dng")
    whole = open_scene(place)
    (lost,) = whole.skipped
    place_of_lost = names.index(Path(lost).stem)
    assert [Path(name).stem for name in whole.all_names] == names
    assert whole.every(1) == whole
    for stride in (2, 3):
        part = whole.every(stride)
        assert part.names == tuple(name for name in names[::stride] if name != Path(lost).stem)
        assert part.skipped == ((lost,) if place_of_lost % stride == 0 else ())


def test_a_stride_that_meets_lost_views_only_is_refused(tmp_path):
    made.scannet(tmp_path)
    for name in ("2", "11"):
        np.savetxt(tmp_path / "pose" / f"{name}.txt", np.full((4, 4), -np.inf))
    with pytest.raises(InputError, match=r"has no view that can be used .*capture\.stride.*; take another"):
        open_scene(tmp_path).every(2)


def test_a_raw_file_beside_its_photo_is_no_view_that_is_left_out(tmp_path):
    made.photos(tmp_path)
    (tmp_path / "10.dng").write_bytes(b"")
    assert open_scene(tmp_path).skipped == ()


@pytest.mark.parametrize("suffix", ["rw2", "orf", "jxl", "gif"])
def test_photos_of_formats_that_are_not_read_are_left_out_by_name(tmp_path, suffix):
    made.photos(tmp_path)
    (tmp_path / f"12.{suffix}").write_bytes(b"")
    assert open_scene(tmp_path).skipped == (f"12.{suffix}",)


def test_jpeg_by_the_name_that_browsers_on_windows_give_it_is_a_photo(tmp_path):
    made.photos(tmp_path)
    (tmp_path / "10.jpg").rename(tmp_path / "10.jfif")
    scene = open_scene(tmp_path)
    assert scene.names == ("2", "10", "11")
    assert len(ingest.frames(names=scene.names, photos=made.refs(scene.photos))) == 3


@pytest.mark.parametrize("photos", [".", "images"])
def test_folders_of_images_beside_photos_that_are_not_used_are_told(tmp_path, photos):
    made.photos(tmp_path / photos)
    for used in ("images_4", "valid", "held_out/images", "made"):
        for i, name in enumerate(made.NAMES):
            made.write(tmp_path / used / f"{name}.png", np.full((made.HEIGHT, made.WIDTH), i + 1, np.uint16))
    masks = (tmp_path / "made").absolute()
    assert open_scene(tmp_path, masks=masks).remarks == ()
    made.photos(tmp_path / "day2")
    made.write(tmp_path / "depth/2.png", made.depth_image())
    (said,) = open_scene(tmp_path, masks=masks).remarks
    assert said.startswith(f"{tmp_path} holds images that are not used, in day2/ (3), depth/ (1): ")


@pytest.mark.parametrize("layout", ["photos", "scannet", "nerfstudio", "tum", "colmap"])
def test_a_folder_gives_its_capture_its_whole_name(tmp_path, layout, monkeypatch):
    root = getattr(made, layout)(tmp_path / "room 2024.05.01")
    monkeypatch.chdir(root)
    assert open_scene(root).name == open_scene(Path()).name == capture_name(root) == "room 2024.05.01"


def test_a_file_gives_its_capture_its_stem_and_a_transforms_json_its_folders_name(tmp_path, monkeypatch):
    assert open_scene(made.video(tmp_path / "walk.1.avi", count=2)).name == "walk.1"
    folder = made.nerfstudio(tmp_path / "kitchen")
    monkeypatch.chdir(folder)
    assert open_scene(folder / "transforms.json").name == open_scene(Path("transforms.json")).name == "kitchen"
    assert open_scene(folder).name == "kitchen"


def rig(root):
    """A COLMAP workspace of two cameras, whose photos have the same names in two folders."""
    made.colmap(root, binary=False)
    (root / "images" / "cam1").mkdir()
    (root / "images" / "cam2").mkdir()
    for old, new in (("2", "cam1/1"), ("10", "cam1/2"), ("11", "cam2/1")):
        (root / "images" / f"{old}.png").rename(root / "images" / f"{new}.png")
        for model in ("0", "1"):
            file = root / "sparse" / model / "images.txt"
            file.write_text(file.read_text().replace(f" {old}.png", f" {new}.png"))
    return root


def test_photos_of_one_stem_in_several_folders_are_called_by_their_path(tmp_path):
    scene = open_scene(rig(tmp_path))
    assert scene.names == ("cam1_1", "cam1_2", "cam2_1")
    made.write(tmp_path / "images" / "cam2" / "2.png", made.photo())
    (tmp_path / "valid").mkdir()
    made.write(tmp_path / "valid" / "cam1_2.png", made.photo()[..., 0])
    made.write(tmp_path / "valid" / "cam2" / "1.png", made.photo()[..., 0])
    scene = open_scene(tmp_path)
    assert scene.skipped == ("cam2_2",) and scene.all_names[-1] == "cam2_2"
    assert scene.valid == (None, tmp_path / "valid/cam1_2.png", tmp_path / "valid/cam2/1.png")


def test_photos_of_a_transforms_json_are_called_by_their_path_only_where_stems_clash(tmp_path):
    made.nerfstudio(tmp_path)
    for old, new in (("2", "cam1/1"), ("10", "cam1/2"), ("11", "cam2/3")):
        (tmp_path / "images" / new).parent.mkdir(exist_ok=True)
        (tmp_path / f"images/{old}.png").rename(tmp_path / f"images/{new}.png")
        text = (tmp_path / "transforms.json").read_text().replace(f"images/{old}.png", f"images/{new}.png")
        (tmp_path / "transforms.json").write_text(text)
    assert open_scene(tmp_path).names == ("1", "2", "3")
    (tmp_path / "images/cam2/3.png").rename(tmp_path / "images/cam2/1.png")
    (tmp_path / "transforms.json").write_text(text.replace("cam2/3.png", "cam2/1.png"))
    assert open_scene(tmp_path).names == ("cam1_1", "cam1_2", "cam2_1")


def test_photos_of_one_stem_in_one_folder_are_both_named_when_they_are_refused(tmp_path):
    made.photos(tmp_path)
    made.write(tmp_path / "10.png", made.photo())
    with pytest.raises(InputError) as refused:
        open_scene(tmp_path)
    assert str(refused.value).startswith(f"{tmp_path / '10.jpg'} and {tmp_path / '10.png'} both belong to view 10")


def test_opening_is_light_and_quick(tmp_path):
    import subprocess

    made.nerfstudio(tmp_path)
    code = (
        "import sys; from pathlib import Path; from ss_flow.tasks.capture.scene import open_scene;"
        f"open_scene(Path({str(tmp_path)!r}));"
        "print([m for m in ('cv2', 'torch', 'pycolmap', 'scipy', 'onnxruntime') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_a_hundred_photos_open_in_less_than_a_tenth_of_a_second(tmp_path):
    for i in range(100):
        (tmp_path / f"{i}.jpg").write_bytes(b"\xff\xd8")
    before = time.process_time()
    assert len(open_scene(tmp_path).names) == 100
    assert time.process_time() - before < 0.1


@given(st.lists(st.integers(0, 10**6), min_size=1))
def test_numbers_in_names_sort_by_value(numbers):
    names = [f"frame_{n}.jpg" for n in numbers]
    assert sorted(names, key=natural_key) == [f"frame_{n}.jpg" for n in sorted(numbers)]


def test_names_may_hold_digits_that_are_no_decimals():
    assert sorted(["\u00b22.jpg", "1\u00b212.jpg", "1\u00b22.jpg"], key=natural_key)[:2] == [
        "1\u00b22.jpg",
        "1\u00b212.jpg",
    ]


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real captures are not beside the project")
def test_the_real_captures_open():
    shelf, office = open_scene(SHARED / "apc_shelf"), open_scene(SHARED / "hololens_office")
    assert (len(shelf.names), shelf.kind, len(shelf.ground_truth)) == (15, "scannet", 15)
    assert (len(office.names), office.kind, office.metric) == (75, "nerfstudio", True)


def test_frames_of_a_transforms_json_whose_photo_is_missing_are_left_out_with_a_warning(tmp_path):
    made.nerfstudio(tmp_path)
    whole = open_scene(tmp_path)
    (tmp_path / "images" / "10.png").unlink()
    scene = open_scene(tmp_path)
    assert scene.skipped == ("10",) and scene.names == tuple(name for name in whole.names if name != "10")
    files = tuple(FileRef(photo, "") for photo in scene.photos)
    with pytest.warns(UserWarning, match="1 view is left out, without a readable photo, a pose or a depth map: 10."):
        ingest.frames(names=scene.names, photos=files, lenses=scene.lenses, skipped=scene.skipped)


def test_photos_that_a_colmap_model_did_not_register_are_skipped_by_name(tmp_path):
    assert open_scene(made.colmap(tmp_path / "all")).skipped == ()
    scene = open_scene(made.colmap(tmp_path / "some", registered=2))
    assert scene.names == tuple(made.NAMES[:2])
    assert scene.skipped == tuple(made.NAMES[2:])


def test_photos_of_a_folder_of_which_a_colmap_model_registered_none_are_skipped_by_name_too(tmp_path):
    made.colmap(tmp_path)
    for name in ("b/2", "b/3", "c/deep/4"):
        made.write(tmp_path / f"images/{name}.png", made.photo())
    scene = open_scene(tmp_path)
    assert scene.names == made.NAMES and scene.skipped == ("b_2", "3", "4")


def test_runs_of_a_file_are_recorded_under_it_and_those_of_a_folder_under_the_folder(tmp_path):
    video = made.video(tmp_path / "a.avi", count=4)
    assert open_scene(video).place == video
    assert open_scene(tmp_path).place == tmp_path
    folder = made.nerfstudio(tmp_path / "posed")
    assert open_scene(folder / "transforms.json").place == folder / "transforms.json"
    assert open_scene(folder).place == folder


def test_masks_belong_to_their_photos_whichever_way_their_names_write_an_accent(tmp_path):
    composed, apart = (unicodedata.normalize(form, "Küche") for form in ("NFC", "NFD"))
    made.write(tmp_path / f"{composed}.jpg", np.zeros((24, 32, 3), np.uint8))
    for folder in ("instance", "instance_masks"):
        made.write(tmp_path / folder / f"{apart}.png", np.zeros((24, 32), np.uint16))
    scene = open_scene(tmp_path)
    assert [file.name for file in (*scene.ground_truth, *scene.ready_masks)] == [f"{apart}.png"] * 2
