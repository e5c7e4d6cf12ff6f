"""What a depth sensor is blind to is found by comparing photos; what it knows stays, and costs nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_runs import ss_flow

from ss_flow.cache.store import Store
from ss_flow.flows.generated import Room, RoomParams, generate, write_scene

UNTIL = "--until", "depth", "--json", "--set", "capture.refine_poses=never"


@pytest.fixture(scope="module")
def room() -> Room:
    return generate(RoomParams(objects=3, views=10, width=160, height=120, held_out=0))


def depths(room: Room, folder, *options):
    if not (folder / "room").exists():
        write_scene(room, folder / "room", masks="truth")
    called = ss_flow("run", folder / "room", "--cache", folder / "store", *UNTIL, *options)
    assert called.code == 0, called.err
    store = Store(folder / "store")
    return called, np.stack([store.get(digest).depth for digest in called.results()["depth"]])


def test_walls_that_a_sensor_is_blind_to_have_depth_from_the_photos(room, tmp_path):
    blind = room.depth > np.quantile(room.depth, 0.6)
    called, found = depths(replace(room, depth=np.where(blind, 0, room.depth)), tmp_path)
    assert called.computed()["capture.sweep"] == 10 and called.computed()["capture.completed"] == 50
    known = found[blind] > 0
    assert known.mean() > 0.3, "plain walls have little that photos could agree on"
    assert (np.abs(found[blind] / room.depth[blind] - 1) < 0.05)[known].mean() > 0.9
    np.testing.assert_allclose(found[~blind], room.depth[~blind], atol=1e-3)


def test_only_views_with_gaps_are_compared(room, tmp_path):
    depth = room.depth.copy()
    depth[4][:, :80] = 0
    called, found = depths(replace(room, depth=depth), tmp_path)
    assert called.computed()["capture.sweep"] == 1 and (found[4][:, :80] > 0).mean() > 0.2
    whole, _ = depths(room, tmp_path / "whole")
    assert not {"capture.sweep", "capture.neighbors"} & set(whole.computed())
    off, left = depths(replace(room, depth=depth), tmp_path, "--set", "capture.completion.below=0")
    assert (left[4][:, :80] == 0).all() and "capture.gaps" not in off.computed()
