from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_and_box import HEIGHT, WIDTH, SmallScene

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import ColourTransform
from ss_flow.tasks.gaussians.views import (
    IGNORED,
    NONE_OF_MINE,
    CropParams,
    PointSurface,
    SceneViews,
    background_view,
    crop_camera,
    group_view,
    propagated_depth,
    sample_depth,
    whole_view,
)
from ss_flow.tasks.geometry.cameras import camera_of, project
from ss_flow.tasks.geometry.images import decode_rgb, encode_png
from ss_flow.tasks.geometry.visibility import VisibilityParams


@pytest.fixture(scope="module")
def small() -> SmallScene:
    return SmallScene()


def views_of(small: SmallScene, **changes) -> SceneViews:
    return replace(small.views.compared(VisibilityParams()), **changes)


def built(small: SmallScene, view: int, instance_id: int, scene: SceneViews | None = None, build=group_view, **options):
    surface = PointSurface(small.points[small.labels == instance_id][::3], 0.02)
    channels = np.where(small.ids[view] == instance_id, 0, NONE_OF_MINE).astype(np.int32)
    return build(scene or views_of(small), view, channels, surface, crop=CropParams(), **options)


def hidden_by_box(small: SmallScene, view: int) -> np.ndarray:
    """Pixels of the box behind which a part of the ball lies, by the ball's equation."""
    from ball_and_box import BALL, RADIUS

    from ss_flow.tasks.geometry.cameras import backproject

    camera = camera_of(small.cameras, view)
    rays = backproject(np.ones((HEIGHT, WIDTH), np.float32), camera) - camera.center
    to_ball = BALL - camera.center
    nearest = to_ball - rays * ((rays @ to_ball) / (rays**2).sum(axis=1))[:, None]
    return ((nearest**2).sum(axis=1) < RADIUS**2).reshape(HEIGHT, WIDTH) & (small.ids[view] == 1)


def whole(small: SmallScene, view: int, mask: np.ndarray, camera) -> np.ndarray:
    full = camera_of(small.cameras, view)
    x0, y0 = round(full.cx - camera.cx), round(full.cy - camera.cy)
    image = np.zeros((HEIGHT, WIDTH), bool)
    image[y0 : y0 + camera.height, x0 : x0 + camera.width] = mask
    return image


def test_the_three_kinds_of_pixels_do_not_overlap_and_follow_the_ids(small):
    for view in range(len(small.frames)):
        made = built(small, view, 2)
        assert not (made.inside & made.free).any()
        np.testing.assert_array_equal(made.ids == 0, made.inside)
        np.testing.assert_array_equal(made.ids == NONE_OF_MINE, made.free)
        np.testing.assert_array_equal(made.ids == IGNORED, ~made.inside & ~made.free)
        np.testing.assert_array_equal(whole(small, view, made.inside, made.camera), small.ids[view] == 2)


def test_a_photo_is_trained_on_in_the_colours_of_the_scene(small):
    matrix = np.array([[1.5, 0.1, 0, 0.02], [0, 0.8, 0, -0.01], [0, 0.2, 1.1, 0]])
    even = ColourTransform("v1", "v0", matrix)
    same = ColourTransform("v0", "v0", np.eye(4)[:3])
    scene = views_of(small, colours=(same, even, *(same,) * (len(small.frames) - 2)))
    plain, changed = built(small, 1, 1), built(small, 1, 1, scene)
    np.testing.assert_allclose(changed.image, plain.image @ matrix[:, :3].T + matrix[:, 3], atol=1e-6)
    np.testing.assert_array_equal(built(small, 0, 1, scene).image, built(small, 0, 1).image)
    assert changed.image.max() > 1  # what is bright in the scene may be brighter than a photo can show


def test_where_the_box_hides_the_ball_the_ball_is_ignored_and_elsewhere_free(small):
    hidden_somewhere = 0
    for view in range(len(small.frames)):
        made = built(small, view, 2)
        ignored = whole(small, view, ~made.inside & ~made.free, made.camera)
        box = whole(small, view, np.ones_like(made.inside), made.camera)
        hidden = hidden_by_box(small, view) & box
        hidden_somewhere += hidden.sum()
        # What no view shows has no points; what they show must be found, up to a pixel of border.
        if hidden.sum() > 40:
            assert (ignored & hidden).sum() > 0.6 * hidden.sum()
        border = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        assert (ignored & ~border).sum() <= 4
    assert hidden_somewhere > 200


def test_the_paper_calls_hidden_pixels_empty(small):
    for view in range(len(small.frames)):
        made = built(small, view, 2, ignore_occluded=False)
        np.testing.assert_array_equal(made.free, ~made.inside)


