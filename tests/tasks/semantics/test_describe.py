import cv2
import numpy as np
import pytest
from view_masks import as_fields

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Frame, InstanceMasks, PartMasks
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.masks.erosion import ErosionParams
from ss_flow.tasks.models.colour_words import TERMS
from ss_flow.tasks.semantics.describe import DescribeParams, crop, describe, describe_part

H, W = 120, 160
GREY, RED, BLUE = (128, 128, 128), (210, 20, 30), (20, 40, 200)


def frame_of(image: np.ndarray, name: str = "view") -> Frame:
    nothing = np.zeros(0, np.uint8)
    return Frame(name, image.shape[1], image.shape[0], encode_png(image), nothing, image.shape[1], image.shape[0])


def square(x: int, y: int, side: int) -> np.ndarray:
    mask = np.zeros((H, W), bool)
    mask[y : y + side, x : x + side] = True
    return mask


def scene(*views: tuple[np.ndarray, tuple[int, int, int]]) -> tuple[tuple[Frame, ...], InstanceMasks]:
    """Grey views in which the mask's pixels have the given colour."""
    frames = []
    for i, (mask, colour) in enumerate(views):
        image = np.full((H, W, 3), GREY, np.uint8)
        image[mask] = colour
        frames.append(frame_of(image, f"view{i}"))
    masks = np.array([mask for mask, _ in views])
    names = tuple(frame.name for frame in frames)
    points = np.zeros((1, 3), np.float32)
    instance = InstanceMasks(
        **as_fields(masks), views=names, instance_id=7, points=points, colors=np.zeros((1, 3), np.uint8),
        point_confidence=np.ones(1, np.float32), point_part=np.zeros(1, np.int32), confidence=1.0,
        origin=np.zeros(len(views), np.uint8), weak=False,
    )  # fmt: skip
    return tuple(frames), instance


def test_a_red_object_on_grey_is_red():
    frames, instance = scene((square(40, 30, 40), RED))
    found = describe(frames, instance)
    assert found.instance_id == 7 and found.encoder == "colour words"
    assert TERMS[found.embedding.argmax()] == "red" and found.embedding.max() > 0.9
    assert found.embedding[TERMS.index("grey")] < 0.05


def test_a_part_is_described_as_an_instance_with_its_masks_is():
    frames, instance = scene((square(40, 30, 40), RED))
    part = PartMasks(instance.sizes, instance.boxes, instance.packed, instance.views, 7, 2)
    found, whole = describe_part(frames, part), describe(frames, instance)
    assert (found.instance_id, found.part_id, found.views) == (7, 2, whole.views)
    assert np.array_equal(found.embedding, whole.embedding)


def test_views_weigh_as_much_as_the_object_covers_in_them():
    frames, instance = scene((square(10, 10, 60), RED), (square(10, 10, 30), BLUE))
    found = describe(frames, instance)
    red, blue = (describe(*scene((square(10, 10, 40), colour))).embedding for colour in (RED, BLUE))
    expected = 3600 * red + 900 * blue
    np.testing.assert_allclose(found.embedding, expected / np.linalg.norm(expected), atol=1e-6)
    assert found.weights.tolist() == [3600, 900] and found.views == ("view0", "view1")


def test_views_may_weigh_the_same():
    frames, instance = scene((square(10, 10, 60), RED), (square(10, 10, 30), BLUE))
    found = describe(frames, instance, params=DescribeParams(weighted=False))
    red, blue = (describe(*scene((square(10, 10, 40), colour))).embedding for colour in (RED, BLUE))
    np.testing.assert_allclose(found.embedding, (red + blue) / np.linalg.norm(red + blue), atol=1e-6)
    assert found.weights.tolist() == [1, 1]


def test_only_the_largest_views_go_in():
    frames, instance = scene(*((square(5, 5, side), RED) for side in (20, 50, 30, 60, 40)))
    found = describe(frames, instance, params=DescribeParams(max_views=3))
    assert found.views == ("view1", "view3", "view4")


def test_views_in_which_the_object_is_tiny_stay_out():
    frames, instance = scene((square(10, 10, 6), BLUE), (square(10, 10, 7), RED))
    found = describe(frames, instance)
    assert 36 < 0.002 * H * W <= 49
    assert found.views == ("view1",)


def test_an_object_that_no_view_shows_well_gets_zeros_and_no_views():
    frames, instance = scene((square(10, 10, 3), RED))
    found = describe(frames, instance)
    assert not found.embedding.any() and len(found.embedding) == len(TERMS) and len(found.views) == 0


