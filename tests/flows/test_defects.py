"""Captures with a seeded defect, on disk as a user's would lie there: the report names each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_runs import run_tiny

from ss_flow.flows.generated import Room, RoomParams, generate, write_scene

_VIEWS = 10


@pytest.fixture(scope="module")
def room() -> Room:
    return generate(RoomParams(objects=2, views=_VIEWS, width=80, height=60, held_out=0))


def _posed(room: Room, world_to_camera: np.ndarray) -> Room:
    return replace(room, cameras=replace(room.cameras, world_to_camera=world_to_camera))


def _jittered(room: Room) -> Room:
    rng, poses = np.random.default_rng(0), room.cameras.world_to_camera.copy()
    for pose in poses:
        shaken = np.eye(4)
        shaken[:3, :3], shaken[:3, 3] = cv2.Rodrigues(rng.normal(0, np.radians(2), 3))[0], rng.normal(0, 0.06, 3)
        pose[:] = shaken @ pose
    return _posed(room, poses)


def _repeated(room: Room) -> Room:
    source = np.array([0, 1, 2, 2, 4, 5, 6, 6, 8, 9])
    again = replace(room, rgb=room.rgb[source], depth=room.depth[source], ids=room.ids[source])
    return _posed(again, room.cameras.world_to_camera[source])


def _exchanged(room: Room) -> Room:
    return replace(room, cameras=replace(room.cameras, intrinsics=room.cameras.intrinsics[:, [1, 0, 3, 2]]))


def _turned(room: Room) -> Room:
    rgb = room.rgb.copy()
    rgb[4] = rgb[4, ::-1, ::-1]
    return replace(room, rgb=rgb)


def _rolling(room: Room) -> Room:
    factor = 0.7 * (1 + 0.3 * np.sin(np.arange(_VIEWS) / _VIEWS * 2 * np.pi))
    return replace(room, rgb=(room.rgb * factor[:, None, None, None]).clip(0, 255).astype(np.uint8))


_DISAGREE = "poses, intrinsics and depth disagree"
_SCALE = "Depth fits the poses 0.2 times as large"
_REPEATED = "Photos that repeat an earlier one: 2 of 10, 0003, 0007."
_EXCHANGED = "(30, 40) of 80 x 60 pixels; are its intrinsics exchanged, or those of a photo of another size?"
_STRANGE = "Photos that differ from what their neighbours show: 1 of 10"
_EXPOSURE = "exposure changes by a factor of 1."
SENTENCES = {_DISAGREE, _SCALE, _REPEATED, _EXCHANGED, _STRANGE, _EXPOSURE}
DEFECTS: dict[str, tuple[Callable[[Room], Room], set[str]]] = {
    "none": (lambda room: room, set()),
    "poses jitter": (_jittered, {_DISAGREE}),
    "depth five times too large": (lambda room: replace(room, depth=5 * room.depth), {_SCALE}),
    "duplicates": (_repeated, {_REPEATED}),
    "intrinsics exchanged": (_exchanged, {_EXCHANGED, _DISAGREE}),
    "a turned photo": (_turned, {_STRANGE}),
    "rolling exposure": (_rolling, {_EXPOSURE}),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_seeded_defect_and_no_other_is_named_by_the_report(room: Room, tmp_path: Path, defect: str) -> None:
    seed, sentences = DEFECTS[defect]
    write_scene(seed(room), tmp_path / "room", masks="truth")
    called = run_tiny(tmp_path / "room", tmp_path / "store", out=tmp_path / "out")
    assert called.code == 0, called.err
    report = (tmp_path / "out" / "report.html").read_text()
    assert {sentence for sentence in SENTENCES if sentence in report} == sentences
