"""A capture with poses that are not exact: they are brought back before anything else where photos and depth tell that
this is better, or where it is asked for, and the run says so."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from altered_captures import shake
from tiny_runs import run_tiny

from ss_flow.cache.store import Store
from ss_flow.flows.deliver import UNCOMPARED
from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.flows.params import Params
from ss_flow.flows.settings import preset
from ss_flow.tasks.capture.colmap import load_pycolmap


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


def warnings_of(called):
    return [text for node in called.document()["nodes"] for text in node["warnings"]]


UNTIL = ("--until", "cameras")
NEVER = ("--set", "capture.refine_poses=never")


def test_jittered_poses_of_a_room_come_back_and_the_run_says_how_far_they_moved(scenes, tmp_path):
    store = tmp_path / "store"
    true, given = (poses(run_tiny(scene, store, *UNTIL, *NEVER), store) for scene in scenes)
    called = run_tiny(scenes[1], store, *UNTIL, "--refine-poses")
    refined = poses(called, store)
    assert turned(given, true) > 0.8
    assert turned(refined, true) < turned(given, true) / 3
    (told,) = warnings_of(called)
    assert told.startswith("Bundle adjustment moves the given poses of 12 of 12 views by 0.0")
    assert told in called.err
    same = run_tiny(scenes[1], store, *UNTIL, "--set", "capture.refine_poses=always")
    assert (same.computed(), same.results()) == ({}, called.results())
    alone = run_tiny(scenes[1], store, *UNTIL)
    assert alone.results() == called.results()
    assert "not exact, so refined ones are used" in warnings_of(alone)[-1]
    for step in ("features", "match", "refined_cameras", "better_poses"):
        assert run_tiny(scenes[1], store, "--until", step).computed() == {}


def test_poses_that_fit_their_photos_stay_without_a_word(scenes, tmp_path):
    store = tmp_path / "store"
    called = run_tiny(scenes[0], store, *UNTIL)
    assert called.computed()["capture.pose_fit"] == 1
    assert called.computed()["capture.features"] < 12
    assert "capture.refined_cameras" not in called.computed()
    assert warnings_of(called) == []
    assert called.results() == run_tiny(scenes[0], store, *UNTIL, *NEVER).results()


def test_views_that_were_kept_back_come_to_where_refined_poses_have_them(scenes, tmp_path):
    room = generate(RoomParams(objects=10, views=12, width=320, height=240, held_out=2))
    capture, store = tmp_path / "room", tmp_path / "store"
    write_scene(room, capture, masks="truth")
    shake(capture, "20,1", drift=False)
    shake(capture / "held_out", "60,3", drift=False)

    def placed(step, *options):
        called = run_tiny(capture, store, "--until", step, *options)
        assert called.code == 0, called.err
        return called, Store(store).get(called.results()[step]).world_to_camera

    def off(kept, trained):
        """[held out] by how much each view is turned, as the others see it: the median, in degrees."""
        true = room.held_out.cameras.world_to_camera, room.cameras.world_to_camera
        there, right = (a[:, None, :3, :3] @ b[:, :3, :3].transpose(0, 2, 1) for a, b in ((kept, trained), true))
        cosine = (np.einsum("abij,abij->ab", there, right) - 1) / 2
        return np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1))), axis=1)

    called, found = placed("cameras_held_out")
    given = placed("cameras_held_out", *NEVER)[1]
    refined = placed("cameras")[1]
    assert off(found, refined).max() < 0.4 and off(given, refined).max() > 2.5
    assert "2 of 2 views that were kept back moved" in warnings_of(called)[-1]
    np.testing.assert_array_equal(placed("cameras_held_out", "--refine-poses")[1], found)
    assert run_tiny(capture, store, "--until", "localized").computed() == {}


def test_refined_poses_that_gain_too_little_are_not_used(scenes, tmp_path):
    store = tmp_path / "store"
    called = run_tiny(scenes[1], store, *UNTIL, "--set", "capture.pose_fit.gain=1")
    assert "refined ones fit no better" in warnings_of(called)[-1]
    assert called.results() == run_tiny(scenes[1], store, *UNTIL, *NEVER).results()


def test_where_photos_have_nothing_in_common_the_given_poses_stay(scenes, tmp_path):
    import shutil

    import cv2

    capture, store = tmp_path / "plain", tmp_path / "store"
    shutil.copytree(scenes[1], capture)
    for photo in (capture / "color").iterdir():
        cv2.imwrite(str(photo), np.full((240, 320, 3), 128, np.uint8))
    called = run_tiny(capture, store, *UNTIL)
    assert called.code == 0
    assert called.results() == run_tiny(capture, store, *UNTIL, *NEVER).results()


@pytest.fixture
def without_pycolmap(monkeypatch):
    load_pycolmap.cache_clear()
    monkeypatch.setitem(sys.modules, "pycolmap", None)


def test_without_pycolmap_given_poses_are_taken_as_they_are_and_the_run_says_so(scenes, tmp_path, without_pycolmap):
    store = tmp_path / "store"
    called = run_tiny(scenes[1], store, *UNTIL)
    assert called.code == 0 and f"warning {UNCOMPARED}\n" in called.err
    assert {"label": "run", "text": UNCOMPARED} in called.document()["warnings"]
    chosen = run_tiny(scenes[1], store, *UNTIL, *NEVER)
    assert chosen.results() == called.results() and UNCOMPARED not in chosen.err


def test_what_takes_pycolmap_says_what_to_do_where_it_is_lacking(scenes, tmp_path, without_pycolmap):
    photos = tmp_path / "photos"
    photos.symlink_to(scenes[0] / "color")
    for called in (
        run_tiny(photos, tmp_path / "store", *UNTIL),
        run_tiny(scenes[1], tmp_path / "store", *UNTIL, "--refine-poses"),
    ):
        assert called.code == 2
        assert "pip install pycolmap" in called.err and "a capture with poses" in called.err


def test_photos_without_poses_have_none_to_refine(scenes, tmp_path):
    photos = tmp_path / "photos"
    photos.symlink_to(scenes[0] / "color")
    called = run_tiny(photos, tmp_path / "store", "--refine-poses")
    assert called.code == 2
    assert "has no poses that could be refined" in called.err


@pytest.mark.parametrize(
    ("name", "when"),
    [("default", "auto"), ("fast", "auto"), ("thorough", "auto"), ("paper", "never"), ("reference", "never")],
)
def test_the_papers_presets_take_poses_as_they_are(name, when):
    assert preset(Params(), name).capture.refine_poses == when
