"""Depth of another focal length than stated is put right where that is clear; else a run warns of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import Called, run_tiny

from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.flows.params import Params
from ss_flow.flows.settings import preset

SCALE = 585 / 526
UNTIL = ["--until", "metrics_split"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> tuple[Path, Path]:
    """A room with its own depth, and with depth that a camera of a shorter focal length took."""
    base = tmp_path_factory.mktemp("calibrate")
    room = generate(RoomParams(objects=4, views=6, width=192, height=144, held_out=1))
    write_scene(room, base / "right", masks="truth")
    v, u = np.mgrid[:144, :192] + 0.5
    rows, columns = np.floor((v - 72) * SCALE + 72).astype(int), np.floor((u - 96) * SCALE + 96).astype(int)
    seen = (rows >= 0) & (rows < 144) & (columns >= 0) & (columns < 192)
    shrunk = np.where(seen, room.depth[:, rows.clip(0, 143), columns.clip(0, 191)], 0).astype(np.float32)
    write_scene(replace(room, depth=shrunk), base / "wrong", masks="truth")
    return base / "right", base / "wrong"


def warnings(called: Called) -> list[str]:
    assert called.code == 0, called.err
    return [text for node in called.document()["nodes"] for text in node["warnings"]]


def miou(called: Called) -> float:
    return called.document()["metrics"]["split"]["miou"]


def test_a_run_warns_of_depth_that_does_not_fit_and_says_what_to_do(scenes, tmp_path):
    asked = "--until", "registration", "--calibrate", "none"
    right, wrong = (run_tiny(scene, tmp_path / "store", *asked) for scene in scenes)
    assert warnings(right) == []
    (told,) = warnings(wrong)
    assert told.startswith("Depth edges fit the photos better when the depth images are scaled by 1.1")
    assert "use --calibrate depth" in told
    again = run_tiny(scenes[1], tmp_path / "store", *asked)
    assert (again.computed(), warnings(again)) == ({}, [told])
    assert told in wrong.err and told in again.err


def test_calibrated_depth_gives_better_instances_and_depth_that_fits_stays_to_the_bit(scenes, tmp_path):
    store = tmp_path / "store"
    right, wrong = (run_tiny(scene, store, *UNTIL, "--calibrate", "none") for scene in scenes)
    same, better = (run_tiny(scene, store, *UNTIL, "--calibrate", "depth") for scene in scenes)
    assert same.results() == right.results()
    assert "stay as they are" in warnings(same)[0]
    assert "were scaled by 1.1" in warnings(better)[0]
    alone = [run_tiny(scene, store, *UNTIL) for scene in scenes]
    assert [called.results() for called in alone] == [same.results(), better.results()]
    assert warnings(alone[0]) == []
    assert "were scaled by 1.1" in warnings(alone[1])[0]
    unclear = run_tiny(scenes[1], store, *UNTIL, "--set", "capture.registration.tau_clear=1")
    assert unclear.results() == wrong.results()
    assert miou(better) > miou(wrong)
    assert miou(better) > miou(right) - 0.1


def test_depth_of_another_scale_than_the_poses_is_brought_to_theirs_unless_it_is_to_stay(scenes, tmp_path):
    room = generate(RoomParams(objects=4, views=16, width=96, height=72, held_out=0))
    write_scene(replace(room, depth=np.float32(1.04) * room.depth), tmp_path / "large", masks="truth")
    store, until = tmp_path / "store", ("--until", "depth")
    called = run_tiny(tmp_path / "large", store, *until)
    assert called.computed()["capture.rescaled"] == 16
    assert any(text.startswith("The depth was multiplied by 0.9") for text in warnings(called))
    assert "so that it fits the poses" in called.err
    kept = run_tiny(tmp_path / "large", store, *until, "--calibrate", "none")
    assert not {"capture.depth_scale", "capture.rescaled"} & kept.computed().keys()
    assert "capture.rescaled" not in run_tiny(scenes[0], store, *until).computed()
    assert run_tiny(tmp_path / "large", store, "--until", "rescaled").computed() == {}


def test_the_flag_is_the_parameter(scenes, tmp_path):
    one = run_tiny(scenes[1], tmp_path / "store", "--until", "depth", "--calibrate", "depth")
    other = run_tiny(scenes[1], tmp_path / "store", "--until", "depth", "--set", "capture.calibrate=depth")
    assert (one.results(), other.computed()) == (other.results(), {})


@pytest.mark.parametrize(
    ("name", "when"),
    [("default", "auto"), ("fast", "auto"), ("thorough", "auto"), ("paper", "none"), ("reference", "none")],
)
def test_the_papers_presets_take_depth_as_it_is(name, when):
    assert preset(Params(), name).capture.calibrate == when
