"""Which views of a long recording are used."""

from dataclasses import replace
from pathlib import Path

import capture_folders as made
import cv2
import numpy as np
import pytest

from ss_flow.cache.store import Store
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.params import Params
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.scene_files import Hint, Hints, SceneFiles
from ss_flow.tasks.capture.thinning import thinned
from ss_flow.tasks.geometry.cameras import centers_of

LENS = Lens(640, 480, 500.0, 500.0, 320.0, 240.0)
FOCAL = 500 / 800
"""In diagonals."""


def recording(turns, steps, metric=True, **more) -> SceneFiles:
    """Of a camera that is turned about y by these angles at these places along x."""
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    for pose, angle, x in zip(poses, turns, steps, strict=True):
        pose[:3, :3] = cv2.Rodrigues(np.array([0, float(angle), 0]))[0]
        pose[:3, 3] = -pose[:3, :3] @ [x, 0, 0]
    names = tuple(f"{i:04d}" for i in range(len(poses)))
    return SceneFiles(
        kind="scannet",
        root=Path(),
        names=names,
        photos=tuple(Path(f"{name}.jpg") for name in names),
        lenses=(LENS,) * len(names),
        poses=tuple(tuple(pose.ravel().tolist()) for pose in poses),
        metric=metric,
        **more,
    )


def taken(scene: SceneFiles, most=100, motion=0.04) -> list[int]:
    return [int(name) for name in thinned(scene, most, motion, "capture.max_views").names]


def test_views_are_taken_by_how_far_the_camera_moves_and_not_by_their_number():
    still, turning = np.zeros(300), np.linspace(0, 2, 300)
    scene = recording(np.concatenate([still, turning]), np.zeros(600))
    views = taken(scene)
    assert views == sorted(views) and sum(view < 300 for view in views) <= 1
    # 2 radians are 1.25 diagonals; farthest points on a line lie between one and two times the motion apart.
    angles = np.concatenate([still, turning])[views]
    assert 1.25 / 0.08 < len(views) < 1.25 / 0.04
    assert FOCAL * np.diff(angles).max() < 1.5 * 2 * 0.04
    stepping = recording(np.zeros(600), 1.5 * np.concatenate([still, turning]))
    assert len(taken(stepping)) == pytest.approx(len(views), abs=2)


def test_what_a_recording_comes_back_to_is_not_taken_twice():
    way = np.linspace(0, 1.5, 300)
    once, there_and_back = recording(way, 0 * way), recording([*way, *way[::-1]], np.zeros(600))
    assert len(taken(there_and_back)) == len(taken(once))


def test_the_most_views_are_spread_over_the_whole_recording_and_the_remark_says_how_far_apart():
    way = np.linspace(0, 6, 1000)
    scene = recording(way, 0 * way)
    few = thinned(scene, 25, 0.04, "capture.max_views")
    views = [int(name) for name in few.names]
    assert len(views) == 25
    apart = FOCAL * np.abs(way[:, None] - way[views]).min(axis=1).max()
    assert apart < 1.5 * FOCAL * 6 / 24
    assert few.remarks == (
        "25 of 1000 views are used: the picture of each other one is that of one of these, moved by at most "
        f"{100 * apart:.2g} % of its diagonal. --set capture.max_views=1000 uses all of them.",
    )


def test_all_that_belongs_to_a_view_stays_with_it_and_views_left_out_before_stay_told():
    way = np.linspace(0, 2, 300)
    scene = recording(way, 0 * way)
    names = scene.names
    lost = replace(scene.pick([i for i in range(300) if i != 7]), skipped=("0007",), all_names=names)
    few = thinned(lost, 100, 0.04, "capture.max_views")
    assert [photo.stem for photo in few.photos] == [*few.names] and len(few.poses) == len(few.lenses) == len(few.names)
    assert few.skipped == ("0007",) and set(few.all_names) == {*few.names, "0007"}


def test_short_captures_those_without_poses_and_all_if_asked_stay_as_they_are():
    scene = recording(np.zeros(100), np.zeros(100))
    for same, most in ((scene, 100), (scene, 0), (replace(scene, poses=None), 10)):
        assert thinned(same, most, 0.04, "capture.max_views") is same
    assert len(taken(scene, most=99)) == 20  # a camera that stands still


