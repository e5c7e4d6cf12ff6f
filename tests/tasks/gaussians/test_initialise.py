"""Gaussians made of points, joined and picked."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.gaussians.densification import rotations
from ss_flow.tasks.gaussians.initialise import concatenate, initialise, laid_flat, select, with_sh_degree


def test_initial_scales_are_the_root_mean_square_of_three_neighbours():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    made = initialise(points, np.full((4, 3), 255, np.uint8), 7, 0.25)
    assert np.exp(made.log_scales[0]) == pytest.approx([np.sqrt(14 / 3)] * 3)
    assert 1 / (1 + np.exp(-made.opacity_logits[0])) == pytest.approx(0.1)
    assert made.sh[0, 0] * 0.28209479 + 0.5 == pytest.approx([1, 1, 1])
    assert made.part_id.tolist() == [0] * 4
    assert initialise(points, np.zeros((4, 3), np.uint8), 7, 0.25, np.arange(4)).part_id.tolist() == [0, 1, 2, 3]
    lone = initialise(points[:1], np.zeros((1, 3), np.uint8), 7, 0.25)
    assert np.exp(lone.log_scales[0]) == pytest.approx([0.01] * 3)


def test_joining_fills_colours_of_lower_degree_and_picking_undoes_it():
    three = initialise(np.ones((3, 3), np.float32), np.zeros((3, 3), np.uint8), 2, 1.0)
    five = np.random.default_rng(0).random((5, 3)).astype(np.float32)
    low, high = initialise(five, np.zeros((5, 3), np.uint8), 4, 0.5), with_sh_degree(three, 2)
    both = concatenate([low, high])
    assert both.sh.shape == (8, 9, 3) and both.instance_id.tolist() == [4] * 5 + [2] * 3
    assert np.array_equal(select(both, both.instance_id == 4).means, low.means)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0), (0.3, -0.5, -0.8)])
def test_discs_lie_in_the_surface(normal):
    normal = np.array(normal) / np.linalg.norm(normal)
    across = np.linalg.svd(normal[None])[2][1:]
    points = (np.random.default_rng(0).random((200, 2)) @ across).astype(np.float32)
    round_ = initialise(points, np.zeros((200, 3), np.uint8), 3, 1.0)
    flat = laid_flat(round_, 0.1)
    axes, scales = rotations(flat.quaternions), np.exp(flat.log_scales)
    np.testing.assert_allclose(np.abs(axes[:, :, 2] @ normal), 1, atol=1e-5)
    np.testing.assert_allclose(scales[:, 2], 0.1 * scales[:, 0], rtol=1e-5)
    np.testing.assert_array_equal(flat.log_scales[:, :2], round_.log_scales[:, :2])
    few = laid_flat(select(round_, np.arange(3)), 0.1)
    np.testing.assert_array_equal(few.log_scales, round_.log_scales[:3])


def test_discs_on_a_ball_point_outwards():
    around = np.random.default_rng(1).normal(size=(2000, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    flat = laid_flat(initialise(around.astype(np.float32), np.zeros((2000, 3), np.uint8), 3, 1.0), 0.2)
    outwards = np.abs(np.einsum("nd,nd->n", rotations(flat.quaternions)[:, :, 2], around))
    assert np.median(outwards) > 0.99 and (outwards > 0.9).mean() > 0.98
