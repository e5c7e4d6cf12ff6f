"""Depth maps and masks that are no such images, or do not fit their photos, are refused with one sentence."""

import capture_folders as made
import numpy as np
import pytest
from PIL import Image
from spoilt_captures import Cases, edit_json

case = Cases()


@case("depth", "lacks the depth map of 10.jpg")
def depth_of_one_view_missing(root):
    (made.scannet(root) / "depth" / "10.png").unlink()
    return root


@case("10.png", "uint8 pixels")
def depth_of_8_bits(root):
    made.write(made.nerfstudio(root) / "depth" / "10.png", np.full((24, 32), 9, np.uint8))
    return root


@case("10.png", "3 channels")
def depth_in_colour(root):
    made.write(made.nerfstudio(root) / "depth" / "10.png", made.photo())
    return root


@case("depth", "0 everywhere")
def depth_without_a_known_pixel(root):
    made.nerfstudio(root)
    for name in made.NAMES:
        made.write(root / "depth" / f"{name}.png", made.depth_image(0))
    return root


@case("10.npy", "is no image file by its name; PNG of 16 bits or TIFF of 32-bit floats is expected")
def depth_as_an_array_of_numpy(root):
    (made.nerfstudio(root) / "depth" / "10.npy").write_bytes(b"")
    edit_json(root, lambda d: d["frames"][1].update(depth_file_path="depth/10.npy"))
    return root


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


@case("10.png", "has a palette; an image of one channel is expected, so save it as gray")
def valid_mask_with_a_palette(root):
    image = Image.fromarray(np.ones((24, 32), np.uint8))
    image.putpalette(bytes(6))
    image.save(made.scannet(root) / "valid" / "10.png")
    return root


@case("depth", "valid masks (0 = ignored) or the photos' alpha channels leave out every one")
def valid_masks_that_leave_out_everything(root):
    made.scannet(root)
    for name in made.NAMES:
        made.write(root / "valid" / f"{name}.png", np.zeros((24, 32), np.uint8))
    return root


@case("10.png", "valid mask must have its photo's size")
def valid_mask_of_another_size(root):
    made.write(made.scannet(root) / "valid" / "10.png", np.zeros((5, 5), np.uint8))
    return root


@case("10.png", "links to away.png, which is no file")
def ready_mask_that_is_a_dead_link(root):
    made.photos(root)
    for name in made.NAMES:
        made.write(root / "instance_masks" / f"{name}.png", np.zeros((24, 32), np.uint16))
    (root / "instance_masks" / "10.png").unlink()
    (root / "instance_masks" / "10.png").symlink_to("away.png")
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


@case("10.png", "must have its photo's size")
def ground_truth_of_another_size(root):
    made.write(made.scannet(root) / "instance" / "10.png", np.zeros((5, 5), np.uint16))
    return root


@case("instance", "no image named after a view")
def ground_truth_named_otherwise(root):
    made.write(made.photos(root) / "instance" / "other.png", np.zeros((24, 32), np.uint16))
    return root


@pytest.mark.parametrize("name", case.known)
def test_a_bad_capture_is_refused_with_one_sentence_that_names_it(name, tmp_path):
    case.assert_refused(name, tmp_path)
