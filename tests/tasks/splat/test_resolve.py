from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_and_box import VIEWS, SmallScene
from view_masks import as_fields

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import REFINED, Cameras, Frame, InstanceMasks, LabelMap
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.splat.resolve import ResolveParams, exclusive, resolve, resolve_refined

CAMERAS = Cameras(
    ("a", "b"), np.array([[4, 3], [4, 3]], np.int32), np.ones((2, 4)), np.tile(np.eye(4), (2, 1, 1)), metric=True
)


def masks_of(instance_id: int, masks: dict[int, list[str]]) -> InstanceMasks:
    dense = np.array([[[c == "x" for c in row] for row in rows] for rows in masks.values()], bool)
    return InstanceMasks(
        **as_fields(dense), views=tuple("ab"[view] for view in masks), instance_id=instance_id,
        points=np.zeros((0, 3), np.float32), colors=np.zeros((0, 3), np.uint8),
        point_confidence=np.zeros(0, np.float32), point_part=np.zeros(0, np.int32), confidence=1.0,
        origin=np.zeros(len(masks), np.uint8), weak=False,
    )  # fmt: skip


LARGE = masks_of(1, {0: ["xxx.", "xxx.", "...."], 1: ["xx..", "....", "...."]})
SMALL = masks_of(2, {0: ["..xx", "....", "...."]})


def test_where_masks_overlap_the_smaller_is_on_top():
    maps = resolve(CAMERAS, (SMALL, LARGE))
    assert maps[0].ids.tolist() == [[1, 1, 2, 2], [1, 1, 1, 0], [0, 0, 0, 0]]
    assert maps[1].ids.tolist() == [[1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    assert [m.name for m in maps] == ["a", "b"]


def test_the_order_of_instances_and_the_background_do_not_matter():
    same = masks_of(7, {1: [".xx.", "....", "...."]})
    everything = masks_of(0, {0: ["xxxx"] * 3})
    first = resolve(CAMERAS, (LARGE, SMALL, same, everything))
    second = resolve(CAMERAS, (everything, same, SMALL, LARGE))
    assert all((a.ids == b.ids).all() for a, b in zip(first, second, strict=True))
    assert first[1].ids[0].tolist() == [1, 1, 7, 0]


def test_masks_of_another_size_are_refused_by_name():
    other = Cameras(("a",), np.array([[5, 3]], np.int32), np.ones((1, 4)), np.eye(4)[None], metric=True)
    with pytest.raises(InputError, match="Frame a is 5 x 3 pixels and the mask of instance 2 has 4 x 3"):
        resolve(other, (SMALL,))


def test_exclusive_masks_are_cut_marked_and_dropped_where_nothing_is_left():
    maps = resolve(CAMERAS, (SMALL, LARGE))
    cut = exclusive(LARGE, maps)
    assert cut.views == ("a", "b") and cut.origin.tolist() == [REFINED, 0]
    assert cut.dense()[0].sum() == 5
    covered = (LabelMap("a", np.full((3, 4), 2, np.uint16)), maps[1])
    assert exclusive(LARGE, covered).views == ("b",)


def test_the_background_gets_all_that_no_instance_has():
    before = masks_of(0, {0: ["...x", "...x", "xxxx"], 1: ["..xx", "xxxx", "xxxx"]})
    after = exclusive(before, resolve(CAMERAS, (SMALL, LARGE)))
    assert after.dense()[0].astype(int).tolist() == [[0, 0, 0, 0], [0, 0, 0, 1], [1, 1, 1, 1]]
    assert after.origin.tolist() == [REFINED, 0]


def settled(small: SmallScene, *instances: InstanceMasks, contested: str = "points", frames=None) -> np.ndarray:
    """[VIEWS, H, W] ids after refinement."""
    views = replace(small.views, frames=frames or small.frames)
    maps = resolve_refined(views, instances, params=ResolveParams(contested))
    return np.stack([m.ids for m in maps])


def grown_over(instance: InstanceMasks, other: InstanceMasks) -> InstanceMasks:
    """What refinement may make of an instance: its masks with those of another one."""
    masks = np.array(instance.dense()) | np.array(other.dense())
    return replace(instance, **as_fields(masks), origin=np.full(VIEWS, REFINED, np.uint8))


def test_a_contested_pixel_goes_to_the_instance_whose_points_are_near_whatever_the_sizes(small):
    box, ball, background = grown_over(small.instance(1), small.instance(1)), small.instance(2), small.instance(0)
    truth = np.stack(small.ids)
    # The box is the larger one, so its side would go to a ball that has grown over a part of it.
    part = replace(box, **as_fields(np.array(box.dense()) & (np.arange(truth.shape[2]) % 48 < 24)))
    grown = grown_over(ball, part)
    assert grown.areas().sum() < box.areas().sum() and (np.array(grown.dense()) & np.array(box.dense())).any()
    rest = (background, box)
    assert (settled(small, *rest, grown) == truth).mean() > 0.99
    assert (settled(small, grown, *rest[::-1]) == settled(small, *rest, grown)).all()
    wrong = settled(small, *rest, grown, contested="smaller")
    assert (wrong[truth == 1] == 2).mean() > 0.2
    assert all((a.ids == b).all() for a, b in zip(resolve(small.cameras, (*rest, grown)), wrong, strict=True))


def test_without_points_a_kept_mask_is_above_a_refined_one_and_of_two_refined_the_smaller(small):
    box, ball = (replace(small.instance(i), points=np.zeros((0, 3), np.float32)) for i in (1, 2))
    truth = np.stack(small.ids)
    for kept, other in ((box, ball), (ball, box)):
        ids = settled(small, kept, grown_over(other, kept))
        assert (ids == truth).all()
    both = settled(small, grown_over(box, ball), replace(ball, origin=np.full(VIEWS, REFINED, np.uint8)))
    assert (both == truth).all()


def test_a_point_decides_about_the_pixels_near_it_alone(small):
    """The ball has no points, and the box, which has, has grown over it."""
    box, ball = small.instance(1), replace(small.instance(2), points=np.zeros((0, 3), np.float32))
    truth = np.stack(small.ids)
    ids = settled(small, grown_over(box, ball), ball)
    assert (ids[truth == 1] == 1).all() and (ids[truth == 2] == 2).mean() > 0.9


def test_masks_that_do_not_overlap_stay_as_they_are(small):
    instances = [small.instance(i) for i in range(3)]
    assert (settled(small, *instances) == np.stack(small.ids)).all()


@pytest.mark.parametrize("contested", ["points", "smaller"])
def test_what_is_not_valid_belongs_to_nobody(small, contested):
    valid = np.full(small.ids[0].shape, 255, np.uint8)
    valid[30:] = 0
    frames: tuple[Frame, ...] = tuple(replace(f, valid=encode_png(valid)) for f in small.frames)
    ids = settled(small, small.instance(1), small.instance(2), frames=frames, contested=contested)
    truth = np.stack(small.ids)
    truth[:, 30:] = 0
    assert truth.any() and (ids == truth).all()
