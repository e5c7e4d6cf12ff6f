"""Spherical harmonics of the colour, and how they turn."""

from __future__ import annotations

import gaussian_reference as reference
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ss_flow.tasks.gaussians.harmonics import basis, rotated


def directions(count: int, seed: int = 0) -> np.ndarray:
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_basis_is_that_of_the_reference(degree):
    d = directions(50)
    np.testing.assert_allclose(basis(degree, d), reference.sh_basis(degree, torch.from_numpy(d)).numpy(), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_turned_colour_is_the_old_one_seen_from_the_turned_back_direction(degree):
    rng = np.random.default_rng(degree)
    sh = rng.normal(size=(7, (degree + 1) ** 2, 3)).astype(np.float32)
    rotation = Rotation.random(random_state=degree).as_matrix()
    d = directions(40, seed=1)
    after = np.einsum("mk,nkc->nmc", basis(degree, d), rotated(sh, rotation).astype(np.float64))
    before = np.einsum("mk,nkc->nmc", basis(degree, d @ rotation), sh.astype(np.float64))
    np.testing.assert_allclose(after, before, atol=3e-6)


def test_a_quarter_turn_about_z_takes_x_to_y_in_degree_1():
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 3] = 1  # the function of -x
    turned = rotated(sh, Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix())
    expected = np.zeros((1, 4, 3))
    expected[0, 1] = 1  # the function of -y
    np.testing.assert_allclose(turned, expected, atol=1e-7)


def test_turning_there_and_back_gives_the_same_coefficients():
    sh = np.random.default_rng(0).normal(size=(5, 16, 3)).astype(np.float32)
    rotation = Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix()
    np.testing.assert_allclose(rotated(rotated(sh, rotation), rotation.T), sh, atol=2e-6)
