"""Photos of one scene may differ in size and shape: a phone is held upright for some and across for others."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from mixed_room import write_mixed_room
from tiny_runs import Called, run_tiny, ss_flow

SIZES = [(96, 72), (48, 72), (72, 54), (48, 72), (96, 72)]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sizes")


@pytest.fixture(scope="module")
def run(base: Path) -> Called:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SS_FLOW_MODELS", "")
        return run_tiny(write_mixed_room(base / "room"), base / "store", out=base / "out")


def test_masks_have_the_sizes_of_the_photos_and_fit_the_truth(base, run):
    assert run.code == 0, run.err
    for stage in ("masks_split", "masks"):
        files = sorted((base / "out" / stage).iterdir())
        assert [cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape[::-1] for file in files] == SIZES
    metrics = json.loads((base / "out/run.json").read_text())["metrics"]
    assert metrics["split"]["miou"] > 0.95 and metrics["splat"]["miou"] > 0.7


def test_every_instance_is_one_over_views_of_all_sizes(base, run):
    things = [i for i in json.loads((base / "out/instances.json").read_text())["instances"] if i["kind"] == "thing"]
    assert any(len(thing["views"]) == len(SIZES) for thing in things)


@pytest.mark.parametrize(
    "arguments",
    [
        ("export", "--format", "coco"),
        ("export", "--format", "colmap"),
        ("export", "--format", "nerfstudio"),
        ("export", "--format", "mesh-glb"),
        ("render", "--path", "input", "--frames", "6"),
        ("query", "red"),
    ],
    ids=" ".join,
)
def test_what_comes_after_a_run_takes_such_photos(arguments, base, run, tmp_path):
    command, *more = arguments
    where = () if command == "query" else ("--out", tmp_path / ("r.mp4" if command == "render" else "e"))
    called = ss_flow(command, base / "out", *more, *where, "--cache", base / "store")
    assert called.code == 0, called.err
