"""Seeded defects of a generated room are told of, each by its own sentence; a clean room and turned views are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ss_flow.flows.generated import Room, RoomParams, generate
from ss_flow.running import Surroundings, running
from ss_flow.tasks.artifacts import Cameras, CaptureChecks, DepthMap, Frame
from ss_flow.tasks.capture.checks import _errors, checks
from ss_flow.tasks.geometry.images import encode_png


@pytest.fixture(scope="module")
def room() -> Room:
    return generate(RoomParams(objects=6, views=12, width=96, height=72, held_out=0))


def _checked(
    room: Room, rgb: np.ndarray | None = None, depth: np.ndarray | None = None, cameras: Cameras | None = None
) -> tuple[list[str], CaptureChecks]:
    rgb = room.rgb if rgb is None else rgb
    depth = room.depth if depth is None else depth
    cameras = cameras or room.cameras
    h, w = rgb.shape[1:3]
    frames = [
        Frame(name, w, h, encode_png(image), np.zeros(0, np.uint8), w, h)
        for name, image in zip(cameras.names, rgb, strict=True)
    ]
    depths = [DepthMap(name, one, "sensor") for name, one in zip(cameras.names, depth, strict=True)]
    heard: list[str] = []
    with running(Surroundings(warned=heard)):
        return heard, checks(frames, cameras, depths)


def _jittered(room: Room, degrees: float, metres: float, views: range | list[int]) -> Cameras:
    import cv2

    rng = np.random.default_rng(1)
    poses = room.cameras.world_to_camera.copy()
    for view in views:
        shaken = np.eye(4)
        shaken[:3, :3] = cv2.Rodrigues(rng.normal(0, np.radians(degrees), 3))[0]
        shaken[:3, 3] = rng.normal(0, metres, 3)
        poses[view] = shaken @ poses[view]
    return replace(room.cameras, world_to_camera=poses)


def test_nothing_is_said_of_a_clean_room(room: Room) -> None:
    heard, found = _checked(room)
    assert heard == []
    assert np.nanmedian(found.depth_error) < 0.01 and np.nanmin(found.likeness) > 0.8
    assert found.exposure == pytest.approx(np.ones(len(room)), abs=0.1) and found.depth_scale == 1


def _moved(room: Room, by: float) -> Cameras:
    """The room's cameras after the whole world was moved."""
    poses = room.cameras.world_to_camera.copy()
    poses[:, :3, 3] -= poses[:, :3, :3] @ np.array([by, 0.0, 0.0])
    return replace(room.cameras, world_to_camera=poses)


def test_a_world_too_far_from_its_origin_for_float32_is_told(room: Room) -> None:
    heard, _ = _checked(room, cameras=_moved(room, 500_000))
    assert len(heard) == 1
    assert "stand up to 500,00" in heard[0] and "steps of 0.031," in heard[0]
    assert _checked(room, cameras=_moved(room, 5_000))[0] == []


def test_jitter_of_all_poses_is_told_with_its_size(room: Room) -> None:
    (said,), found = _checked(room, cameras=_jittered(room, 2.0, 0.06, range(len(room))))
    assert "poses, intrinsics and depth disagree" in said and f"{np.nanmedian(found.depth_error):.1%}" in said


def test_cameras_in_wrong_places_are_not_taken_for_a_scale(room: Room) -> None:
    heard, found = _checked(room, cameras=_jittered(room, 0.0, 0.3, range(len(room))))
    assert any("poses, intrinsics and depth disagree" in said for said in heard) and found.depth_scale == 1


def test_a_single_wrong_pose_is_named(room: Room) -> None:
    (said,), found = _checked(room, cameras=_jittered(room, 6.0, 0.2, [5]))
    assert "do not fit their depth" in said and "0005" in said
    assert int(np.nanargmax(found.depth_error)) in (4, 5, 6)


