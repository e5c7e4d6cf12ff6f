from __future__ import annotations

import numpy as np
import pytest
from generated_desk import generate_desk

from ss_flow.flows.generated import Room, write_scene
from ss_flow.tasks.geometry.cameras import backproject, camera_of


@pytest.fixture(scope="module")
def desk() -> Room:
    return generate_desk(3, views=3, width=160, height=120)


def test_a_desk_is_the_same_each_time(desk):
    again = generate_desk(3, views=3, width=160, height=120)
    assert np.array_equal(desk.rgb, again.rgb)
    assert np.array_equal(desk.depth, again.depth)
    assert np.array_equal(desk.ids, again.ids)


def test_small_things_lie_and_stand_on_the_table(desk):
    kinds = [thing.name.split()[-1] for thing in desk.objects]
    assert sorted(kinds) == sorted(["table", "mug", "box", "brick", "book", "vase", "page", "coaster", "picture"])
    top = 0.5
    for thing in desk.objects[1:8]:
        places = desk.points[desk.point_ids == thing.instance_id]
        assert len(places) and top - 0.01 < places[:, 2].min() and places[:, 2].max() < top + 0.35
    assert not len(desk.held_out)


def test_depth_is_a_sensors(desk):
    known = desk.depth > 0
    assert 0.6 < known.mean() < 0.95
    assert not known[:, 4].any() and not known[:, :, 4].any()
    # Taken with another lens: what lies beside the middle of the picture is not where the photo has it.
    camera = camera_of(desk.cameras, 0)
    height = backproject(desk.depth[0], camera).reshape(120, 160, 3)[..., 2]
    table = known[0] & (desk.ids[0] == 1)
    assert 0.001 < np.median(np.abs(height[table] - 0.5)) < 0.02


def test_a_desk_is_written_as_a_capture(desk, tmp_path):
    write_scene(desk, tmp_path / "desk")
    assert {p.name for p in (tmp_path / "desk").iterdir()} == {
        "color", "depth", "instance", "instances.json", "intrinsic", "part", "parts.json", "pose",
    }  # fmt: skip
