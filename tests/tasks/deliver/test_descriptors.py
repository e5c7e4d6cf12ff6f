"""Vectors of Gaussians in the output folder."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from made_gaussians import made_cameras, made_gaussians

from ss_flow.tasks.artifacts import FROM_PICTURES, NO_VECTOR, DenseDescriptors
from ss_flow.tasks.deliver.descriptors import descriptor_picture, principal_colours, write_descriptors
from ss_flow.tasks.gaussians.initialise import select


def made(count: int, seed: int = 0) -> DenseDescriptors:
    scene = made_gaussians(count, 0, seed)
    origin = np.where(scene.instance_id == 0, NO_VECTOR, FROM_PICTURES).astype(np.uint8)
    features = np.random.default_rng(seed).normal(0, 1, (count, 5)).astype(np.float32) * (5, 4, 3, 0.1, 0.1)
    return DenseDescriptors(scene.instance_id, (features * (origin > 0)[:, None]).astype(np.float32), origin, "made")


def test_the_numbers_are_read_back_in_the_order_of_the_ply(tmp_path):
    dense = made(300)
    write_descriptors(tmp_path, made_gaussians(300, 0), dense, made_cameras())
    with np.load(tmp_path / "descriptors.npz", allow_pickle=False) as read:
        np.testing.assert_allclose(read["features"], dense.features, rtol=1e-3, atol=1e-6)
        np.testing.assert_array_equal(read["origin"], dense.origin)
        np.testing.assert_array_equal(read["instance_id"], dense.instance_id)
        assert str(read["network"]) == "made"
    picture = cv2.imread(str(tmp_path / "descriptors.png"))
    assert picture.shape == (96, 2 * 96, 3) and picture.std() > 10


def test_the_same_vectors_give_the_same_bytes(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        write_descriptors(tmp_path / name, made_gaussians(300, 0), made(300), made_cameras())
    for file in ("descriptors.npz", "descriptors.png"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_views_of_another_shape_are_not_stretched():
    ball = select(made_gaussians(3, 0), np.arange(1))
    ball = replace(
        ball, means=0 * ball.means, log_scales=0 * ball.log_scales - 1.5, opacity_logits=0 * ball.means[:, 0] + 5
    )
    cameras = made_cameras()
    cameras = replace(cameras, sizes=np.array([[96, 60], [60, 96]], np.int32))
    cameras = replace(cameras, intrinsics=np.concatenate([cameras.intrinsics[:, :2], cameras.sizes / 2], axis=1))
    dense = DenseDescriptors(ball.instance_id, np.zeros((1, 5), np.float32), np.zeros(1, np.uint8), "made")
    picture = descriptor_picture(ball, dense, cameras)
    assert picture.shape == (60, 2 * 96, 3)
    for shown in (picture[:, :96], picture[:, 96:]):
        wide, high = (np.count_nonzero(shown.max(axis=(axis, 2)) > 40) for axis in (0, 1))
        assert wide == high > 8


def test_colours_are_the_directions_in_which_the_vectors_differ_most():
    dense = made(2000)
    colours = principal_colours(dense)
    known = dense.origin > 0
    for axis in range(3):  # the columns were made 5, 4 and 3 wide, and the others narrow
        along = np.corrcoef(colours[known, axis], dense.features[known, axis])[0, 1]
        assert along > 0.9
    assert (np.ptp(colours[~known], axis=0) == 0).all()


def test_a_turned_axis_changes_no_colour():
    dense = made(500)
    turned = replace(dense, features=dense.features[:, [0, 1, 2, 4, 3]])
    np.testing.assert_allclose(principal_colours(turned), principal_colours(dense), atol=1e-4)


def test_without_vectors_all_is_grey():
    dense = made(50)
    bare = replace(dense, features=np.zeros((50, 0), np.float32), origin=np.full(50, NO_VECTOR, np.uint8))
    assert (np.ptp(principal_colours(bare), axis=0) == 0).all()
