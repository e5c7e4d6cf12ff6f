from __future__ import annotations

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import REFINED, Cameras, InstanceMasks, LabelMap
from ss_flow.tasks.geometry.images import pack_masks
from ss_flow.tasks.splat.resolve import exclusive, resolve

CAMERAS = Cameras(
    ("a", "b"), np.array([[4, 3], [4, 3]], np.int32), np.ones((2, 4)), np.tile(np.eye(4), (2, 1, 1)), metric=True
)


def masks_of(instance_id: int, masks: dict[int, list[str]]) -> InstanceMasks:
    dense = np.array([[[c == "x" for c in row] for row in rows] for rows in masks.values()], bool)
    return InstanceMasks(
        instance_id, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32),
        np.zeros(0, np.int32), 1.0, 3, 4, np.array(list(masks), np.int32),
        pack_masks(dense), np.zeros(len(masks), np.uint8), False,
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
    with pytest.raises(InputError, match="Frame a is 5 x 3 pixels and the masks of instance 2 are 4 x 3"):
        resolve(other, (SMALL,))


def test_exclusive_masks_are_cut_marked_and_dropped_where_nothing_is_left():
    maps = resolve(CAMERAS, (SMALL, LARGE))
    cut = exclusive(LARGE, maps)
    assert cut.view.tolist() == [0, 1] and cut.prompted.tolist() == [REFINED, 0]
    assert cut.dense()[0].sum() == 5
    covered = (LabelMap("a", np.full((3, 4), 2, np.uint16)), maps[1])
    assert exclusive(LARGE, covered).view.tolist() == [1]


def test_the_background_gets_all_that_no_instance_has():
    before = masks_of(0, {0: ["...x", "...x", "xxxx"], 1: ["..xx", "xxxx", "xxxx"]})
    after = exclusive(before, resolve(CAMERAS, (SMALL, LARGE)))
    assert after.dense()[0].astype(int).tolist() == [[0, 0, 0, 0], [0, 0, 0, 1], [1, 1, 1, 1]]
    assert after.prompted.tolist() == [REFINED, 0]
