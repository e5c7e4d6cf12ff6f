import numpy as np
import pytest
from clouds import even_cloud
from view_masks import as_fields

from ss_flow.tasks.artifacts import (
    Cameras,
    DepthMap,
    Descriptors,
    Frame,
    Gaussians,
    Hierarchy,
    InstanceMasks,
    LabelMap,
    MaskSet,
    Metrics,
    PointLabels,
    PointParts,
    Visibility,
)
from ss_flow.tasks.deliver.draw import draw
from ss_flow.tasks.deliver.palette import instance_color
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.masks.pool import masks_by_id
from ss_flow.tasks.models.colour_words import TERMS
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.semantics.query import query

H, W = 48, 64
NONE_I, NONE_F = np.zeros(0, np.int32), np.zeros(0, np.float32)
PHOTO = np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8)
FRAME = Frame("left", W, H, encode_png(PHOTO), np.zeros(0, np.uint8), W, H)
POINTS = np.random.default_rng(1).uniform(-1, 1, (500, 3)).astype(np.float32) + np.float32([0, 0, 4])
CLOUD = even_cloud(POINTS, np.full((500, 3), (10, 200, 30), np.uint8), 1.0, 0.1)
CAMERAS = Cameras(("left",), np.array([[W, H]], np.int32), np.array([[50.0, 50, 32, 24]]), np.eye(4)[None], True)
HALF = np.zeros((H, W), bool)
HALF[:, :32] = True

EMPTY_3 = np.zeros((0, 3), np.float32)
NO_GAUSSIANS = Gaussians(
    EMPTY_3, np.zeros((0, 4), np.float32), EMPTY_3, NONE_F, np.zeros((0, 1, 3), np.float32), NONE_I, NONE_F, NONE_I
)


def labels_of(label: np.ndarray) -> PointLabels:
    return PointLabels(label.astype(np.int32), np.ones(len(label), np.float32), 5, NONE_I, NONE_I, NONE_I)


def instance_of(masks: np.ndarray, views: list[int]) -> InstanceMasks:
    n = len(views)
    return InstanceMasks(
        **as_fields(masks.reshape(n, H, W)), views=tuple(("left", "b", "c", "right")[k] for k in views), instance_id=2,
        points=POINTS, colors=CLOUD.colors, point_confidence=np.ones(500, np.float32),
        point_part=np.zeros(500, np.int32), confidence=0.9, origin=np.zeros(n, np.uint8), weak=False,
    )  # fmt: skip


def has_color(picture: np.ndarray, color) -> bool:
    return bool((picture == np.array(color)).all(axis=2).any())


def test_a_frame_is_its_photo():
    np.testing.assert_array_equal(draw(FRAME), PHOTO)


def test_masks_are_painted_and_small_ones_lie_on_top():
    small = np.zeros((H, W), bool)
    small[10:20, 5:15] = True
    both = np.stack([small, HALF])
    masks = MaskSet(
        **vars(Masks.of(both)), name="left", height=H, width=W, predicted_iou=np.ones(2, np.float32),
        stability=np.ones(2, np.float32), grid=np.zeros(2, np.int32), parent=np.zeros(2, np.int32), source="own",
    )  # fmt: skip
    picture = draw(masks)
    assert picture.shape == (H, W, 3)
    assert tuple(picture[15, 10]) == instance_color(1) and tuple(picture[40, 10]) == instance_color(2)
    tinted = draw(masks, frame=FRAME)
    np.testing.assert_array_equal(tinted[5, 50], (PHOTO[5, 50] * 0.8).astype(np.uint8))


def test_a_photo_of_another_size_is_left_out():
    ids = LabelMap("left", np.ones((H * 2, W * 2), np.uint16))
    np.testing.assert_array_equal(draw(ids, frame=FRAME), draw(ids))


def test_depth_has_a_legend_below():
    picture = draw(DepthMap("left", np.linspace(1, 2, H * W, dtype=np.float32).reshape(H, W), "sensor"))
    assert picture.shape[1] == W and picture.shape[0] > H
    assert (picture[H + 4, :, 0] != picture[H + 4, ::-1, 0]).any()
    wide = draw(DepthMap("left", np.ones((H, 400), np.float32), "sensor"))
    assert 0 < len(wide) - H < len(picture) - H, "a narrow one has two lines of text"


def test_points_are_seen_from_a_view_or_from_outside():
    outside, inside = draw(CLOUD), draw(CLOUD, cameras=CAMERAS)
    assert outside.shape == (720, 960, 3) and inside.shape == (H, W, 3)
    assert has_color(outside, (10, 200, 30)) and has_color(inside, (10, 200, 30))


