from __future__ import annotations

import numpy as np
import pytest
from generated_bedroom import generate_bedroom
from generated_desk import generate_desk
from generated_flat import generate_flat
from generated_kitchen import generate_kitchen
from generated_office import generate_office
from generated_orbit import generate_orbit
from generated_shelf import generate_shelf
from generated_tote import dropped, generate_tote
from generated_walk import by_phone, generate_walk

from ss_flow.flows.generated import Room, write_scene
from ss_flow.flows.generated.composites import Composite, Piece, paint
from ss_flow.flows.generated.shapes import ball
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


@pytest.fixture(scope="module")
def kitchen() -> Room:
    return generate_kitchen(3, views=5, width=160, height=120)


@pytest.fixture(scope="module")
def shelf() -> Room:
    return generate_shelf(3, width=160, height=120)


@pytest.fixture(scope="module")
def bedroom() -> Room:
    return generate_bedroom(3, views=6, width=160, height=120)


@pytest.fixture(scope="module")
def walk() -> Room:
    return generate_walk(3, views=6, width=160, height=120)


@pytest.fixture(scope="module")
def orbit() -> Room:
    return generate_orbit(3, views=6, width=160, height=120)


@pytest.fixture(scope="module")
def flat() -> Room:
    return generate_flat(3, views=8, width=160, height=120)


@pytest.fixture(scope="module")
def tote() -> Room:
    return generate_tote(3, views=5, width=160, height=120)


@pytest.fixture(scope="module")
def office() -> Room:
    return generate_office(3, views=6, width=160, height=120)


KINDS = {
    "bedroom": generate_bedroom,
    "flat": generate_flat,
    "kitchen": generate_kitchen,
    "office": generate_office,
    "orbit": generate_orbit,
    "shelf": generate_shelf,
    "tote": generate_tote,
    "walk": generate_walk,
}


@pytest.mark.parametrize(("kind", "generate"), KINDS.items())
def test_each_kind_is_the_same_each_time(kind, generate, request):
    first = request.getfixturevalue(kind)
    again = generate(3, views=len(first), width=160, height=120)
    assert np.array_equal(first.rgb, again.rgb)
    assert np.array_equal(first.depth, again.depth)
    assert np.array_equal(first.ids, again.ids)


def test_a_kitchen_has_things_on_its_counter_and_its_table_and_every_view_shows_some(kitchen):
    kinds = [thing.name.split()[-1] for thing in kitchen.objects]
    on_table, on_counter = (
        ["mug", "bottle", "book"],
        ["microwave", "kettle", "toaster", "bowl", "block", "plant", "jar"],
    )
    assert sorted(kinds) == sorted([*on_table, *on_counter, "bottle", "board", "table", "chair", "chair"])
    height = {thing.name: kitchen.points[kitchen.point_ids == thing.instance_id, 2] for thing in kitchen.objects}
    for name, heights in height.items():
        low = 0.735 if name.split()[-1] in ("mug", "book") else 0.9 if name.split()[-1] in on_counter else 0.0
        assert len(heights) and low - 0.03 < heights.min()
    assert all(len(np.unique(ids)) > 2 for ids in kitchen.ids)


def test_a_bedroom_has_things_on_its_bed_on_its_chest_and_on_its_walls(bedroom):
    kinds = [thing.name.split()[-1] for thing in bedroom.objects]
    assert kinds[0] == "bed" and kinds.count("picture") == kinds.count("curtain") == kinds.count("chest") == 2
    lowest = {"pillow": 0.4, "lamp": 0.4, "jar": 0.75, "plant": 0.75, "picture": 1.2, "curtain": 0.15}
    for thing, kind in zip(bedroom.objects, kinds, strict=True):
        places = bedroom.points[bedroom.point_ids == thing.instance_id]
        assert len(places) and places[:, 2].min() > lowest.get(kind, 0) - 0.03
        assert (np.abs(places[:, :2]) < 2.05).all()
    assert all(len(np.unique(ids)) > 2 for ids in bedroom.ids)


def test_a_shelf_has_nine_things_on_three_boards(shelf):
    kinds = [thing.name.split()[-1] for thing in shelf.objects]
    assert sorted(kinds) == sorted(["carton", "book", "bag", "bottle", "pot", "duck", "box", "carton", "brick"])
    boards = 0.9 + (0.3 + 0.018) * np.array([-1, 0, 1])
    for thing in shelf.objects:
        places = shelf.points[shelf.point_ids == thing.instance_id]
        assert np.abs(places[:, 2].min() - boards).min() < 0.05 and (np.abs(places[:, 0]) < 0.34).all()
    assert 0.8 < (shelf.depth > 0).mean() < 0.999


def test_seven_things_stand_on_the_table_of_a_walk_and_one_beside_it(walk):
    table, *on_it, beside = walk.objects
    lowest = {thing.name: walk.points[walk.point_ids == thing.instance_id, 2].min() for thing in walk.objects}
    top = walk.points[walk.point_ids == table.instance_id, 2].max()
    assert len(on_it) == 7 and all(lowest[thing.name] > top - 0.01 for thing in on_it)
    assert lowest[beside.name] < 0.1
    assert (walk.ids == 0).any(axis=(1, 2)).all()