def test_near_by_the_view_is_taken_at_which_the_camera_moves_least():
    # A camera that turns in jerks: it rests at every tenth view, and is fast in between.
    way = np.arange(400) / 10 * 0.1
    scene = recording(np.round(way / 0.1) * 0.1 + 0.03 * np.sin(2 * np.pi * way / 0.1), np.zeros(400))
    angles = np.array([np.arctan2(pose[2], pose[0]) for pose in scene.poses])
    speed = np.abs(np.gradient(np.unwrap(angles)))
    assert np.median(speed[taken(scene, most=60)]) < np.median(speed) / 1.5


def test_views_with_clicks_are_taken_and_those_with_ground_truth_first():
    way = np.linspace(0, 2, 400)
    truth = [Path(f"{i}.png") if i in (33, 34, 211) else None for i in range(400)]
    scene = recording(way, 0 * way, ground_truth=tuple(truth))
    views = taken(scene)
    assert 211 in views and {33, 34} & {*views} and {101, 102} - {*views}
    clicks = Hints(Path("hints.json"), ("mug",), tuple(Hint(f"{i:04d}", 1, ((1, 1),), ()) for i in (101, 102)))
    assert (
        taken(replace(scene, hints=clicks)) == sorted({101, 102, *views}) == taken(replace(scene, corrections=clicks))
    )
    few = thinned(scene, 100, 0.04, "capture.max_views")
    assert few.ground_truth[few.names.index("0211")] == Path("211.png")
    assert len(views) < 1.25 / 0.04 + 20  # and 34, whose picture is that of 33, only as one of the fewest


@pytest.mark.parametrize("scale", [0.01, 1000])
def test_where_lengths_are_no_metres_the_cameras_tell_how_far_off_things_are(scale):
    # Round a thing: a step of the camera counts as much as its turn.
    angles = np.linspace(0, 2 * np.pi, 500, endpoint=False)

    def round_a_thing(radius, metric):
        scene = recording(angles, 0 * angles, metric)
        poses = scene.world_to_camera
        poses[:, :3, 3] = [0, 0, radius]
        return replace(scene, poses=tuple(tuple(pose.ravel().tolist()) for pose in poses))

    assert np.allclose(np.linalg.norm(centers_of(round_a_thing(scale, False).world_to_camera), axis=1), scale)
    assert len(taken(round_a_thing(scale, False))) == pytest.approx(len(taken(round_a_thing(1.5, True))), abs=1)


@pytest.mark.parametrize("scale", [2.0**-10, 2.0**10])
def test_where_lengths_are_no_metres_the_same_views_are_taken_whatever_the_unit(scale):
    # It turns in jerks and walks in jerks, at other times: which of both counts more tells where it is steadiest.
    rng = np.random.default_rng(0)
    turns, steps = np.cumsum(rng.exponential(0.01, (2, 500)) ** 2 * 40, axis=1)
    scene = recording(turns, np.zeros(500), metric=False)
    places = np.stack([steps, np.sqrt(steps), 0 * steps], axis=1)

    def taken_at(size):
        poses = scene.world_to_camera.copy()
        poses[:, :3, 3] = -np.einsum("kij,kj->ki", poses[:, :3, :3], size * places)
        return taken(replace(scene, poses=tuple(tuple(pose.ravel().tolist()) for pose in poses)))

    assert taken_at(scale) == taken_at(1.0)


@pytest.mark.parametrize("preset, count", [("default", 20), ("fast", 20), ("paper", 301), ("reference", 301)])
def test_a_run_takes_all_of_300_views_and_thins_more_unless_its_preset_is_the_papers(preset, count, tmp_path):
    root = made.nerfstudio(tmp_path / "capture")
    params, digests = settings.preset(Params(), preset), file_digests(Store(tmp_path / "store"))
    whole = open_scene(root)
    many = whole.pick([0] * 301)
    many = replace(many, names=tuple(f"{i:04d}" for i in range(301)), all_names=())
    assert len(prepare(many, params, RunOptions(), digests).scene.names) == count
    assert len(prepare(many.pick([*range(300)]), params, RunOptions(), digests).scene.names) == 300
    every_second = settings.apply(params, ["capture.stride=2"])
    assert prepare(many, every_second, RunOptions(), digests).scene.names == many.names[::2]
