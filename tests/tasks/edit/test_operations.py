"""Each operation on a small scene of three instances."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Cameras, EditedScene, Gaussians
from ss_flow.tasks.deliver.compressed import decompressed
from ss_flow.tasks.deliver.ply import write_gaussians
from ss_flow.tasks.edit import operations
from ss_flow.tasks.edit.operations import Motion
from ss_flow.tasks.edit.pictures import before_and_after
from ss_flow.tasks.gaussians.initialise import SH_ZERO, select
from ss_flow.tasks.gaussians.read_ply import read_columns
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.shape import box_diagonal


def scene_of(count: int = 60, degree: int = 3, seed: int = 0) -> EditedScene:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    return operations.begin(
        Gaussians(
            means=rng.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
            quaternions=(q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32),
            log_scales=rng.uniform(-4, -2, (count, 3)).astype(np.float32),
            opacity_logits=rng.uniform(-1, 3, count).astype(np.float32),
            sh=(0.3 * rng.normal(size=(count, (degree + 1) ** 2, 3))).astype(np.float32),
            instance_id=np.sort(np.arange(count) % 3).astype(np.int32),
            instance_conf=rng.random(count).astype(np.float32),
            part_id=rng.integers(0, 3, count).astype(np.int32),
        )
    )


def same(a: EditedScene, b: EditedScene) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(EditedScene))


def others(scene: EditedScene, *ids: int) -> EditedScene:
    return select(scene, ~np.isin(scene.instance_id, ids))


def camera_at(world_to_camera: np.ndarray) -> Camera:
    return Camera(64, 48, 60.0, 60.0, 32.0, 24.0, world_to_camera)


NO_TURN = ((0.0, 0.0, 1.0), 0.0)
POSE = np.eye(4)
POSE[2, 3] = 2.0


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("scale", [1.0, 0.4, 2.5])
def test_a_moved_scene_looks_from_a_moved_camera_as_it_did_before(degree, scale):
    scene = scene_of(degree=degree)
    turn, shift, pivot = (
        Rotation.from_rotvec(np.radians(130) * np.array([0.6, 0.0, 0.8])),
        (0.3, -0.2, 0.5),
        (0.1, 0, 0),
    )
    motion = Motion(move=shift, axis=(1.2, 0.0, 1.6), degrees=130, scale=scale, pivot=pivot)
    after = operations.transform(scene, instances=(0, 1, 2), motion=motion)
    # x = pivot + s R (x0 - pivot) + move; a camera that goes along sees s times its old coordinates.
    rotation = turn.as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = POSE[:3, :3] @ rotation.T
    pose[:3, 3] = scale * (POSE[:3, :3] @ pivot + POSE[:3, 3]) - pose[:3, :3] @ (np.array(pivot) + shift)
    old, new = render(scene, camera_at(POSE)), render(after, camera_at(pose))
    assert old.alpha.max() > 0.5
    np.testing.assert_allclose(new.rgb, old.rgb, atol=2e-4)
    np.testing.assert_allclose(new.depth, scale * old.depth, atol=2e-4 * max(1, scale))


def test_without_the_turn_of_the_colours_it_would_look_different():
    scene = scene_of()
    turned = operations.transform(scene, instances=(0, 1, 2), motion=Motion(degrees=90.0, axis=(1, 0, 0)))
    assert np.abs(turned.sh - scene.sh).max() > 0.1
    assert np.array_equal(turned.sh[:, 0], scene.sh[:, 0])


def test_rows_of_other_instances_stay_as_they_are_to_the_bit():
    scene = scene_of()
    for after in (
        operations.remove(scene, instances=(1,)),
        operations.transform(scene, instances=(1,), motion=Motion(degrees=20.0, scale=2.0, move=(1, 0, 0))),
        operations.recolour(scene, instances=(1,), color=(10, 200, 30)),
        operations.duplicate(scene, instance=1, new_id=9, motion=Motion(move=(1, 0, 0))),
    ):
        assert same(others(after, 1, 9), others(scene, 1))


def test_removing_and_keeping_are_each_others_complement():
    scene = scene_of()
    assert same(operations.remove(scene, instances=(0, 2)), operations.keep(scene, instances=(1,)))


def test_a_copy_has_the_new_id_and_lies_where_it_was_moved():
    scene = scene_of()
    after = operations.duplicate(scene, instance=2, new_id=7, motion=Motion(move=(0.0, 0.0, 1.5)))
    old, new = select(after, after.instance_id == 2), select(after, after.instance_id == 7)
    np.testing.assert_allclose(new.means, old.means + np.array([0, 0, 1.5]), atol=1e-6)
    assert same(replace(new, means=old.means, instance_id=old.instance_id), old)


@given(degrees=st.floats(-360, 360), scale=st.floats(0.1, 10))
def test_about_its_own_centre_an_object_stays_where_it_is(degrees, scale):
    scene = scene_of(30)
    own = scene.instance_id == 1
    after = operations.transform(scene, instances=(1,), motion=Motion(degrees=degrees, scale=scale, axis=(0, 1, 1)))
    np.testing.assert_allclose(after.means[own].mean(axis=0), scene.means[own].mean(axis=0), atol=1e-5 * max(1, scale))


def test_a_recoloured_object_has_the_colour_on_the_mean_and_keeps_its_light_and_shade():
    scene = scene_of(degree=0)
    after = operations.recolour(scene, instances=(1,), color=(30, 90, 210))
    own = scene.instance_id == 1
    before, now = (0.5 + SH_ZERO * s.sh[own, 0].astype(float) for s in (scene, after))
    weights = scene.opacities[own] * np.exp(np.sort(scene.log_scales[own], axis=1)[:, 1:].sum(axis=1))
    luma = before @ (0.2126, 0.7152, 0.0722)
    mean = (luma * weights).sum() / weights.sum()
    np.testing.assert_allclose(now, luma[:, None] / mean * np.array([30, 90, 210]) / 255, atol=1e-5)


def test_a_black_object_becomes_evenly_coloured():
    scene = scene_of(degree=1)
    black = np.zeros_like(scene.sh)
    black[:, 0] = -0.5 / SH_ZERO
    after = operations.recolour(replace(scene, sh=black), instances=(0, 1, 2), color=(255, 0, 51))
    np.testing.assert_allclose(0.5 + SH_ZERO * after.sh[:, 0], np.tile([1, 0, 0.2], (len(scene), 1)), atol=1e-6)
    assert not after.sh[:, 1:].any()


def test_another_object_takes_the_place_and_the_size_of_the_one_it_replaces(tmp_path):
    scene = scene_of(90)
    other = select(scene_of(40, seed=5), np.ones(40, bool))
    write_gaussians(tmp_path / "other.ply", replace(other, means=other.means * 7 + 3), labelled=True)
    read = operations.read_object(file=FileRef(tmp_path / "other.ply", ""))
    after = operations.put_in_place(scene, read, instance=1, new_id=8, scale=None, turn=NO_TURN)
    old, new = scene.means[scene.instance_id == 1], after.means[after.instance_id == 8]
    assert len(new) == 40 and not (after.instance_id == 1).any()
    np.testing.assert_allclose(new.mean(axis=0), old.mean(axis=0), atol=1e-5)
    diagonals = [np.linalg.norm(np.ptp(np.quantile(m, (0.005, 0.995), axis=0), axis=0)) for m in (old, new)]
    assert diagonals[0] == pytest.approx(diagonals[1], rel=1e-5)
    kept = operations.put_in_place(scene, read, instance=1, new_id=8, scale=1.0, turn=NO_TURN)
    own = kept.means[kept.instance_id == 8]
    np.testing.assert_allclose(own - own.mean(axis=0), read.means - read.means.mean(axis=0), atol=1e-5)


@pytest.mark.parametrize("there", [(0.0, -1.0, 0.0), (0.6, 0.0, 0.8), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
def test_an_object_from_a_world_whose_up_is_another_is_put_upright(there):
    scene, other = scene_of(90, degree=0), scene_of(60, seed=5, degree=0)
    here = (0.0, 0.0, 1.0)
    turn = operations.smallest_turn(there, here)
    after = operations.put_in_place(scene, other, instance=1, new_id=8, scale=1.0, turn=turn)
    own = select(after, after.instance_id == 8)
    heights = (other.means - other.means.mean(axis=0)) @ np.array(there)
    np.testing.assert_allclose((own.means - own.means.mean(axis=0)) @ np.array(here), heights, atol=1e-5)
    turned = (
        Rotation.from_quat(own.quaternions, scalar_first=True)
        * Rotation.from_quat(other.quaternions, scalar_first=True).inv()
    )
    np.testing.assert_allclose(turned.apply(there), np.tile(here, (len(own), 1)), atol=1e-5)
    fitted = operations.put_in_place(scene, other, instance=1, new_id=8, scale=None, turn=turn)
    diagonals = [
        np.linalg.norm(np.ptp(np.quantile(m, (0.005, 0.995), axis=0), axis=0))
        for m in (scene.means[scene.instance_id == 1], fitted.means[fitted.instance_id == 8])
    ]
    assert diagonals[0] == pytest.approx(diagonals[1], rel=1e-4)


@pytest.mark.parametrize(("single", "by"), [(1, 2), (1, 1)])
def test_a_single_gaussian_is_replaced_and_replaces_by_its_own_size(single, by):
    scene = scene_of()
    rows = np.flatnonzero(scene.instance_id == single)
    scene = select(scene, ~np.isin(np.arange(len(scene)), rows[1:]))
    other = select(scene, scene.instance_id == by)
    after = operations.put_in_place(scene, other, instance=3 - by, new_id=8, scale=None, turn=NO_TURN)
    new, old = after.instance_id == 8, scene.instance_id == 3 - by
    alone = np.exp(scene.log_scales[scene.instance_id == single].max())
    if by == single:
        assert np.exp(after.log_scales[new].max()) == pytest.approx(box_diagonal(scene.means[old]), rel=1e-5)
    else:
        assert box_diagonal(after.means[new]) == pytest.approx(alone, rel=1e-5)


def test_a_file_without_gaussians_replaces_nothing(tmp_path):
    write_gaussians(tmp_path / "none.ply", select(scene_of(), np.zeros(60, bool)), labelled=True)
    with pytest.raises(InputError, match="holds no Gaussians"):
        operations.read_object(file=FileRef(tmp_path / "none.ply", ""))


def test_relabelling_there_and_back_gives_the_same_scene():
    scene = scene_of()
    there = operations.relabel(scene, rows=((1, 0, 5, 0), (1, 1, 5, 1), (1, 2, 6, 0)))
    assert set(np.unique(there.instance_id)) == {0, 2, 5, 6}
    assert same(operations.relabel(there, rows=((5, 0, 1, 0), (5, 1, 1, 1), (6, 0, 1, 2))), scene)


def test_ids_can_change_places_in_one_relabelling():
    scene = scene_of()
    pairs = [(i, p, {1: 2, 2: 1}[i], p) for i in (1, 2) for p in range(3)]
    after = operations.relabel(scene, rows=tuple(pairs))
    assert np.array_equal(after.instance_id == 1, scene.instance_id == 2)


def test_only_a_scene_with_filled_gaussians_has_the_column_that_says_so(tmp_path):
    scene = scene_of()
    write_gaussians(tmp_path / "a.ply", scene, labelled=True)
    assert "filled" not in read_columns(tmp_path / "a.ply").dtype.names
    flags = np.arange(len(scene)) % 2
    write_gaussians(tmp_path / "b.ply", replace(scene, filled=flags.astype(np.uint8)), labelled=True)
    assert np.array_equal(read_columns(tmp_path / "b.ply")["filled"], flags)


def test_pictures_show_the_three_views_that_changed_most_before_on_the_left_and_after_on_the_right():
    before = scene_of()
    after = operations.remove(before, instances=(1,))
    away = np.diag([-1.0, 1.0, -1.0, 1.0])  # looks the other way: nothing to be seen
    poses = [POSE if shows else away for shows in (False, True, True, False, True)] + [POSE.copy()]
    poses[5][2, 3] = 9.0  # far off
    k = len(poses)
    cameras = Cameras(
        tuple("abcdef"), np.tile(np.int32([64, 48]), (k, 1)), np.tile([60.0, 60, 32, 24], (k, 1)), np.array(poses), True
    )
    found = before_and_after(before, after, cameras)
    assert [picture.name for picture in found] == [f"{name}: before and after" for name in "bce"]
    shown = np.concatenate([render(scene, camera_at(POSE)).rgb for scene in (before, after)], axis=1)
    assert np.abs(decompressed(found[0].content) / 255 - shown.clip(0, 1)).mean() < 0.02
    assert before_and_after(before, select(after, np.zeros(len(after), bool)), cameras) == ()
