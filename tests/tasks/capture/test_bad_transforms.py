"""A transforms.json that says something impossible, or names what is not there, is refused with one sentence."""

import re
import shutil

import capture_folders as made
import numpy as np
import pytest
from spoilt_captures import Cases, edit_json

from ss_flow.errors import InputError
from ss_flow.tasks.capture.scene import open_scene

case = Cases()


@case("transforms_train.json", "poses are read from transforms.json only; copy it to that name, or move it away")
def transforms_under_another_name(root):
    (made.nerfstudio(root) / "transforms.json").rename(root / "transforms_train.json")
    return root


@case("transforms_train.json", "is not read under this name; copy it to ")
def transforms_named_by_another_name(root):
    return transforms_under_another_name(root) / "transforms_train.json"


@case("transforms.json", "not valid JSON")
def transforms_that_is_no_json(root):
    (made.nerfstudio(root) / "transforms.json").write_text("{")
    return root


@case("transforms.json", "not valid JSON (it is nested too deeply)")
def transforms_without_an_end(root):
    (made.nerfstudio(root) / "transforms.json").write_text('{"frames":' * 200_000)
    return root


@case("transforms.json", "not valid JSON (Exceeds the limit")
def transforms_with_a_number_of_too_many_digits(root):
    (made.nerfstudio(root) / "transforms.json").write_text(f'{{"w": {"9" * 5000}}}')
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


@case("transforms.json", "has `camera_angle_x` 0; an angle in radians is expected, above 0 and below pi")
def transforms_that_see_nothing(root):
    edit_json(made.nerfstudio(root, camera_angle_x=0), lambda d: d.pop("fl_x"))
    return root


@case("transforms.json", "has `camera_angle_y` 40; an angle in radians is expected")
def transforms_with_an_angle_in_degrees(root):
    edit_json(made.nerfstudio(root, camera_angle_x=0.8, camera_angle_y=40), lambda d: d.pop("fl_x"))
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


@case("transforms.json", "`w` nan; a finite number is expected")
def transforms_of_a_width_that_is_no_number(root):
    return made.nerfstudio(root, w=np.nan)


@case("2.png", "its intrinsics are those of a photo of 64x48")
def intrinsics_of_another_size(root):
    return made.nerfstudio(root, w=64, h=48)


@case("transforms.json", "`depth_unit_scale_factor` -0.001; world units per unit")
def depth_in_a_negative_unit(root):
    return made.nerfstudio(root, depth_unit_scale_factor=-0.001)


@case("transforms.json", "has `depth_path` and no `integer_depth_scale`; world units per unit of the depth files are")
def transforms_with_depth_of_instant_ngp_in_no_unit(root):
    text = (made.nerfstudio(root) / "transforms.json").read_text()
    (root / "transforms.json").write_text(text.replace("depth_file_path", "depth_path"))
    return root


@case("transforms.json", "`depth_unit_scale_factor` 0; world units per unit")
def depth_in_no_unit(root):
    return made.nerfstudio(root, depth_unit_scale_factor=0)


@case("transforms.json", "`depth_unit_scale_factor` inf; a finite number is expected")
def depth_in_an_endless_unit(root):
    return made.nerfstudio(root, depth_unit_scale_factor=np.inf)


@case("10.png", "is listed twice; every view needs a photo of its own")
def a_photo_that_is_listed_twice(root):
    edit_json(made.nerfstudio(root), lambda d: d["frames"].append(d["frames"][1]))
    return root


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


@pytest.mark.parametrize("name", case.known)
def test_a_bad_capture_is_refused_with_one_sentence_that_names_it(name, tmp_path):
    case.assert_refused(name, tmp_path)


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


def test_an_infinite_pose_is_refused_without_a_warning_before(tmp_path):
    edit_json(made.nerfstudio(tmp_path), lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(3, np.inf))
    with pytest.raises(InputError, match=r"transforms\.json for images/10\.png holds NaN or infinite numbers"):
        open_scene(tmp_path)