def test_labels_take_the_colors_of_their_instances():
    label = np.where(POINTS[:, 0] > 0, 3, 0)
    picture = draw(labels_of(label), points=CLOUD, cameras=CAMERAS)
    assert has_color(picture[:, W // 2 :], instance_color(3)) and has_color(picture[:, : W // 2], (190, 190, 190))
    assert not has_color(picture[:, : W // 3], instance_color(3))


def test_parts_have_colors_of_their_own():
    picture = draw(PointParts(np.where(POINTS[:, 0] > 0, 1, 0).astype(np.int32)), points=CLOUD, cameras=CAMERAS)
    assert has_color(picture[:, W // 2 :], instance_color(1)) and has_color(picture[:, : W // 2], (190, 190, 190))


def test_labels_and_parts_without_points_are_counted():
    assert draw(labels_of(np.array([0, 1, 1]))).shape[1] == 800
    assert draw(PointParts(np.array([0, 1, 1], np.int32))).shape[1] == 800


def test_an_instance_is_shown_in_its_views():
    instance = instance_of(np.stack([HALF, ~HALF]), [0, 3])
    picture = draw(instance, frames=(FRAME,))
    assert picture.shape[1] == 1400 and has_color(picture, instance_color(2))


def test_an_instance_without_masks_is_shown_by_its_points():
    instance = instance_of(np.zeros((0, H, W), bool), [])
    assert has_color(draw(instance), (10, 200, 30))


def test_visible_points_are_colored_by_depth():
    pixel = np.array([10 * W + 10, 30 * W + 50], np.int32)
    seen = Visibility("left", np.arange(2, dtype=np.int32), pixel, np.array([1, 2], np.float32), H, W)
    picture = draw(seen)
    assert picture[10, 10, 0] > picture[10, 10, 2] and picture[5, 5].max() == 34
    assert draw(seen, frame=FRAME)[:H].std() > picture[:H].std()


def test_gaussians_are_rendered():
    sh = np.tile(np.float32([[[1.7, -1.7, -1.7]]]), (500, 1, 1))
    quaternions = np.tile(np.float32([1, 0, 0, 0]), (500, 1))
    sizes, opacity = np.full((500, 3), -2.5, np.float32), np.full(500, 4.0, np.float32)
    ids, sure = np.ones(500, np.int32), np.ones(500, np.float32)
    scene = Gaussians(POINTS, quaternions, sizes, opacity, sh, ids, sure, np.zeros(500, np.int32))
    picture = draw(scene, cameras=CAMERAS)
    assert picture.shape == (H, W, 3) and picture.dtype == np.uint8
    np.testing.assert_allclose(picture[24, 32], [250, 5, 5], atol=25)
    assert draw(scene).shape == (720, 960, 3)


def test_cameras_descriptors_metrics_and_answers_have_pictures():
    embedding = np.zeros(len(TERMS), np.float32)
    embedding[TERMS.index("red")] = 1
    described, other = (
        Descriptors(1, vector, ("0",), np.ones(1, np.float32), encoder, vector[None])
        for vector, encoder in ((embedding, "colour words"), (np.ones(4, np.float32) / 2, "clip"))
    )
    assert has_color(draw(described), (255, 0, 0))
    for value in (CAMERAS, other, Metrics({"miou": 0.5}), query((described,), text="red")):
        picture = draw(value, points=CLOUD)
        assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.std() > 5


def test_a_list_becomes_a_sheet_over_the_photos_of_its_views():
    maps = tuple(LabelMap(f"v{i}", np.zeros((H, W), np.uint16)) for i in range(2))
    bare, over = draw(maps), draw(maps, frames=(FRAME, FRAME))
    assert bare.shape == over.shape and over[:200].std() > bare[:200].std()


def test_cameras_of_a_straight_way_go_from_blue_to_red_in_a_drawing_no_wider_than_a_report_shows_it():
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = -1  # straight to the right
    picture = draw(Cameras(("a", "b"), np.full((2, 2), 9, np.int32), np.ones((2, 4)), poses, True)).astype(int)
    assert picture.shape[1] <= 560
    blue, red = (np.argwhere(picture[..., a] - picture[..., b] > 60).mean(axis=0) for a, b in ((2, 0), (0, 2)))
    assert np.abs(blue - red).max() > 100


def test_a_long_list_is_cut_and_an_empty_one_says_so():
    frames = (FRAME,) * 30
    assert draw(frames).shape == draw(frames[:24]).shape
    assert draw(()).shape[1] == 800


@pytest.mark.parametrize(
    "value",
    [
        even_cloud(POINTS[:0], CLOUD.colors[:0], 1.0, 0.0),
        NO_GAUSSIANS,
        Cameras((), np.zeros((0, 2), np.int32), np.zeros((0, 4)), np.zeros((0, 4, 4)), False),
        masks_by_id(np.zeros((H, W), np.int32), "e"),
        Visibility("e", NONE_I, NONE_I, NONE_F, H, W),
        Metrics({}),
        Hierarchy(NONE_I, NONE_I, NONE_F, np.zeros(0, bool)),
        3.5,
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_is_empty_or_unknown_has_a_picture_too(value):
    picture = draw(value)
    assert picture.ndim == 3 and picture.dtype == np.uint8 and picture.size > 0


@pytest.mark.parametrize("size", [3, 20])
def test_a_table_tells_what_is_in_an_array_and_not_its_shape_alone(size):
    ones, more = (draw(np.full(size, value, np.int32)) for value in (1, 7))
    assert ones.shape == more.shape and (ones != more).any()
