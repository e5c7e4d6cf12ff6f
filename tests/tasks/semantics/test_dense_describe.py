"""Vectors of single Gaussians: with an encoder that is known, and DINOv2's way with a network of its signature."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_gaussians import made_cameras, made_gaussians
from random_networks import dino_like

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import FROM_NEIGHBOURS, FROM_PICTURES, NO_VECTOR, Gaussians
from ss_flow.tasks.gaussians.initialise import SH_ZERO, select
from ss_flow.tasks.geometry.cameras import project
from ss_flow.tasks.models.catalogue import Model, ModelFile
from ss_flow.tasks.models.patches import DinoV2
from ss_flow.tasks.semantics import dense_describe as step
from ss_flow.tasks.semantics.dense_describe import DenseDescribeParams, apart, around, dense_describe, together

FEW = DenseDescribeParams(elevations=2, azimuths=4, side=112)
LENGTH = 6


class Colours:
    """The vector of a patch is its mean colour; patches are 4 pixels wide."""

    def encode(self, rgb):
        side = len(rgb) // 4
        return rgb.reshape(side, 4, side, 4, 3).mean(axis=(1, 3)).astype(np.float32) / 255


@pytest.fixture
def network(tmp_path: Path) -> Model:
    file = ModelFile("network", FileRef(dino_like(tmp_path / "model.onnx", LENGTH), str(tmp_path)))
    return Model("random-dino", "patch-features", (file,), (("patch", 14.0),), ())


def block(shift: float = 0.0, instance_id: int = 1) -> Gaussians:
    """A solid of small opaque balls, red on one side of x = shift and blue on the other, with one in its inside."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, 10)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    shell = grid[np.abs(grid).max(axis=1) > 0.89]
    means = np.concatenate([shell, [[0.35, 0.03, 0.07]]])
    count = len(means)
    colour = np.where(means[:, :1] > 0, (1.0, 0, 0), (0, 0, 1.0))
    plain = made_gaussians(count, 0)
    return replace(
        plain,
        means=(means + np.array([shift, 0, 0])).astype(np.float32),
        log_scales=np.full((count, 3), np.log(0.1), np.float32),
        opacity_logits=np.full(count, 20, np.float32),
        sh=((colour - 0.5) / SH_ZERO)[:, None].astype(np.float32),
        instance_id=np.full(count, instance_id, np.int32),
    )


def test_views_lie_on_a_half_sphere_and_show_the_whole_object():
    own, cameras = block(shift=3.0), made_cameras()
    views = around(own, cameras, DenseDescribeParams())
    assert len(views) == 72
    centers = np.array([view.center for view in views])
    middle = own.means.mean(axis=0, dtype=np.float64)
    distances = np.linalg.norm(centers - middle, axis=1)
    np.testing.assert_allclose(distances, distances[0])
    up = -cameras.world_to_camera[:, 1, :3].mean(axis=0)
    assert ((centers - middle) @ up > -1e-6).all() and len(np.unique(centers.round(6), axis=0)) == 72
    for view in views:
        uv, z = project(own.means, view)
        assert (z > 0).all() and (uv > 0).all() and (uv < view.width).all()
        np.testing.assert_allclose(project(middle[None], view)[0], [[280, 280]], atol=1e-3)


def test_what_is_smaller_than_the_near_plane_gets_the_vectors_that_it_gets_when_it_is_large(monkeypatch):
    monkeypatch.setattr(step, "patch_encoder_of", lambda model: Colours())
    own, named = block(), Model("colours", "patch-features", (), (), ())
    small = replace(own, means=own.means * np.float32(1e-3), log_scales=own.log_scales + np.float32(np.log(1e-3)))
    large, tiny = (dense_describe(one, made_cameras(), network=named, params=FEW) for one in (own, small))
    assert (tiny.origin != NO_VECTOR).all()
    shell = large.origin == FROM_PICTURES
    np.testing.assert_allclose(tiny.features[shell], large.features[shell], atol=0.15)


def test_views_of_two_photos_with_opposite_ups_are_still_cameras():
    upright = made_cameras(((0, -3, 0),) * 2)
    poses = upright.world_to_camera.copy()
    poses[1, :2] *= -1
    views = around(block(), replace(upright, world_to_camera=poses), DenseDescribeParams())
    for view in views:
        rotation = view.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_a_gaussian_gets_what_the_patches_show_where_it_is(monkeypatch, network):
    monkeypatch.setattr(step, "patch_encoder_of", lambda model: Colours())
    own = block()
    found = dense_describe(own, made_cameras(), network=network, params=FEW)
    assert found.features.shape == (len(own), 3) and found.network == "random-dino"
    red, blue = own.means[:, 0] > 0.5, own.means[:, 0] < -0.5
    seen = found.origin == FROM_PICTURES
    assert seen[red].mean() > 0.6 and seen[blue].mean() > 0.6
    assert (found.features[red & seen, 0] > found.features[red & seen, 2]).all()
    assert (found.features[blue & seen, 2] > found.features[blue & seen, 0]).all()


