"""A capture with poses that are not exact: --refine-poses brings them back, before anything else, and says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_runs import run_tiny

from ss_flow.cache.store import Store
from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.flows.params import Params
from ss_flow.flows.settings import preset


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> tuple[Path, Path]:
    """A room with its true poses, and with poses that are off by two centimetres and a degree."""
    from scipy.spatial.transform import Rotation

    base = tmp_path_factory.mktemp("refine")
    room = generate(RoomParams(objects=10, views=12, width=320, height=240, held_out=0))
    rng = np.random.default_rng(0)
    for name in ("true", "jittered"):
        write_scene(room, base / name, masks="truth")
    for file in sorted((base / "jittered" / "pose").glob("*.txt")):
        pose = np.loadtxt(file)
        pose[:3, 3] += rng.normal(0, 0.02 / np.sqrt(3), 3)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(rng.normal(0, 1 / np.sqrt(3), 3))).as_matrix()
        np.savetxt(file, pose, fmt="%.10f")
    return base / "true", base / "jittered"


def poses(called, store):
    assert called.code == 0, called.err
    return Store(store).get(called.results()["cameras"]).world_to_camera


def turned(poses, true):
    """Median error of the views' directions relative to each other, in degrees."""
    angles = []
    for a in range(len(true)):
        for b in range(a):
            one, other = (p[a, :3, :3] @ p[b, :3, :3].T for p in (poses, true))
            angles.append(np.degrees(np.arccos(np.clip((np.trace(one @ other.T) - 1) / 2, -1, 1))))
    return np.median(angles)


def test_jittered_poses_of_a_room_come_back_and_the_run_says_how_far_they_moved(scenes, tmp_path):
    store = tmp_path / "store"
    until = ["--until", "cameras"]
    true, given = (poses(run_tiny(scene, store, *until), store) for scene in scenes)
    called = run_tiny(scenes[1], store, *until, "--refine-poses")
    refined = poses(called, store)
    assert turned(given, true) > 0.8
    assert turned(refined, true) < turned(given, true) / 3
    (told,) = [text for node in called.document()["nodes"] for text in node["warnings"]]
    assert told.startswith("The given poses of 12 of 12 views were refined: they moved by 0.0")
    assert told in called.err
    same = run_tiny(scenes[1], store, *until, "--set", "capture.refine_poses=true")
    assert (same.computed(), same.results()) == ({}, called.results())


def test_photos_without_poses_have_none_to_refine(scenes, tmp_path):
    photos = tmp_path / "photos"
    photos.symlink_to(scenes[0] / "color")
    called = run_tiny(photos, tmp_path / "store", "--refine-poses")
    assert called.code == 2
    assert "has no poses that could be refined" in called.err


@pytest.mark.parametrize("name", ["default", "paper", "reference", "fast", "thorough"])
def test_no_preset_refines_poses(name):
    assert preset(Params(), name).capture.refine_poses is False