def test_the_background_is_unknown_behind_the_objects(small):
    made = built(small, 0, 0, build=background_view)
    # At the foot of an object the floor in front of it is taken to go on for a pixel.
    assert made.free.sum() <= 0.05 * (small.ids[0] != 0).sum()
    assert built(small, 0, 0).free.sum() > made.free.sum()
    np.testing.assert_array_equal(whole(small, 0, made.inside, made.camera), small.ids[0] == 0)


def test_masked_out_pixels_are_neither_inside_nor_free(small):
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[:, : WIDTH // 2] = 0
    frames = (replace(small.frames[0], valid=encode_png(valid)), *small.frames[1:])
    made = built(small, 0, 1, views_of(small, frames=frames))
    left = whole(small, 0, made.inside | made.free, made.camera)[:, : WIDTH // 2]
    assert not left.any()
    assert made.inside.any()


def test_where_a_photo_is_scaled_down_the_colour_of_masked_out_pixels_reaches_none_that_count(small):
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[HEIGHT // 3 : HEIGHT // 2, WIDTH // 3 : WIDTH // 2] = 0

    def filled(color: int):
        photo = decode_rgb(small.frames[0]).copy()
        photo[valid == 0] = color
        frame = replace(small.frames[0], encoded=encode_png(photo), valid=encode_png(valid))
        scene = views_of(small, frames=(frame, *small.frames[1:]))
        return whole_view(scene, 0, np.zeros((HEIGHT, WIDTH), np.int32), WIDTH * 3 // 7)

    dark, bright = filled(0), filled(255)
    assert (dark.image != bright.image).any() and 0.5 < dark.inside.mean() < 1
    np.testing.assert_array_equal(dark.image[dark.inside], bright.image[bright.inside])


def test_without_known_depth_nothing_outside_the_mask_is_called_free_near_the_surface(small):
    depths = tuple(replace(d, depth=np.zeros_like(d.depth)) for d in small.depths)
    made = built(small, 0, 1, views_of(small, depths=depths))
    surface = propagated_depth(small.points[small.labels == 1][::3], made.camera, 0.02) > 0
    assert not (made.free & surface).any()


def test_a_crop_sees_the_same_points_at_its_own_pixels(small):
    full = camera_of(small.cameras, 3)
    points = small.points[small.labels == 2]
    crop = crop_camera(full, small.ids[3] == 2, points, CropParams(margin_px=4, max_side=15))
    assert max(crop.width, crop.height) == 15
    inside, _ = project(points, crop)
    assert (
        (inside > -0.5).all() and (inside[:, 0] < crop.width + 0.5).all() and (inside[:, 1] < crop.height + 0.5).all()
    )


def test_the_depth_of_a_crop_is_the_depth_at_the_pixels_it_shows(small):
    full = camera_of(small.cameras, 1)
    crop = full.cropped(20, 10, 60, 50)
    np.testing.assert_array_equal(sample_depth(small.depths[1], full, crop), small.depths[1].depth[10:50, 20:60])
    half = crop.scaled(20, 20)
    np.testing.assert_array_equal(sample_depth(small.depths[1], full, half), small.depths[1].depth[11:50:2, 21:60:2])


def test_propagated_depth_is_close_to_the_true_depth_of_a_surface_seen_by_points(small):
    camera = camera_of(small.cameras, 0)
    own = small.ids[0] == 1
    found = propagated_depth(small.points[small.labels == 1][::3], camera, 0.02)
    both = own & (found > 0)
    assert both.sum() > 0.99 * own.sum()
    assert np.median(np.abs(found - small.depths[0].depth)[both]) < 0.03


def test_masks_of_another_size_than_the_frame_are_refused(small):
    with pytest.raises(InputError, match=r"Frame v0 is 96 x 72 pixels and its masks are 5 x 4"):
        group_view(
            views_of(small), 0, np.zeros((4, 5), np.int32), PointSurface(small.points[:9], 0.02), crop=CropParams()
        )


def test_the_view_of_a_whole_scene_is_the_entire_photo(small):
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[:, :10] = 0
    frames = (replace(small.frames[0], valid=encode_png(valid)), *small.frames[1:])
    channels = np.where(small.ids[0] == 1, 0, np.where(small.ids[0] == 2, NONE_OF_MINE, IGNORED)).astype(np.int32)
    made = whole_view(views_of(small, frames=frames), 0, channels, WIDTH)
    assert (made.camera.width, made.camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(made.inside, (small.ids[0] == 1) & (valid > 0))
    np.testing.assert_array_equal(made.free, (small.ids[0] == 2) & (valid > 0))
    half = whole_view(views_of(small), 0, channels, WIDTH // 2)
    assert (half.camera.width, half.camera.height) == (WIDTH // 2, HEIGHT // 2)