def test_what_no_picture_shows_gets_its_neighbours_mean_and_is_flagged(monkeypatch, network):
    monkeypatch.setattr(step, "patch_encoder_of", lambda model: Colours())
    own = block()
    found = dense_describe(own, made_cameras(), network=network, params=FEW)
    inside = len(own) - 1
    assert found.origin[inside] == FROM_NEIGHBOURS
    seen = np.flatnonzero(found.origin == FROM_PICTURES)
    nearest = seen[np.argsort(np.linalg.norm(own.means[seen] - own.means[inside], axis=1), kind="stable")[:5]]
    np.testing.assert_allclose(found.features[inside], found.features[nearest].mean(axis=0), atol=1e-6)


@pytest.mark.parametrize(("opacity", "origin"), [(0.7, FROM_PICTURES), (0.3, NO_VECTOR)])
def test_a_pixel_that_is_not_covered_by_half_shows_the_grey_around(monkeypatch, network, opacity, origin):
    monkeypatch.setattr(step, "patch_encoder_of", lambda model: Colours())
    logit = np.log(opacity / (1 - opacity))
    alone = select(replace(block(), opacity_logits=np.full(len(block()), logit, np.float32)), [0])
    assert dense_describe(alone, made_cameras(), network=network, params=FEW).origin.tolist() == [origin]


def test_vectors_are_averaged_in_each_picture_and_then_over_pictures():
    """Two patches side by side; the Gaussian 0 wins the three pixels on the left, 1 the one on the right."""
    top = np.array([[0, 0, 0, 1]], np.int32)
    means = step._assignment(top, np.ones((1, 4), bool), 3, (1, 2)).toarray()
    # Pixel centres lie at 0.5 to 3.5, patch centres at 1 and 3: a quarter of the third pixel is the second patch's.
    np.testing.assert_allclose(means, [[(1 + 0.75 + 0.25) / 3, (0.25 + 0.75) / 3], [0, 1], [0, 0]])


def test_the_whole_way_with_a_network_of_dinos_signature(network):
    found = dense_describe(block(), made_cameras(), network=network, params=FEW)
    again = dense_describe(block(), made_cameras(), network=network, params=FEW)
    assert found.features.shape[1] == LENGTH and np.isfinite(found.features).all()
    np.testing.assert_array_equal(found.features, again.features)
    red, blue = (found.features[(block().means[:, 0] * sign) > 0.8] for sign in (1, -1))
    between = np.linalg.norm(red.mean(axis=0) - blue.mean(axis=0))
    assert between > 2 * red.std(axis=0).mean()  # the two sides do not look alike


def test_patches_stand_where_they_are_in_the_picture(network):
    picture = np.zeros((56, 56, 3), np.uint8)
    picture[:14, 42:] = 255
    encoder = DinoV2(network)
    patches = encoder.encode(picture)
    assert patches.shape == (4, 4, LENGTH)
    other = np.abs(patches - patches[3, 0]).sum(axis=2) > 1e-3
    assert np.argwhere(other).tolist() == [[0, 3]]
    # A picture of another size is scaled to the nearest count of whole patches.
    assert encoder.encode(np.zeros((60, 60, 3), np.uint8)).shape == (4, 4, LENGTH)


def test_a_network_that_gives_too_few_vectors_is_refused(network):
    few = replace(network, parameters=(("patch", 7.0),))
    with pytest.raises(InputError, match="it is no DINOv2"):
        DinoV2(few).encode(np.zeros((56, 56, 3), np.uint8))


def test_the_scene_has_a_vector_in_each_row_of_its_instances(monkeypatch, network):
    monkeypatch.setattr(step, "patch_encoder_of", lambda model: Colours())
    parts = [block(shift=x, instance_id=i) for x, i in ((-2.0, 4), (0.0, 0), (2.0, 2))]
    arrays = {name: np.concatenate([getattr(p, name) for p in parts]) for name in vars(parts[0])}
    mixed = np.random.default_rng(0).permutation(len(arrays["means"]))
    scene = select(Gaussians(**arrays), mixed)
    alone = apart(scene)
    assert [set(own.instance_id.tolist()) for own in alone] == [{2}, {4}]
    described = tuple(dense_describe(own, made_cameras(), network=network, params=FEW) for own in alone)
    whole = together(scene, described, network=network.name)
    for own, of_one in zip(alone, described, strict=True):
        rows = scene.instance_id == own.instance_id[0]
        np.testing.assert_array_equal(scene.means[rows], own.means)
        np.testing.assert_array_equal(whole.features[rows], of_one.features)
    background = scene.instance_id == 0
    assert (whole.origin[background] == NO_VECTOR).all() and not whole.features[background].any()
    without = together(scene, described[:1], network=network.name)  # an instance that failed
    assert (without.origin[scene.instance_id == 4] == NO_VECTOR).all()
