"""A finished run against ground truth."""

from __future__ import annotations

import json

import numpy as np
import pytest
from tiny_runs import ROOM, run_tiny, ss_flow, write_room

from ss_flow.flows.generated import generate


def test_the_views_are_measured_as_the_run_measured_them(tiny):
    document = ss_flow("eval", tiny.out, "--json").document()
    assert document["protocol"] == "views"
    of_run = json.loads((tiny.out / "run.json").read_text())["metrics"]
    assert document["metrics"] == of_run and set(of_run) == {"split", "refined", "splat"}


def test_true_masks_score_well_on_points_lifted_from_the_views(tiny):
    answer = ss_flow("eval", tiny.out, "--protocol", "points", "--json", "--cache", tiny.store)
    assert answer.code == 0, answer.err
    metrics = answer.document()["metrics"]
    assert set(metrics) == {"split", "splat"}
    assert metrics["split"]["miou"] > 0.8 and metrics["split"]["ap50"] > 0.8
    assert 0 < metrics["split"]["annotated"] < 1
    told = ss_flow("eval", tiny.out, "--protocol", "points", "--cache", tiny.store)
    assert told.code == 0 and "after Splat" in told.out and "ap50" in told.out


def test_a_scans_annotation_in_the_frame_of_the_poses_gives_other_points_to_score_on(tiny, tmp_path):
    room = generate(ROOM)
    folder = tmp_path / "scene0000_00"
    folder.mkdir()
    rows = "".join("{:.6f} {:.6f} {:.6f}\n".format(*point) for point in room.points)
    (folder / "scene0000_00_vh_clean_2.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(room.points)}\nproperty float x\nproperty float y\n"
        f"property float z\nend_header\n{rows}"
    )
    ids = room.point_ids.tolist()
    (folder / "scene0000_00_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"segIndices": ids}))
    things = [{"segments": [int(i)]} for i in np.unique(room.point_ids) if i > 0]
    (folder / "scene0000_00.aggregation.json").write_text(json.dumps({"segGroups": things}))
    answer = ss_flow("eval", tiny.out, "--protocol", "points", "--truth", folder, "--json", "--cache", tiny.store)
    assert answer.code == 0, answer.err
    metrics = answer.document()["metrics"]
    assert metrics["split"]["miou"] > 0.8 and metrics["split"]["num_truth"] == len(things)
    near = ss_flow(
        "eval",
        tiny.out,
        "--protocol",
        "points",
        "--truth",
        folder,
        "--radius",
        "0.0001",
        "--json",
        "--cache",
        tiny.store,
    ).document()["metrics"]
    assert near["split"]["miou"] < metrics["split"]["miou"]
    answer = ss_flow("eval", tiny.out, "--protocol", "points", "--truth", folder, "--compat", "--cache", tiny.store)
    assert answer.code == 2 and "scene0000_00_vh_clean.aggregation.json" in answer.err


def test_a_run_without_ground_truth_says_so(tmp_path):
    scene = write_room(tmp_path / "room")
    for file in (scene / "instance").iterdir():
        file.unlink()
    (scene / "instance").rmdir()
    assert run_tiny(scene, tmp_path / "store", out=tmp_path / "out").code == 0
    for protocol in ("views", "points"):
        answer = ss_flow("eval", tmp_path / "out", "--protocol", protocol, "--cache", tmp_path / "store")
        assert answer.code == 2 and "annotated views" in answer.err and answer.err.count("\n") == 1


@pytest.mark.parametrize("wrong", [("--radius", "1"), ("--compat",), ("--protocol", "points", "--radius", "-1")])
def test_options_that_cannot_be_are_refused(tiny, wrong):
    answer = ss_flow("eval", tiny.out, *wrong)
    assert answer.code == 2 and answer.err.count("\n") == 1
