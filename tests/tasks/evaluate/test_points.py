"""Instances on annotated points: golden values, ScanNet's rules, ground truth lifted from views and read from files."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from clouds import even_cloud
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from labelled_points import labels_of

from ss_flow.errors import InputError
from ss_flow.running import Surroundings, running
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Gaussians, LabelMap, PointCloud, Visibility
from ss_flow.tasks.evaluate.contingency import contingency
from ss_flow.tasks.evaluate.points import (
    TruePoints,
    evaluate_gaussians,
    evaluate_points,
    ig_metrics,
    instance_ious,
    lifted,
    point_metrics,
    transfer_nearest,
)
from ss_flow.tasks.evaluate.scannet import scannet_truth
from ss_flow.tasks.evaluate.scannet_ap import scannet_ap
from ss_flow.tasks.gaussians.initialise import initialise

TRUTH = np.array([0, 0, 0, 0, 1, 1, 2, -1])
PREDICTED = np.array([5, 5, 5, 7, 7, 7, 5, 9])


def _cloud(points: np.ndarray) -> PointCloud:
    return even_cloud(points.astype(np.float32), np.zeros((len(points), 3), np.uint8), 1.0, 0.1)


def test_ig_protocol_gives_the_golden_values_e3() -> None:
    values = ig_metrics(TRUTH, PREDICTED)
    assert values["miou"] == pytest.approx((3 / 5 + 2 / 3 + 1 / 4) / 3)
    assert values["miou"] == pytest.approx(0.50556, abs=1e-5)
    assert values["macc25"] == pytest.approx(2 / 3), "an IoU of exactly 0.25 is no hit"
    assert values["macc50"] == pytest.approx(2 / 3)


def test_the_gap_bug_scores_the_missing_id_and_overlooks_the_highest() -> None:
    truth = np.array([0, 0, 2, 2])
    predicted = np.array([1, 1, 4, 4])
    assert ig_metrics(truth, predicted)["miou"] == 1
    assert ig_metrics(truth, predicted, compat_gap_bug=True)["miou"] == 0.5
    assert ig_metrics(TRUTH, PREDICTED, compat_gap_bug=True) == ig_metrics(TRUTH, PREDICTED), "no gap, no difference"


@given(
    hnp.arrays(np.int64, 30, elements=st.integers(-1, 4)).filter(lambda x: (x >= 0).any()),
    hnp.arrays(np.int64, 30, elements=st.integers(-1, 4)),
    st.permutations(range(6)),
)
def test_renaming_predictions_and_shuffling_points_changes_nothing(
    truth: np.ndarray, predicted: np.ndarray, names: list[int]
) -> None:
    expected = ig_metrics(truth, predicted)
    assert ig_metrics(truth, np.array(names)[predicted + 1]) == pytest.approx(expected)
    order = np.random.default_rng(0).permutation(30)
    assert ig_metrics(truth[order], predicted[order]) == pytest.approx(expected)
    assert 0 <= expected["macc50"] <= expected["macc25"] <= 1
    assert ig_metrics(truth, truth)["miou"] == 1


def test_points_without_annotation_are_refused() -> None:
    with pytest.raises(InputError, match="no annotated point"):
        ig_metrics(np.array([-1, -1]), np.array([0, 1]))


def test_labels_go_to_the_nearest_target_and_no_farther_than_the_radius() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    targets = np.array([[0.4, 0, 0], [0.6, 0, 0], [9, 0, 0]], np.float32)
    labels = np.array([3, 4], np.int32)
    assert transfer_nearest(points, labels, targets).tolist() == [3, 4, 4]
    assert transfer_nearest(points, labels, targets, radius=0.5).tolist() == [3, 4, 0]
    with pytest.raises(InputError, match="no labelled point"):
        transfer_nearest(points[:0], labels[:0], targets)


def test_points_and_gaussians_are_scored_on_the_points_of_the_ground_truth() -> None:
    place = np.arange(8)[:, None] * np.array([1.0, 0, 0])
    shown = _cloud(place + np.array([0.01, 0, 0]))
    truth = TruePoints(place.astype(np.float32), TRUTH.astype(np.int32))
    expected = point_metrics(TRUTH, PREDICTED, {})
    assert expected["miou"] == ig_metrics(TRUTH, PREDICTED)["miou"]
    assert evaluate_points(shown, labels_of(PREDICTED.tolist()), (), truth).values == expected
    n = len(place)
    scene = Gaussians(
        shown.points,
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.zeros((n, 3), np.float32),
        np.full(n, -9, np.float32),
        np.zeros((n, 1, 3), np.float32),
        PREDICTED.astype(np.int32),
        np.ones(n, np.float32),
        np.zeros(n, np.int32),
    )
    assert evaluate_gaussians(scene, (), truth).values == expected


def test_the_annotated_share_and_gaps_of_the_ids_are_told() -> None:
    assert point_metrics(TRUTH, PREDICTED, {})["annotated"] == 7 / 8
    assert point_metrics(TRUTH, PREDICTED, {})["id_gaps"] == 0
    assert point_metrics(np.array([0, 2]), np.array([1, 1]), {})["id_gaps"] == 1


def _ap(truth: list[tuple[int, int, int]], score: dict[int, float], overlap: float) -> float:
    """truth: (true id, predicted id, number of such points)."""
    true, predicted, count = (np.array(column) for column in zip(*truth, strict=True))
    table = contingency(np.repeat(true, count), np.repeat(predicted, count)).without(predicted=0)
    return scannet_ap(table, score, overlap)


def test_average_precision_follows_scannets_rules() -> None:
    both = [(0, 5, 200), (1, 6, 200)]
    assert _ap(both, {5: 1.0, 6: 0.5}, 0.5) == 1.0
    # A wrong one that is surer than one of two right ones: precision 1, 1, 1/2, 2/3 at recall 0, 1/3, 1/3, 2/3.
    wrong = [*both, (-1, 7, 40), (2, 7, 160), (2, 0, 300)]
    assert _ap(wrong, {5: 1.0, 7: 0.8, 6: 0.5}, 0.5) == pytest.approx(1 / 3 + (1 / 2 + 2 / 3) / 2 / 3)
    # All of one score are one point of the curve: precision 1, 2/3 at recall 0, 2/3.
    assert _ap(wrong, {5: 0.7, 6: 0.7, 7: 0.7}, 0.5) == pytest.approx((1 + 2 / 3) / 2 * 2 / 3)
    # What lies for more than the threshold on points without annotation is no false positive.
    assert _ap([*both, (-1, 7, 160), (1, 7, 40)], {5: 1.0, 7: 2.0, 6: 0.5}, 0.5) == 1.0
    # With exactly that share it is one: precision 1, 0, 1/2, 2/3 at recall 0, 0, 1/2, 1.
    half = [*both, (-1, 7, 100), (1, 7, 100)]
    assert _ap(half, {5: 1.0, 7: 2.0, 6: 0.5}, 0.5) == pytest.approx((0 + 1 / 2) / 4 + (1 / 2 + 2 / 3) / 4)
    # Instances and predictions of fewer than 100 points do not count; what lies on such an instance is ignored.
    assert _ap([*both, (2, 8, 99), (0, 9, 30)], {5: 1.0, 6: 0.5, 8: 3.0, 9: 3.0}, 0.5) == 1.0
    assert _ap([*both, (2, 8, 90), (-1, 8, 30)], {5: 1.0, 6: 0.5, 8: 3.0}, 0.5) == 1.0


def test_below_one_half_the_first_prediction_is_taken_and_the_surest_counts() -> None:
    # 5 meets both instances with an IoU of 1/3, 6 the first one with 1/2. The first instance takes 5, and so the second
    # has none: 6 is right and 5 wrong. Precision 1, 1, 1/2 at recall 0, 1/2, 1/2.
    assert _ap([(0, 5, 100), (0, 6, 100), (1, 5, 100), (1, 0, 100)], {5: 0.4, 6: 0.9}, 0.25) == 0.5
    # 6 meets both, but was not taken: right for both, and wrong besides. Precision 1, 1, 2/3 at recall 0, 1/2, 1.
    twice = _ap([(0, 5, 100), (0, 6, 100), (1, 6, 100), (1, 0, 100)], {5: 0.9, 6: 0.4}, 0.25)
    assert twice == pytest.approx(1 / 2 + (1 + 2 / 3) / 2 / 2)


def test_the_surer_predictions_are_those_of_more_confidence() -> None:
    count = [200, 200, 40, 160, 300]
    truth, predicted = np.repeat([0, 1, -1, 2, 2], count), np.repeat([5, 6, 7, 7, 0], count)
    place = np.arange(len(truth))[:, None] * np.float32([1, 0, 0])
    instances = [
        SimpleNamespace(instance_id=i, confidence=confidence) for i, confidence in ((5, 0.9), (7, 0.5), (6, 0.2))
    ]
    found = evaluate_points(
        _cloud(place), labels_of(predicted.tolist()), instances, TruePoints(place, truth.astype(np.int32))
    )
    # As in the second case above: the wrong one comes between two right ones.
    assert found.values["ap50"] == pytest.approx(1 / 3 + (1 / 2 + 2 / 3) / 2 / 3)
    assert found.values["ap"] == pytest.approx(found.values["ap50"]), "the mean over all thresholds, from 0.5 on"
    assert found.values["ap25"] == 1.0
    assert found.values["num_truth"] == 3 and found.values["pq"] == pytest.approx(2 / 3)


def test_without_predictions_or_instances_that_count_the_average_precision_is_zero() -> None:
    assert _ap([(0, 0, 200), (0, 5, 99)], {5: 1.0}, 0.5) == 0
    assert _ap([(-1, 5, 200), (0, 6, 50)], {5: 1.0}, 0.5) == 0


def test_points_take_the_id_that_most_of_the_views_give_them() -> None:
    def seen(name: str, rows: list[int], pixels: list[int]) -> Visibility:
        return Visibility(name, np.int32(rows), np.int32(pixels), np.ones(len(rows), np.float32), 1, 4)

    views = [seen("a", [0, 1, 2], [0, 1, 3]), seen("b", [0, 1, 2], [0, 1, 2]), seen("c", [1], [0]), seen("d", [3], [0])]
    truth = [
        LabelMap(name, np.uint16([ids]))
        for name, ids in (("a", [5, 6, 0, 0]), ("b", [5, 7, 0, 0]), ("c", [7, 0, 0, 0]))
    ]
    # Point 1: 6, 7, 7. Point 2: seen where nothing is annotated. Point 3: seen by a view without ground truth.
    assert lifted(_cloud(np.zeros((4, 3))), views, truth).instance.tolist() == [5, 7, -1, -1]


def test_ids_of_views_begin_at_one_and_have_no_gap_for_it() -> None:
    seen = Visibility("a", np.int32([0, 1]), np.int32([0, 1]), np.ones(2, np.float32), 1, 3)
    cloud = _cloud(np.arange(6).reshape(2, 3))
    for ids, gaps in (([1, 2, 0], 0), ([1, 3, 0], 1), ([2, 3, 0], 1)):
        truth = lifted(cloud, [seen], [LabelMap("a", np.uint16([ids]))])
        assert evaluate_points(cloud, labels_of([1, 2]), (), truth).values["id_gaps"] == gaps


def _scan(folder: Path, groups: list[list[int]], finer: list[list[int]] | None = None) -> dict[str, FileRef]:
    """Six vertices of segments 0, 0, 1, 1, 2, 3 in files as ScanNet has them."""
    rows = "".join(f"{i} {2 * i} 0 1 2 3 255\n" for i in range(6))
    (folder / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}3 0 1 2\n"
    )
    (folder / "segs.json").write_text(json.dumps({"segIndices": [0, 0, 1, 1, 2, 3]}))
    files = {"mesh": "mesh.ply", "segments": "segs.json", "aggregation": "own.json"}
    for name, held in (("own.json", groups), ("finer.json", finer)):
        if held is not None:
            (folder / name).write_text(json.dumps({"segGroups": [{"id": 9, "segments": s} for s in held]}))
    if finer is not None:
        files["other"] = "finer.json"
    return {name: FileRef(folder / file, file) for name, file in files.items()}


def test_a_scans_annotation_is_read_by_groups_and_the_later_one_wins(tmp_path: Path) -> None:
    truth = scannet_truth(**{"other": None, **_scan(tmp_path, [[0, 1], [1, 2]])})
    assert truth.points.tolist() == [[i, 2 * i, 0] for i in range(6)]
    assert truth.instance.tolist() == [0, 0, 1, 1, 1, -1]


def test_annotations_that_disagree_are_told(tmp_path: Path) -> None:
    heard: list[str] = []
    with running(Surroundings(warned=heard)):
        scannet_truth(**_scan(tmp_path, [[0, 1], [2]], finer=[[0], [2]]))
    assert len(heard) == 1 and "33.3%" in heard[0]


def test_damaged_annotations_are_named(tmp_path: Path) -> None:
    files = {"other": None, **_scan(tmp_path, [[0]])}
    files["segments"].path.write_text('{"segIndices": [0, 1]}')
    with pytest.raises(InputError, match=r"2 segment indices .* 6 vertices"):
        scannet_truth(**files)
    files["aggregation"].path.write_text("{")
    files["segments"].path.write_text('{"segIndices": [0, 0, 1, 1, 2, 3]}')
    with pytest.raises(InputError, match="segGroups is expected"):
        scannet_truth(**files)
    files["mesh"].path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    with pytest.raises(InputError, match=r"mesh\.ply holds no vertices"):
        scannet_truth(**files)


def test_each_true_instance_has_the_label_that_covers_it_best() -> None:
    place = np.arange(20)[:, None] * np.float32([1, 0, 0])
    # 5 has most of the chair and all of the table besides, 6 the rest of the chair.
    truth, predicted = np.repeat([0, 1, 3, -1], [4, 12, 2, 2]), np.repeat([5, 6, 5, 0], [3, 1, 12, 4])
    scene = initialise(place, np.zeros((20, 3), np.uint8), predicted.astype(np.int32), 1.0)
    found = instance_ious(scene, TruePoints(place, truth.astype(np.int32), ("chair", "table")))
    assert found.instance.tolist() == [0, 1, 3] and found.names == ("chair", "table", "")
    assert found.best.tolist() == [6, 5, 0] and found.iou.tolist() == pytest.approx([1 / 4, 12 / 15, 1])
    with pytest.raises(InputError, match="no annotated point"):
        instance_ious(scene, TruePoints(place, np.full(20, -1, np.int32)))