def test_a_view_too_close_for_the_sensor_is_not_taken_for_a_wrong_pose(room: Room) -> None:
    """A board before a wall. The last view is so close to the board that it has depth of the wall alone, which the
    board hides from the other views."""
    centers = np.array([*([x, 0.0, 0.0] for x in np.linspace(-0.8, -0.2, 7)), [0.55, 0.0, 1.2]])
    w, h, focal = 96, 72, 48.0
    ray = np.stack(np.meshgrid((np.arange(w) + 0.5 - w / 2) / focal, (np.arange(h) + 0.5 - h / 2) / focal), -1)
    depth, rgb = np.zeros((8, h, w), np.float32), np.zeros((8, h, w, 3), np.uint8)
    for view, (x, _, z) in enumerate(centers):
        on_board = np.abs(x + (1.5 - z) * ray[..., 0]) < 0.5
        depth[view] = np.where(on_board, 1.5, 3.0) - z
        place = (depth[view][..., None] * ray + [x, 0]) @ [5.0, 3.0]
        rgb[view] = (128 + 80 * np.sin(place) * np.where(on_board, 1, 0.5))[..., None]
    depth[depth < 0.5] = 0
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, :3, 3] = -centers
    names, sizes = tuple(f"{view:04d}" for view in range(8)), np.tile(np.int32([w, h]), (8, 1))
    cameras = Cameras(names, sizes, np.tile([focal, focal, w / 2, h / 2], (8, 1)), poses, metric=True)
    heard, found = _checked(room, rgb, depth, cameras)
    assert heard == [] and found.depth_error[-1] < 0.01
    wrong = poses.copy()
    wrong[-1, 2, 3] += 0.1
    heard, _ = _checked(room, rgb, depth, replace(cameras, world_to_camera=wrong))
    assert any("do not fit their depth" in said and "0007" in said for said in heard)


@pytest.mark.parametrize("factor", [0.75, 1.3, 0.2, 5, 0.1, 0.3048, 1000])
def test_depth_of_a_wrong_scale_is_told_with_the_right_one(room: Room, factor: float) -> None:
    (said,), found = _checked(room, depth=room.depth * np.float32(factor))
    assert "is its unit right?" in said and found.depth_scale == pytest.approx(1 / factor, rel=0.06)
    assert f" {float(f'{found.depth_scale:.2g}'):g} times as large" in said
    assert np.nanmin(found.likeness) > 0.8, "photos are compared by the depth that fits"


def _mirrored(poses: np.ndarray, axis: int) -> np.ndarray:
    mirror = np.eye(4)
    mirror[axis, axis] = -1
    return mirror @ poses @ mirror


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (
            lambda poses, flip: np.linalg.inv(poses),
            "the poses are inverted: camera-to-world and world-to-camera are exchanged.",
        ),
        (lambda poses, flip: flip @ np.linalg.inv(poses) @ flip, "the poses are inverted: camera-to-world"),
        (lambda poses, flip: flip @ poses, "y and z of the cameras are turned: OpenGL's axes and OpenCV's are"),
        (lambda poses, flip: _mirrored(poses, 1), "the poses are mirrored: they are those of a left-handed world"),
        (lambda poses, flip: _mirrored(poses, 2), "the poses are mirrored: they are those of a left-handed world"),
    ],
    ids=["inverted", "inverted, of OpenGL", "axes of OpenGL", "mirrored in y", "mirrored in z"],
)
def test_exchanged_conventions_of_poses_are_told_and_nothing_that_follows_from_them(
    room: Room, mistake: Any, says: str
) -> None:
    poses = mistake(room.cameras.world_to_camera, np.diag([1.0, -1.0, -1.0, 1.0]))
    (said,), _ = _checked(room, cameras=replace(room.cameras, world_to_camera=poses))
    assert "poses, intrinsics and depth disagree" in said and f"; they agree once {says}" in said


def test_of_poses_that_are_merely_wrong_no_convention_is_blamed(room: Room) -> None:
    heard, _ = _checked(room, cameras=_jittered(room, 0.0, 0.3, range(len(room))))
    assert any("poses, intrinsics and depth disagree" in said for said in heard)
    assert not any("they agree" in said for said in heard)


