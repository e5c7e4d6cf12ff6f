"""A finished run against ground truth."""

from __future__ import annotations

import json
from importlib.util import find_spec

import cv2
import numpy as np
import pytest
from random_networks import vgg_like
from tiny_runs import ROOM, run_tiny, ss_flow, write_room

from ss_flow.flows.generated import RoomParams, generate
from ss_flow.flows.generated.annotations import write_labels


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


@pytest.fixture(scope="module")
def labels(tmp_path_factory):
    """Labels of three views of the tiny room, in LERF-OVS's format; one category names no colour."""
    folder = tmp_path_factory.mktemp("labels")
    write_labels(generate(ROOM), folder, (0, 2, 4))
    file = folder / "label" / "0002.json"
    document = json.loads(file.read_text())
    document["objects"].append({"category": "sheep", "segmentation": [[1, 1], [20, 1], [20, 20]]})
    file.write_text(json.dumps(document))
    return folder / "label"


@pytest.mark.parametrize("protocol", ["lerf-strict", "lerf-oracle", "lerf-2d"])
def test_texts_are_looked_for_on_labelled_frames(tiny, labels, protocol):
    options = ("eval", tiny.out, "--protocol", protocol, "--truth", labels, "--json", "--cache", tiny.store)
    answer = ss_flow(*options)
    assert answer.code == 0, answer.err
    document = answer.document()
    assert set(document["metrics"]) == ({"split", "splat"} if protocol == "lerf-oracle" else {"splat"})
    found = document["metrics"]["splat"]
    assert found["num_frames"] == 3 and 0 < found["macc50"] <= found["macc25"] < 1, "nothing is found of the sheep"
    assert len(document["warnings"]) == 1 and "sheep" in document["warnings"][0]
    asked = {name: document.get(name) for name in ("encoder", "prompt", "tau_corr")}
    of_query = (None, None) if protocol == "lerf-2d" else ("{text}", 0.02)
    assert tuple(asked.values()) == ("colour words (no network)", *of_query)
    first = ss_flow(*(option for option in options if option != "--json")).out.splitlines()[0]
    assert first == ", ".join(f"{name}: {value}" for name, value in asked.items() if value is not None)


def test_a_category_can_be_asked_for_in_other_words(tiny, labels, tmp_path):
    texts = tmp_path / "texts.json"
    texts.write_text('{"sheep": "the white sheep"}')
    options = ("eval", tiny.out, "--protocol", "lerf-strict", "--truth", labels, "--json", "--cache", tiny.store)
    assert ss_flow(*options, "--texts", texts).document()["warnings"] == []
    texts.write_text('["sheep"]')
    answer = ss_flow(*options, "--texts", texts)
    assert answer.code == 2 and "holds no texts" in answer.err


def test_labels_that_are_not_there_are_asked_for(tiny):
    answer = ss_flow("eval", tiny.out, "--protocol", "lerf-strict", "--cache", tiny.store)
    assert answer.code == 2 and "--truth" in answer.err and answer.err.count("\n") == 1


def test_objects_are_compared_one_by_one(tiny):
    document = ss_flow("eval", tiny.out, "--protocol", "objects", "--json", "--cache", tiny.store).document()
    (views,) = document["metrics"]
    assert views == "training views", "the tiny room keeps none back"
    found = document["metrics"][views]
    rows = document["objects"]["true objects"]
    assert len(rows) == found_truth(tiny) and all(row["psnr"] > 5 and 0 < row["views"] <= 5 for row in rows)
    assert found["object_psnr"] == pytest.approx(np.mean([row["psnr"] for row in rows]))
    taken = document["objects"]["instances taken out"]
    assert taken and all(0 <= row["residual"] < 0.2 for row in taken)
    assert found["worst_residual"] == max(row["residual"] for row in taken)
    assert 5 < found["band_psnr"] < 100 and 0 < found["band_ssim"] < 1


