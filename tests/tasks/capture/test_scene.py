"""Which capture a place holds, and what of it is used: photos, videos, masks that lie beside them."""

import sys
import time
from pathlib import Path

import capture_folders as made
import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.capture import ingest
from ss_flow.tasks.capture.scene import open_scene

SHARED = Path(__file__).parents[3] / ".." / "shared" / "data"


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
    scene = open_scene(tmp_path / "rgbd")
    assert scene.names == ("2", "10", "11")
    assert scene.remarks[0].startswith(
        f"{tmp_path / 'rgbd/2.depth.pgm'} is not used, nor what else of PGM and its kin (1)"
    )


@pytest.mark.parametrize(
    ("layout", "part"),
    [("stray", "rgb.mp4"), ("scannet", "color"), ("colmap", "images"), ("polycam", "keyframes/images")],
)
def test_where_photos_or_the_video_of_a_posed_capture_are_named_alone_the_run_says_what_it_does_without(
    layout, part, tmp_path
):
    place = getattr(made, layout)(tmp_path / "kitchen") / part
    (said,) = open_scene(place).remarks
    assert said.startswith(f"{place} is used without the poses or the depth that lie beside it; give {place.parent} to")
    assert open_scene(tmp_path / "kitchen").remarks == ()


@pytest.mark.parametrize("layout", ["scannet", "tum", "replica", "polycam", "stray"])
def test_a_capture_in_the_only_folder_of_what_is_named_is_told(layout, tmp_path):
    getattr(made, layout)(tmp_path / "kitchen")
    (tmp_path / "__MACOSX").mkdir()
    with pytest.raises(InputError, match=r"its folder kitchen/ is a capture with poses or depth, so give that\.$"):
        open_scene(tmp_path)


def test_what_record3d_exports_is_told_how_to_be_read(tmp_path):
    made.photos(tmp_path / "rgb")
    (tmp_path / "metadata.json").write_text("{}")
    with pytest.raises(InputError, match=r"Record3D's exports are read once nerfstudio has made a transforms\.json"):
        open_scene(tmp_path)


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


def test_a_recording_beside_photos_is_told_unless_it_belongs_to_one_of_them(tmp_path):
    made.photos(tmp_path)
    (tmp_path / "2.MOV").write_bytes(b"")
    assert open_scene(tmp_path).remarks == ()
    (tmp_path / "walk.mp4").write_bytes(b"")
    said = f"{tmp_path / 'walk.mp4'} is not used, as photos lie beside it; give its own path to use it."
    assert open_scene(tmp_path).remarks == (said,)


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


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real captures are not beside the project")
def test_the_real_captures_open():
    shelf, office = open_scene(SHARED / "apc_shelf"), open_scene(SHARED / "hololens_office")
    assert (len(shelf.names), shelf.kind, len(shelf.ground_truth)) == (15, "scannet", 15)
    assert (len(office.names), office.kind, office.metric) == (75, "nerfstudio", True)


def test_runs_of_a_file_are_recorded_under_it_and_those_of_a_folder_under_the_folder(tmp_path):
    video = made.video(tmp_path / "a.avi", count=4)
    assert open_scene(video).place == video
    assert open_scene(tmp_path).place == tmp_path
    folder = made.nerfstudio(tmp_path / "posed")
    assert open_scene(folder / "transforms.json").place == folder / "transforms.json"
    assert open_scene(folder).place == folder
