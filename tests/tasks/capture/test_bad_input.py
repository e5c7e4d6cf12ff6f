"""Every path, photo or video that is no capture is refused with one sentence that names what is wrong."""

import sys
from pathlib import Path
from types import SimpleNamespace

import capture_folders as made
import cv2
import pytest
from capture_folders import ref
from spoilt_captures import Cases, cut, read_all

from ss_flow.errors import InputError
from ss_flow.tasks.capture.video import video_frames

case = Cases()


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


@case("scene", "its folder dense/ is a capture with poses or depth, so give that.")
def folder_of_a_workspace_among_others(root):
    made.colmap(root / "dense")
    made.photos(root / "walk")
    return root


@case("scene", "holds photos (3), and so does its folder images/ (3); give ")
def photos_here_and_there(root):
    made.photos(root / "images")
    return made.photos(root)


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


@case("10.png", "both belong to view 10; every view needs its own stem")
def two_photos_of_one_stem(root):
    made.write(made.photos(root) / "10.png", made.photo())
    return root


@case("10.jpg", "links to /nowhere/10.jpg, which is no file")
def photo_that_is_a_dead_link(root):
    (made.photos(root) / "10.jpg").unlink()
    (root / "10.jpg").symlink_to("/nowhere/10.jpg")
    return root


@case("10.jpg", "cut short or damaged")
def photo_that_is_a_cut_jpeg(root):
    cut(made.photos(root) / "10.jpg")
    return root


@case("10.jpg", "is expected. Of the photos after it 1 cannot be read either: 11.jpg.")
def a_cut_photo_and_an_empty_one(root):
    made.photos(root)
    cut(root / "10.jpg")
    (root / "11.jpg").write_bytes(b"")
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


@case("10.jpg", "cut short or damaged")
def photo_that_is_empty(root):
    (made.photos(root) / "10.jpg").write_bytes(b"")
    return root


@case("walk.mp4", "cannot be opened as a video")
def video_that_is_none(root):
    (root / "walk.mp4").write_bytes(b"nothing")
    return root / "walk.mp4"


@case("walk.mp4", "it is cut short or damaged, or holds no pictures; copy it again.")
def video_of_no_bytes(root):
    (root / "walk.mp4").write_bytes(b"")
    return root / "walk.mp4"


@case("scan.sens", "ends too early")
def sens_that_is_cut(root):
    cut(made.sens(root / "scan.sens"))
    return root / "scan.sens"


@case("scan.sens", "version")
def sens_of_another_version(root):
    (root / "scan.sens").write_bytes(b"\7\0\0\0" + bytes(400))
    return root / "scan.sens"


@pytest.mark.parametrize("name", case.known)
def test_a_bad_capture_is_refused_with_one_sentence_that_names_it(name, tmp_path):
    case.assert_refused(name, tmp_path)


@pytest.mark.parametrize("make", [made.photos, made.scannet, made.nerfstudio, made.colmap, made.tum])
def test_the_captures_that_the_cases_spoil_are_sound(make, tmp_path):
    if make is made.tum:
        (tmp_path / "camera.txt").write_text("30 30 15.5 11.5")
    read_all(make(tmp_path))


def test_opencv_alone_would_read_a_cut_jpeg(tmp_path):
    cut(made.photos(tmp_path) / "10.jpg")
    assert cv2.imread(str(tmp_path / "10.jpg")) is not None


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are UTF-8 there")
def test_a_video_whose_path_is_no_text_is_refused(tmp_path):
    video = made.video(tmp_path / "a.avi", count=2).rename(tmp_path / "a\udcff.avi")
    with pytest.raises(InputError, match="not written in UTF-8; rename it"):
        video_frames(video=ref(video))


def test_a_video_without_a_frame_is_said_to_be_of_a_codec_that_is_not_read(tmp_path, monkeypatch):
    video = made.video(tmp_path / "my walk.avi", count=2)
    whole = SimpleNamespace(isOpened=lambda: True, get=lambda what: 48, grab=lambda: False, release=lambda: None)
    monkeypatch.setattr(cv2, "VideoCapture", lambda file: whole)
    with pytest.raises(InputError, match=r"such as AV1; convert it to H.264 \(ffmpeg -i 'my walk.avi' -c:v libx264"):
        video_frames(video=ref(video))
