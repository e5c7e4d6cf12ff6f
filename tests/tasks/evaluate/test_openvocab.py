"""LERF-style labels: golden counting, both protocols, best IoU per object."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.evaluate.openvocab import (
    labelled_frame,
    oracle_ious,
    oracle_scores,
    oracle_targets,
    strict_ious,
    strict_scores,
    strict_targets,
)
from ss_flow.tasks.masks.overlap import iou

SHELF = Path(__file__).parents[3] / ".." / "shared" / "data" / "apc_shelf"


def _square(x: int, y: int, side: int = 3) -> list[list[int]]:
    """The polygon whose filling is `side` + 1 pixels wide."""
    return [[x, y], [x + side, y], [x + side, y + side], [x, y + side]]


def _document(*objects: tuple[str, list[list[int]]]) -> dict[str, Any]:
    return {
        "info": {"name": "frame_00001.jpg", "width": 40, "height": 20},
        "objects": [{"category": category, "segmentation": polygon} for category, polygon in objects],
    }


KITCHEN = labelled_frame(
    _document(
        ("knife", _square(0, 0)),
        ("desk", _square(10, 10)),
        ("knife", _square(20, 0)),
        ("toaster", _square(30, 10)),
        ("knife", _square(30, 0)),
    ),
    "frame_00001.json",
)


def _ids(*squares: tuple[int, int, int]) -> np.ndarray:
    ids = np.zeros((20, 40), np.uint16)
    for instance, x, y in squares:
        ids[y : y + 4, x : x + 4] = instance
    return ids


def test_three_knives_a_desk_and_a_toaster_are_three_queries_and_five_targets_e4() -> None:
    strict, oracle = strict_targets(KITCHEN), oracle_targets(KITCHEN)
    assert list(strict) == ["knife", "desk", "toaster"] and len(oracle) == 5
    assert [int(strict[c].sum()) for c in strict] == [48, 16, 16]
    np.testing.assert_array_equal(strict["knife"], oracle[0][1] | oracle[2][1] | oracle[4][1])


def test_overlapping_polygons_of_a_category_count_once() -> None:
    frame = labelled_frame(_document(("mug", _square(0, 0)), ("mug", _square(2, 0))), "x.json")
    assert strict_targets(frame)["mug"].sum() == 24


def test_strict_scores_count_every_pair_once_and_a_missing_prediction_as_zero() -> None:
    knife = _ids((1, 0, 0), (1, 20, 0)) > 0
    ious = strict_ious(KITCHEN, {"knife": knife, "desk": strict_targets(KITCHEN)["desk"]})
    assert ious == pytest.approx({"knife": 2 / 3, "desk": 1, "toaster": 0})
    scores = strict_scores([ious, {"mug": 0.25}])
    assert scores["miou"] == pytest.approx((2 / 3 + 1 + 0 + 0.25) / 4)
    assert scores["macc25"] == 0.5, "an IoU of exactly 0.25 is no hit"


def test_the_oracle_picks_by_ground_truth_and_uses_an_instance_once() -> None:
    ids = _ids((1, 0, 0), (2, 20, 0), (3, 10, 10))
    anything = frozenset({1, 2, 3, 9})
    ious = oracle_ious(KITCHEN, ids, dict.fromkeys(("knife", "desk"), anything))
    # First knife takes 1, desk takes 3, second knife 2, no candidate for the toaster, none left for the third knife.
    assert ious == [1, 1, 1, 0, 0]
    greedy = oracle_ious(KITCHEN, _ids((1, 20, 0)), {"knife": frozenset({1})})
    assert greedy == [0, 0, 0, 0, 0], "the first knife takes the only candidate although it does not touch it"


def test_oracle_scores_are_means_of_frame_means() -> None:
    scores = oracle_scores([[1.0, 0.0], [0.25], []])
    assert scores == pytest.approx({"miou": (0.5 + 0.25) / 2, "macc25": (0.5 + 1) / 2, "macc50": (0.5 + 0) / 2})
    assert oracle_scores([[0.25, 0.5, 0.49, 0.24]])["macc25"] == 0.75, "an IoU of exactly 0.25 is a hit"
    assert oracle_scores([[0.25, 0.5, 0.49, 0.24]])["macc50"] == 0.25, "and one of exactly 0.5"


@pytest.mark.parametrize(
    "document",
    [
        {},
        {"info": {"name": "a", "width": 4, "height": 4}},
        {"info": {"name": "a", "width": "wide", "height": 4}, "objects": []},
        _document(("mug", [[0, 0], [1, 1]])),
        _document(("mug", [])),
        _document(("mug", [[0, 0, 1], [3, 0, 1], [3, 3, 1]])),
        {**_document(), "objects": [{"category": "mug"}]},
    ],
)
def test_a_label_file_that_is_none_is_refused_by_name(document: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"broken\.json"):
        labelled_frame(document, "broken.json")


def test_no_labels_cannot_be_scored() -> None:
    for scores in (strict_scores, oracle_scores):
        with pytest.raises(InputError, match="no polygon"):
            scores([])
    assert iou(np.zeros((2, 2), bool), np.zeros((2, 2), bool)) == 0


@pytest.mark.skipif(not SHELF.is_dir(), reason="the capture apc_shelf is not beside the project")
def test_polygons_of_a_real_capture_fill_to_its_instance_masks() -> None:
    import cv2

    names = {name: int(i) for i, name in json.loads((SHELF / "instances.json").read_text()).items()}
    for view in ("0", "7"):
        frame = labelled_frame(json.loads((SHELF / "label" / f"{view}.json").read_text()), view)
        ids = cv2.imread(str(SHELF / "instance" / f"{view}.png"), cv2.IMREAD_UNCHANGED)
        for category, mask in strict_targets(frame).items():
            assert iou(mask, ids == names[category]) > 0.9