def test_the_border_of_a_mask_does_not_count():
    mask = square(40, 30, 40)
    frames, instance = scene((mask, RED))
    loose = np.zeros_like(mask)
    loose[29:71, 39:81] = True
    frames_loose, instance_loose = scene((loose, RED))
    assert describe(frames, instance_loose).embedding[TERMS.index("grey")] < 0.05
    np.testing.assert_allclose(describe(frames_loose, instance).embedding, describe(frames, instance).embedding)


def test_a_view_of_whose_mask_erosion_leaves_nothing_stays_out():
    thin = np.zeros((H, W), bool)
    thin[40:46, 10:150] = True
    unsparing = DescribeParams(erosion=ErosionParams(diagonal=0.0, keep_share=0.0, keep_pixels=0))
    found = describe(*scene((thin, BLUE), (square(10, 10, 40), RED)), params=unsparing)
    assert found.views == ("view1",) and found.weights.tolist() == [1600] and found.vectors.shape == (1, len(TERMS))
    assert TERMS[found.embedding.argmax()] == "red"
    nothing = describe(*scene((thin, BLUE)), params=unsparing)
    assert not nothing.views and not nothing.embedding.any()


def test_a_mask_belongs_to_the_frame_of_its_name():
    frames, instance = scene((square(10, 10, 40), RED))
    frames = (frame_of(np.full((H, W, 3), GREY, np.uint8), "other"), *frames)
    assert TERMS[describe(frames, instance).embedding.argmax()] == "red"


def test_a_frame_of_another_size_is_refused():
    _, instance = scene((square(40, 30, 40), RED))
    small = frame_of(np.zeros((60, 80, 3), np.uint8), "view0")
    with pytest.raises(InputError, match="Frame view0 is 80 x 60"):
        describe((small,), instance)


def test_the_crop_is_the_square_around_the_mask_with_its_margin():
    image = np.zeros((200, 300, 3), np.uint8)
    mask = np.zeros((200, 300), bool)
    mask[80:120, 100:180] = True
    image[mask] = 255
    picture = crop(image, mask, DescribeParams(background="black", crop_side=105))
    lit = picture[..., 0] > 128
    assert picture.shape == (105, 105, 3)
    assert abs(int(lit.any(axis=0).sum()) - 80) <= 1 and abs(int(lit.any(axis=1).sum()) - 40) <= 1
    left = np.flatnonzero(lit.any(axis=0))[0]
    assert 11 <= left <= 13


@pytest.mark.parametrize("background, value", [("black", 0), ("white", 255)])
def test_all_around_the_mask_is_painted_over(background, value):
    image = np.random.default_rng(0).integers(60, 200, (H, W, 3), np.uint8)
    mask = square(60, 40, 30)
    picture = crop(image, mask, DescribeParams(background=background))
    assert (picture[:20] == value).all() and (picture[:, -20:] == value).all()
    assert not (picture[100:120, 100:120] == value).any()


def test_blur_leaves_the_object_sharp_and_its_surroundings_smooth():
    image = np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8)
    side = round((40 + 20) * 1.05)
    picture = crop(image, square(60, 40, 40), DescribeParams(crop_side=side))
    assert picture[20:40, 20:40].std() > 50 and picture[:8].std() < 10


def test_a_crop_beyond_the_border_keeps_the_object_in_its_middle():
    image = np.full((H, W, 3), 255, np.uint8)
    picture = crop(image, square(0, 0, 20), DescribeParams(background="black", crop_side=42))
    lit = np.argwhere(picture[..., 0] > 128)
    np.testing.assert_allclose(lit.mean(axis=0), [20.5, 20.5], atol=1)
    assert 300 < len(lit) < 500


def test_a_photo_that_was_stored_as_jpeg_is_read_as_rgb():
    _, instance = scene((square(40, 30, 40), BLUE))
    image = np.full((H, W, 3), BLUE, np.uint8)
    data = cv2.imencode(".jpg", image[..., ::-1])[1].ravel()
    jpeg = Frame("view0", W, H, data, np.zeros(0, np.uint8), W, H)
    assert TERMS[describe((jpeg,), instance).embedding.argmax()] == "blue"


def test_the_vector_of_each_view_is_kept():
    frames, instance = scene((square(10, 10, 60), RED), (square(10, 10, 30), BLUE))
    found = describe(frames, instance)
    red, blue = (describe(*scene((square(10, 10, side), colour))).vectors for side, colour in ((60, RED), (30, BLUE)))
    np.testing.assert_array_equal(found.vectors, np.concatenate([red, blue]))
    total = (found.weights[:, None] * found.vectors).sum(axis=0)
    np.testing.assert_allclose(found.embedding, total / np.linalg.norm(total), atol=1e-6)