def test_a_walk_goes_round_twice(walk):
    eyes = np.linalg.inv(walk.cameras.world_to_camera)[:, :3, 3]
    angles = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0]))
    assert (np.diff(angles) > 0).all() and angles[-1] - angles[0] > 3 * np.pi


def test_an_orbit_has_one_thing_in_the_middle_of_every_photo(orbit):
    assert orbit.objects[0].name.split()[-1] == "handbag" and len(orbit.objects[0].parts) == 5
    v, u = np.mgrid[:120, :160]
    for ids in orbit.ids:
        mine = ids == 1
        assert 0.02 < mine.mean() < 0.3
        assert abs(u[mine].mean() - 80) < 30 and abs(v[mine].mean() - 60) < 25


@pytest.mark.parametrize("seed", range(5))
def test_every_fifth_orbit_is_of_another_thing_which_stands_on_something(seed):
    orbit = generate_orbit(seed, views=2, width=64, height=48)
    thing, *stand = orbit.objects
    assert thing.name.split()[-1] == ["teapot", "robot", "shoe", "handbag", "truck"][seed]
    lowest = orbit.points[orbit.point_ids == 1, 2].min()
    highest = max([orbit.points[orbit.point_ids == one.instance_id, 2].max() for one in stand], default=0.0)
    assert abs(lowest - highest) < 0.03


def test_a_flat_has_two_rooms_of_which_the_table_is_seen_from_both_and_nothing_is_known_beyond_four_metres(flat):
    table = flat.objects[0]
    eyes = np.linalg.inv(flat.cameras.world_to_camera)[:, 0, 3]
    sees = np.array([(ids == table.instance_id).any() for ids in flat.ids])
    assert sees[eyes < 0].any() and sees[eyes > 0].any()
    beyond = flat.points[flat.point_ids > 0, 0]
    assert (beyond < -0.5).any() and (beyond > 0.5).any() and (np.abs(beyond) < 3.5).all()
    assert flat.depth.max() <= 4 and 0.5 < (flat.depth > 0).mean() < 0.98


def test_ten_things_lie_in_a_tote_and_some_of_them_on_others(tote):
    box, *heap = tote.objects
    assert box.name.endswith("tote") and len(heap) == 10
    floor, lowest = 0.706, []
    for thing in heap:
        places = tote.points[tote.point_ids == thing.instance_id]
        assert (np.abs(places[:, :2]) < (0.275, 0.185)).all()
        lowest.append(places[:, 2].min() - floor)
    assert min(lowest) > -0.005 and sum(low > 0.02 for low in lowest) >= 2


def test_what_is_dropped_comes_to_lie_on_what_is_below_it_and_not_in_it():
    radius = 0.06
    one = Composite("red ball", (Piece("ball", ball(radius), paint("red")),))
    heap = dropped([one] * 14, np.random.default_rng(0))
    middle = np.array([thing.bounds.mean(axis=0) for thing in heap])
    apart = np.linalg.norm(middle[:, None] - middle, axis=-1)[np.triu_indices(14, 1)]
    assert (apart > 2 * radius - 0.008).all()
    assert (middle[:, 2] > radius - 0.008).all() and (middle[:, 2] > 1.5 * radius).any()
    assert (middle[:, 2] < 4 * radius).all()


def test_an_office_has_things_on_its_desk_and_a_chair_before_it_and_the_screen_has_no_depth(office):
    desk, *on_it, chair = office.objects
    kinds = [thing.name.split()[-1] for thing in on_it]
    assert kinds[:8] == ["monitor", "keyboard", "mouse", "lamp", "plant", "pot", "papers", "mug"]
    for thing in on_it:
        assert office.points[office.point_ids == thing.instance_id, 2].min() > 0.71
    feet = office.points[office.point_ids == chair.instance_id]
    assert feet[:, 2].min() < 0.05 and chair.name.endswith("chair") and desk.name.endswith("desk")
    monitor = on_it[0]
    screen = (office.ids == monitor.instance_id) & (office.parts == 1 + monitor.parts.index("screen"))
    assert (office.depth[screen] > 0).mean() < 0.2
    assert (office.depth[~screen] > 0).mean() > 0.8


def test_a_phone_exposes_and_balances_anew_and_darkens_corners():
    taken = by_phone(np.full((12, 48, 64, 3), 128, np.uint8), np.random.default_rng(0)).astype(float)
    middle, corner = taken[:, 20:28, 28:36].mean(axis=(1, 2)), taken[:, :4, :4].mean(axis=(1, 2))
    assert (corner < 0.95 * middle).all() and (corner > 0.8 * middle).all()
    exposure, balance = middle[:, 1], middle[:, 0] / middle[:, 2]
    assert 5 < np.ptp(exposure) < 60 and 0.01 < np.ptp(balance) < 0.1


def test_a_desk_is_written_as_a_capture(desk, tmp_path):
    write_scene(desk, tmp_path / "desk")
    assert {p.name for p in (tmp_path / "desk").iterdir()} == {
        "color", "depth", "instance", "instances.json", "intrinsic", "part", "parts.json", "pose",
    }  # fmt: skip