def test_where_no_border_is_seen_no_figure_of_borders_is_told(tmp_path):
    room = write_room(tmp_path / "room", params=RoomParams(objects=1, views=4, width=64, height=48, held_out=0))
    for file in (room / "instance").iterdir():
        cv2.imwrite(str(file), np.ones((48, 64), np.uint16))
    out = tmp_path / "out"
    assert run_tiny(room, tmp_path / "store", out=out).code == 0
    answer = ss_flow("eval", out, "--protocol", "objects", "--json", "--cache", tmp_path / "store")
    assert answer.code == 0 and "NaN" not in answer.out, "JSON has no NaN"
    found = answer.document()["metrics"]["training views"]
    assert "object_psnr" in found and not any(name.startswith("band") for name in found)


@pytest.fixture
def lpips_here(tmp_path, monkeypatch):
    """LPIPS of a random VGG-16, with the published weights of its channels."""
    import torch

    if find_spec("torchmetrics") is None:
        pytest.skip("needs torchmetrics, in which the weights of the channels lie")
    folder = tmp_path / "models/lpips-vgg"
    folder.mkdir(parents=True)
    torch.save(vgg_like(), folder / "pytorch_model.bin")
    monkeypatch.setenv("SS_FLOW_MODELS", str(folder.parent))


def test_without_a_network_for_lpips_it_is_said_to_be_missing(tiny):
    document = ss_flow("eval", tiny.out, "--protocol", "objects", "--json", "--cache", tiny.store).document()
    assert not any("lpips" in name for name in document["metrics"]["training views"])
    assert document["warnings"] == [
        "LPIPS was not measured: no network for it is here; `ss-flow doctor` tells how to get one."
    ]


def test_lpips_of_objects_is_told_where_its_network_is(tiny, lpips_here):
    answer = ss_flow("eval", tiny.out, "--protocol", "objects", "--json", "--cache", tiny.store)
    document = answer.document()
    found, rows = document["metrics"]["training views"], document["objects"]["true objects"]
    assert document["warnings"] == [] and found["lpips"] > 0
    assert found["object_lpips"] == pytest.approx(np.mean([row["lpips"] for row in rows])) and found["band_lpips"] > 0
    assert "object_lpips" in ss_flow("eval", tiny.out, "--protocol", "objects", "--cache", tiny.store).out


def test_lpips_of_views_kept_back_stands_wherever_their_psnr_does(tmp_path, lpips_here):
    room = write_room(tmp_path / "room", params=RoomParams(objects=1, views=4, width=64, height=48, held_out=2))
    called = run_tiny(room, tmp_path / "store", "--set", "evaluate.lpips=none", out=tmp_path / "without")
    assert called.code == 0 and "lpips" not in called.document()["metrics"]["novel_view"]
    called = run_tiny(room, tmp_path / "store", out=tmp_path / "out")
    assert called.code == 0, called.err
    assert set(called.computed()) == {"evaluate.novel_view"}
    measured = called.document()["metrics"]["novel_view"]
    assert measured["lpips"] > 0 and measured["lpips_unscaled"] > 0
    assert called.document()["models"]["perception"] == "lpips-vgg"
    assert f"{measured['lpips']:.3f}" in (tmp_path / "out/report.html").read_text()
    both = ss_flow("diff", tmp_path / "without", tmp_path / "out", "--json").document()["metrics"]
    assert both["novel_view.lpips"] == [None, measured["lpips"]]


def found_truth(tiny) -> int:
    return json.loads((tiny.out / "run.json").read_text())["metrics"]["split"]["num_truth"]


WRONG = [
    ("--radius", "1"),
    ("--compat",),
    ("--protocol", "points", "--radius", "-1"),
    ("--protocol", "points", "--radius", "nan"),
    ("--protocol", "points", "--radius", "inf"),
    ("--protocol", "objects", "--truth", "."),
    ("--protocol", "points", "--texts", "x.json"),
    ("--protocol", "lerf-2d", "--compat"),
    ("--protocol", "points", "--compat"),
]


@pytest.mark.parametrize("wrong", WRONG)
def test_options_that_cannot_be_are_refused(tiny, wrong):
    answer = ss_flow("eval", tiny.out, *wrong)
    assert answer.code == 2 and answer.err.count("\n") == 1
