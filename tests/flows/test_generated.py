"""The built-in scene: what it promises about geometry, ids, visibility, files and mask faults."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.errors import InputError
from ss_flow.flows.generated import Room, RoomParams, generate, renderer_of, write_scene
from ss_flow.flows.generated.layout import MAX_OBJECTS, furnish
from ss_flow.flows.generated.masks import DegradeParams, _touching, degrade
from ss_flow.flows.generated.shapes import SHAPES, ball, box, can, turned_profile
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.geometry.cameras import backproject, camera_of, pixels_in_view

SMALL = RoomParams(objects=10, views=12, width=120, height=90, seed=0, held_out=3)


@pytest.fixture(scope="module")
def room() -> Room:
    return generate(SMALL)


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_the_same_parameters_give_the_same_room_and_another_seed_another(room: Room) -> None:
    again, other = generate(SMALL), generate(dataclasses.replace(SMALL, seed=1))
    for name in ("rgb", "depth", "ids", "points", "point_ids"):
        np.testing.assert_array_equal(getattr(room, name), getattr(again, name))
    np.testing.assert_array_equal(room.held_out.rgb, again.held_out.rgb)
    assert (room.ids != other.ids).any()


def test_arrays_have_the_declared_shapes_and_types(room: Room) -> None:
    assert room.rgb.shape == (12, 90, 120, 3) and room.rgb.dtype == np.uint8
    assert room.depth.shape == room.ids.shape == (12, 90, 120)
    assert room.depth.dtype == np.float32 and room.ids.dtype == np.uint16
    assert len(room.cameras) == 12 and len(room.held_out) == 3
    assert len(room.points) == len(room.point_colors) == len(room.point_ids)
    assert np.isfinite(room.depth).all() and room.depth.min() > 0.3 and room.depth.max() < 6


def test_a_thing_alone_looks_as_it_does_in_the_room(room: Room) -> None:
    renderer = renderer_of(SMALL)
    ids = room.ids[0]
    for instance in np.unique(ids[ids > 0]):
        rgb, alpha, depth = renderer.alone(camera_of(room.cameras, 0), int(instance))
        shown = ids == instance
        np.testing.assert_array_equal(depth[shown], room.depth[0][shown])
        np.testing.assert_array_equal(alpha[depth > 0] > 0, True)
        # Where it does not show in the room something hides it, or it is not there.
        assert ((depth == 0) | (depth >= room.depth[0]))[~shown].all()
        solid = shown & (alpha == 1)
        if solid.sum() > 50:
            assert np.abs(255 * rgb - room.rgb[0])[solid].mean() < 4  # the sensor's noise, and edges of shadows
        assert (rgb[alpha == 0] == 0).all() and (rgb <= alpha[..., None] + 1e-6).all()


def test_a_thing_out_of_sight_shows_nothing_alone(room: Room) -> None:
    behind = camera_of(room.cameras, 0).world_to_camera.copy()
    behind[2, 3] -= 100  # metres: the whole room lies behind the camera
    camera = dataclasses.replace(camera_of(room.cameras, 0), world_to_camera=behind)
    rgb, alpha, depth = renderer_of(SMALL).alone(camera, int(room.ids.max()))
    assert rgb.shape == (90, 120, 3) and not rgb.any() and not alpha.any() and not depth.any()


def test_depth_seen_from_one_view_agrees_with_depth_and_ids_of_the_others(room: Room) -> None:
    world = backproject(room.depth[0], camera_of(room.cameras, 0))
    ids = room.ids[0].ravel()
    compared = agreed = 0
    for view in range(1, len(room)):
        rows, column, row, z = pixels_in_view(world, camera_of(room.cameras, view))
        same_place = np.abs(room.depth[view][row, column] - z) < 0.01
        compared += int(same_place.sum())
        agreed += int((room.ids[view][row, column] == ids[rows])[same_place].sum())
        assert (z > room.depth[view][row, column] - 0.15).mean() > 0.93, "points float in front of what is seen"
    assert compared > 5000
    assert agreed / compared > 0.97


def test_poses_are_rigid_and_look_inwards(room: Room) -> None:
    for view in range(len(room)):
        camera = camera_of(room.cameras, view)
        rotation = camera.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert rotation[2][:2] @ camera.center[:2] < 0
        assert rotation[1][2] < 0, "image rows must run downwards in a world with z up"


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_object_is_seen_from_several_views(seed: int) -> None:
    room = generate(RoomParams(views=24, width=120, height=90, seed=seed, held_out=0))
    area = np.stack([(room.ids == o.instance_id).mean(axis=(1, 2)) for o in room.objects])
    assert ((area >= 0.01).sum(axis=1) >= 3).all()
    assert ((area > 0).sum(axis=1) >= 4).all()


def test_names_are_unique_and_begin_with_the_colour(room: Room) -> None:
    assert [o.instance_id for o in room.objects] == list(range(1, 14))
    assert len({o.name for o in room.objects}) == 13
    assert all(o.name.split()[0] == o.color for o in room.objects)
    assert set(np.unique(room.ids)) <= set(range(14))


def test_points_lie_on_the_surfaces_that_their_ids_name(room: Room) -> None:
    hits = 0
    for view in range(len(room)):
        rows, column, row, z = pixels_in_view(room.points, camera_of(room.cameras, view))
        seen = np.abs(room.depth[view][row, column] - z) < 0.005
        right = room.ids[view][row, column][seen] == room.point_ids[rows][seen]
        hits += int(seen.sum())
        assert right.mean() > 0.97
    assert hits > len(room.points)


def test_an_object_shows_its_colour(room: Room) -> None:
    named = {o.color: o for o in room.objects if o.color in ("red", "green", "blue")}
    for channel, color in enumerate(("red", "green", "blue")):
        mean = room.rgb[room.ids == named[color].instance_id].mean(axis=0)
        assert mean.argmax() == channel


def test_small_things_stand_apart() -> None:
    things = [t for t in furnish(40, np.random.default_rng(3)) if t.instance_id > 3]
    assert len(things) == 40 and len({t.name for t in things}) == 40
    low = np.array([t.mesh.vertices.min(axis=0) for t in things])
    high = np.array([t.mesh.vertices.max(axis=0) for t in things])
    apart = 0
    for i in range(40):
        for j in range(i):
            center = (low[[i, j]] + high[[i, j]]) / 2
            if low[i, 2] == pytest.approx(low[j, 2]):
                apart += 1
                assert np.linalg.norm((center[0] - center[1])[:2]) > 0.08
    assert apart > 50


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_a_shape_is_closed_and_stands_on_the_ground(name: str) -> None:
    mesh = SHAPES[name]()
    assert mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1)
    corner = mesh.vertices[mesh.triangles]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(area.sum(axis=0), 0, atol=1e-9)
    assert (area * mesh.normals[mesh.triangles[:, 0]]).sum() > 0, "faces must wind the way the normals point"


def test_volumes_of_simple_shapes_are_those_of_the_textbook() -> None:
    def volume(mesh: object) -> float:
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)  # type: ignore[attr-defined]
        return float((a * np.cross(b, c)).sum() / 6)

    assert volume(box(2, 3, 4)) == pytest.approx(24)
    assert volume(can(1, 2)) == pytest.approx(2 * np.pi, rel=0.01)
    assert volume(ball(1)) == pytest.approx(4 / 3 * np.pi, rel=0.03)
    assert volume(turned_profile([(0, 0), (1, 0), (0, 1)])) == pytest.approx(np.pi / 3, rel=0.01)


@pytest.mark.parametrize(
    "values", [{"objects": 0}, {"objects": MAX_OBJECTS + 1}, {"views": 1}, {"held_out": -1}, {"width": 8}]
)
def test_impossible_rooms_are_refused(values: dict[str, int]) -> None:
    with pytest.raises(InputError, match="generated room"):
        RoomParams(**values)  # type: ignore[arg-type]


def test_a_written_scene_reads_back_as_the_room(room: Room, tmp_path: Path) -> None:
    import cv2

    folder = tmp_path / "scene"
    write_scene(room, folder, masks="truth")
    assert {p.name for p in folder.iterdir()} == {
        *("color", "depth", "pose", "intrinsic", "instance", "instance_masks", "held_out", "instances.json")
    }
    intrinsic = np.loadtxt(folder / "intrinsic" / "intrinsic_color.txt")
    np.testing.assert_allclose(intrinsic[:2, :3], [[108, 0, 59.5], [0, 108, 44.5]])
    for i, name in enumerate(room.cameras.names):
        depth = cv2.imread(str(folder / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        np.testing.assert_allclose(depth / 1000, room.depth[i], atol=0.00051)
        pose = np.linalg.inv(np.loadtxt(folder / "pose" / f"{name}.txt"))
        np.testing.assert_allclose(pose, room.cameras.world_to_camera[i], atol=1e-7)
        for kind in ("instance", "instance_masks"):
            ids = cv2.imread(str(folder / kind / f"{name}.png"), cv2.IMREAD_UNCHANGED)
            assert ids.dtype == np.uint16
            np.testing.assert_array_equal(ids, room.ids[i])
        color = cv2.imread(str(folder / "color" / f"{name}.jpg"))[..., ::-1]
        assert np.abs(color.astype(int) - room.rgb[i]).mean() < 4
    names = json.loads((folder / "instances.json").read_text())
    assert names == {str(o.instance_id): o.name for o in (room.structure, *room.objects)}
    assert not open_scene(folder).zero_is_void
    assert len(list((folder / "held_out" / "color").iterdir())) == 3


def test_a_scene_is_not_written_over_something_else(room: Room, tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("precious")
    with pytest.raises(InputError, match="not an empty folder"):
        write_scene(room, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["letter.txt"]


def _grid(views: int = 10) -> np.ndarray:
    """Views of twelve touching tiles of 20 x 20 pixels with a border of 10."""
    tiles = np.kron(np.arange(1, 13).reshape(3, 4), np.ones((20, 20))).astype(np.uint16)
    return np.stack([np.pad(tiles, 10)] * views)


def _degraded(truth: np.ndarray, seed: int = 0, **faults: float) -> np.ndarray:
    params = {"missed": 0.0, "split": 0.0, "jitter_px": 0.0, **faults}
    return degrade(truth, DegradeParams(**params), seed=seed)


def _masks(ids: np.ndarray) -> int:
    return sum(len(np.unique(view[view > 0])) for view in ids)


def test_without_faults_only_the_numbering_changes() -> None:
    truth = _grid()
    ids = _degraded(truth)
    assert ids.dtype == np.uint16
    for view, true_view in zip(ids, truth, strict=True):
        pairs = np.unique(np.stack([view.ravel(), true_view.ravel()]), axis=1)
        assert pairs.shape[1] == 13 and (pairs[:, 0] == 0).all()
    assert (ids[0] != ids[1]).any(), "ids must not carry from view to view"


@given(st.sampled_from([0.0, 0.1, 0.25, 0.5, 1.0]), st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_the_share_of_missed_masks_holds(share: float, seed: int) -> None:
    assert _masks(_degraded(_grid(), seed, missed=share)) == 120 - round(share * 120)


def test_the_share_of_split_masks_holds_and_pieces_are_pieces() -> None:
    truth = _grid()
    ids = _degraded(truth, split=0.15)
    pieces = [
        len(np.unique(view[true_view == i])) for view, true_view in zip(ids, truth, strict=True) for i in range(1, 13)
    ]
    assert sum(n > 1 for n in pieces) == 18 and set(pieces) == {1, 2, 3}
    np.testing.assert_array_equal(ids == 0, truth == 0)


def test_the_share_of_merged_pairs_holds() -> None:
    truth = _grid(1)
    assert len(_touching(truth[0].astype(np.int64))) == 17
    assert _masks(_degraded(truth, merged=1 / 17)) == 11
    assert _masks(_degraded(truth, merged=1.0)) == 1
    np.testing.assert_array_equal(_degraded(truth, merged=1.0) == 0, truth == 0)


def test_jitter_moves_boundaries_but_not_further_than_asked() -> None:
    from scipy.ndimage import distance_transform_edt

    truth = _grid(4)
    for true_view, view in zip(truth, _degraded(truth, jitter_px=5.0), strict=True):
        moved = 0
        for i in range(1, 13):
            mask = true_view == i
            values, counts = np.unique(view[mask], return_counts=True)
            found = view == values[counts.argmax()]
            assert 0.4 < _iou(mask, found) < 1
            reach = np.maximum(distance_transform_edt(~mask), distance_transform_edt(mask))
            moved = max(moved, float(reach[mask != found].max()))
        assert 3 < moved <= 6.5


def test_default_faults_are_those_of_a_mediocre_segmenter(room: Room) -> None:
    ids = degrade(room.ids, DegradeParams(), seed=0)
    total = _masks(room.ids)
    kept = total - round(0.2 * total)
    pieces = round(0.15 * total)
    assert kept + 0.5 * pieces < _masks(ids) <= kept + 2 * pieces
    np.testing.assert_array_equal(ids, degrade(room.ids, DegradeParams(), seed=0))
    assert (ids != degrade(room.ids, DegradeParams(), seed=1)).any()


@pytest.mark.parametrize("faults", [{"missed": 1.2}, {"merged": -0.1}, {"missed": 0.6, "split": 0.6}])
def test_impossible_shares_are_refused(faults: dict[str, float]) -> None:
    with pytest.raises(InputError, match="share"):
        _degraded(_grid(1), **faults)