def test_of_depth_so_far_away_that_any_poses_fit_no_convention_is_blamed(room: Room) -> None:
    """As where depth was stored as its distance from the largest number."""
    heard, _ = _checked(room, depth=np.float32(65.535) - room.depth)
    assert any("poses, intrinsics and depth disagree" in said for said in heard)
    assert not any("they agree" in said for said in heard)


def test_by_poses_that_disagree_with_depth_no_photos_are_compared(room: Room) -> None:
    rgb = room.rgb.copy()
    rgb[::2] = rgb[::2] // 2
    rgb[4] = rgb[4][::-1, ::-1]
    heard, _ = _checked(room, rgb, cameras=_jittered(room, 2.0, 0.06, range(len(room))))
    assert any("poses, intrinsics and depth disagree" in said for said in heard)
    assert not any("exposure" in said or "neighbours show" in said for said in heard)


def test_duplicates_are_counted_and_named(room: Room) -> None:
    rgb, depth, poses = room.rgb.copy(), room.depth.copy(), room.cameras.world_to_camera.copy()
    for view in (3, 7):
        rgb[view], depth[view], poses[view] = rgb[view - 1], depth[view - 1], poses[view - 1]
    (said,), found = _checked(room, rgb, depth, replace(room.cameras, world_to_camera=poses))
    assert found.duplicates == ("0003", "0007") and said == "Photos that repeat an earlier one: 2 of 12, 0003, 0007."


def test_exchanged_intrinsics_are_told_by_the_principal_point(room: Room) -> None:
    wrong = room.cameras.intrinsics.copy()
    wrong[:, 2:] = wrong[:, 3:1:-1]
    heard, _ = _checked(room, cameras=replace(room.cameras, intrinsics=wrong))
    assert any(
        "(36, 48) of 96 x 72 pixels; are its intrinsics exchanged, or those of a photo of another size?" in said
        for said in heard
    )


def test_a_turned_photo_is_named(room: Room) -> None:
    rgb = room.rgb.copy()
    rgb[4] = rgb[4][::-1, ::-1]
    (said,), found = _checked(room, rgb)
    assert (
        "differ from what their neighbours show" in said and "0004" in said and int(np.nanargmin(found.likeness)) == 4
    )


@pytest.mark.parametrize("known", [True, False], ids=["with its depth", "without its depth"])
def test_a_photo_that_shows_nothing_is_named(room: Room, known: bool) -> None:
    rgb, depth = room.rgb.copy(), room.depth.copy()
    rgb[5] = 0
    depth[5] *= known
    (said,), found = _checked(room, rgb=rgb, depth=depth)
    assert said.startswith("Photos that differ from what their neighbours show: 1 of 12, 0005 (correlation 0.00")
    assert found.exposure == pytest.approx(np.ones(len(room)), abs=0.1)


def test_of_a_plain_wall_close_before_a_camera_nothing_else_is_expected(room: Room) -> None:
    rgb, depth = room.rgb.copy(), room.depth.copy()
    rgb[5], depth[5] = 200, 0.3 * depth[5].min()
    heard, _ = _checked(room, rgb=rgb, depth=depth)
    assert not [said for said in heard if "neighbours show" in said]


def test_rolling_exposure_is_told_with_its_factor(room: Room) -> None:
    factor = 1 + 0.3 * np.sin(np.arange(len(room)) / len(room) * 2 * np.pi)
    rgb = np.clip(0.7 * room.rgb * factor[:, None, None, None], 0, 255).astype(np.uint8)
    (said,), found = _checked(room, rgb)
    assert "exposure changes by a factor of 1." in said
    assert np.corrcoef(np.log(found.exposure), np.log(factor))[0, 1] > 0.95
    assert found.exposure.max() / found.exposure.min() == pytest.approx(1.3 / 0.7, rel=0.15)


def test_of_depth_that_fits_no_other_scale_is_looked_for(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def errors(view: Any, other: Any, scales: np.ndarray) -> np.ndarray:
        tried.append(len(scales))
        return _errors(view, other, scales)

    monkeypatch.setattr("ss_flow.tasks.capture.checks._errors", errors)
    _checked(room)
    assert set(tried) == {1}
    _checked(room, depth=1.3 * room.depth)
    assert set(tried) > {1}
