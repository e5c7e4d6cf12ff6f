"""A capture whose poses are right and whose lens is stated wrongly: the run finds the lens, uses it, and says so."""

from __future__ import annotations

import numpy as np
import pytest
from altered_captures import zoom
from bent_room import bent, least_fit
from tiny_runs import run_tiny

from ss_flow.cache.store import Store
from ss_flow.flows.generated import RoomParams, generate, write_scene


@pytest.fixture(scope="module")
def room():
    return generate(RoomParams(objects=8, views=10, width=480, height=360, held_out=0))


def reached(folder, store, *options):
    """Results of a run up to the masks, and its warnings."""
    found, warnings = {}, []
    for step in ("cameras", "depth", "segment"):
        called = run_tiny(folder, store, *options, "--until", step)
        assert called.code == 0, called.err
        found |= called.results()
        warnings += [text for node in called.document()["nodes"] for text in node["warnings"]]
    return found, warnings


def test_photos_of_which_a_capture_does_not_say_that_they_are_bent_are_straightened(room, tmp_path):
    folder, store = tmp_path / "room", tmp_path / "store"
    write_scene(bent(room, -0.15), folder, masks="truth")
    found, warnings = reached(folder, store)
    cameras = Store(store).get(found["cameras"])
    np.testing.assert_allclose(cameras.radial, -0.15, atol=0.02)
    np.testing.assert_allclose(cameras.world_to_camera, room.cameras.world_to_camera, atol=1e-8)
    assert any("The lens that came with this capture does not fit its photos" in text for text in warnings)
    for masks in map(Store(store).get, found["segment"]):
        assert least_fit(room, masks.name, masks.dense()) > 0.93
    as_given, _ = reached(folder, store, "--set", "capture.refine_poses=never")
    fits = [least_fit(room, masks.name, masks.dense()) for masks in map(Store(store).get, as_given["segment"])]
    assert min(fits) < 0.9


@pytest.mark.parametrize("both", [False, True], ids=["straight depth", "bent depth"])
def test_depth_lies_where_the_straightened_photos_show_it(room, both, tmp_path):
    folder, store = tmp_path / "room", tmp_path / "store"
    write_scene(bent(room, -0.15, depth=both), folder, masks="truth")
    found, warnings = reached(folder, store)
    assert any("depth images were bent as their photos" in text for text in warnings) == both
    for depth in map(Store(store).get, found["depth"]):
        true = room.depth[room.cameras.names.index(depth.name)]
        known = depth.depth > 0
        assert known.mean() > 0.8 and (np.abs(depth.depth / true - 1)[known] < 0.02).mean() > 0.97


def test_a_focal_length_that_is_stated_wrongly_is_put_right(room, tmp_path):
    folder, store = tmp_path / "room", tmp_path / "store"
    write_scene(room, folder, masks="truth")
    right, none = reached(folder, store)
    zoom(folder, 1.06)
    found, warnings = reached(folder, store)
    focal = [Store(store).get(results["cameras"]).intrinsics[:, :2] for results in (found, right)]
    np.testing.assert_allclose(*focal, rtol=0.003)
    assert found["segment"] == right["segment"] and found["depth"] == right["depth"]
    assert none == [] and any("0.94" in text for text in warnings)


def test_views_that_were_kept_back_are_seen_through_the_lens_that_was_found(tmp_path):
    room = generate(RoomParams(objects=8, views=10, width=480, height=360, held_out=2))
    folder, store = tmp_path / "room", tmp_path / "store"
    write_scene(room, folder, masks="truth")
    for place in (folder, folder / "held_out"):
        zoom(place, 1.06)
    focal = {}
    for step in ("cameras", "cameras_held_out"):
        called = run_tiny(folder, store, "--until", step)
        assert called.code == 0, called.err
        focal[step] = Store(store).get(called.results()[step]).intrinsics[0, 0]
    assert focal["cameras_held_out"] == focal["cameras"] == pytest.approx(room.cameras.intrinsics[0, 0], rel=0.003)
    zoom(folder / "held_out", 1.06)
    other = run_tiny(folder, store, "--until", "cameras_held_out")
    stays = Store(store).get(other.results()["cameras_held_out"]).intrinsics[0, 0]
    assert stays == pytest.approx(1.06**2 * room.cameras.intrinsics[0, 0])
