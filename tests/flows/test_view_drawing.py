"""How artifacts are drawn in a scene of viser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.results import Results
from ss_flow.flows.view.drawing import (
    Around,
    add_gaussians,
    add_points,
    agreement_colors,
    draw,
    is_spatial,
    label_colors,
)
from ss_flow.flows.view.looking import start_view, view_of_object
from ss_flow.flows.view.nodes import _colors
from ss_flow.tasks.artifacts import Metrics
from ss_flow.tasks.gaussians.densification import rotations
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.geometry.cameras import camera_extent, camera_of, cameras_by_view, pixels_in_view

viser = pytest.importorskip("viser", reason="needs the extra `view`")


@pytest.fixture(scope="module")
def server():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def scene(server):
    server.scene.reset()
    return server.scene


@pytest.fixture(scope="module")
def results(tiny) -> Results:
    return Results(Store(Path(tiny.store)), tiny.called.results())


@pytest.fixture(scope="module")
def around(results) -> Around:
    return Around(results.all("ingest"), results.one("cameras"), results.one("dense"))


@pytest.mark.parametrize("unit", [1.0, 1e-4, 1e4])
def test_splats_keep_their_place_and_shape_whatever_the_unit_of_the_scene(scene, results, unit):
    """Decoded as the browser decodes them: centres as float32, covariances as float16, under the node's scale."""
    own = results.one("scene")
    gaussians = replace(own, means=own.means * np.float32(unit), log_scales=own.log_scales + np.float32(np.log(unit)))
    node = add_gaussians(scene, "/scene", gaussians)
    centers = np.ascontiguousarray(node.buffer[:, :3]).view(np.float32) * node.scale
    np.testing.assert_allclose(centers, gaussians.means, rtol=1e-5, atol=1e-6 * unit)
    upper = np.ascontiguousarray(node.buffer[:, 4:7]).view(np.float16).astype(np.float64) * node.scale**2
    axes = rotations(gaussians.quaternions) * np.exp(gaussians.log_scales.astype(np.float64))[:, None]
    wanted = (axes @ axes.transpose(0, 2, 1))[:, *np.triu_indices(3)]
    size = wanted[:, [0, 3, 5]].sum(axis=1)
    assert np.abs(upper - wanted).max(axis=1) == pytest.approx(0, abs=0.002 * size.max())
    visible = size > 1e-8 * size.max()
    assert (np.abs(upper - wanted).max(axis=1)[visible] < 0.002 * size[visible]).all()


def test_splats_can_be_drawn_in_given_colours(scene, results):
    gaussians = results.one("scene")
    colors = label_colors(gaussians.instance_id)
    node = add_gaussians(scene, "/scene", gaussians, colors)
    rgba = np.ascontiguousarray(node.buffer[:, 7]).view(np.uint8).reshape(-1, 4)
    assert (rgba[:, :3] == colors).all()
    assert np.abs(rgba[:, 3] / 255 - gaussians.opacities).max() < 1 / 255


def test_points_beyond_what_a_browser_bears_are_thinned_out(scene):
    points = np.zeros((1_500_001, 3), np.float32)
    node = add_points(scene, "/points", points, np.zeros((len(points), 3), np.uint8), 0.1)
    assert len(node.points) == 750_001


def test_cameras_stand_where_the_poses_say(scene, around):
    draw(scene, "/cameras", around.cameras, around)
    for view, name in enumerate(around.cameras.names):
        node = scene.get_handle_by_name(f"/cameras/views/{name}")
        camera = camera_of(around.cameras, view)
        np.testing.assert_allclose(node.position, camera.center)
        forward = viser.transforms.SO3(np.asarray(node.wxyz)).as_matrix()[:, 2]
        np.testing.assert_allclose(forward, camera.world_to_camera[2, :3], atol=1e-6)
        assert node.image is not None


def test_agreement_goes_from_red_to_blue_and_points_without_votes_are_grey():
    contested, half, agreed, without = agreement_colors(np.array([0.05, 0.5, 1, 0], np.float32)).astype(int)
    assert contested[0] > contested[2] + 100 and agreed[2] > agreed[0] + 100 and half[1] > 200
    assert len(set(without)) == 1


def test_the_first_view_is_the_photo_that_shows_most(around):
    first = start_view(around.cameras, around.points.points)
    shown = [len(pixels_in_view(around.points.points, camera_of(around.cameras, k))[0]) for k in range(5)]
    best = camera_of(around.cameras, int(np.argmax(shown)))
    np.testing.assert_allclose(first.position, best.center)
    ahead = first.look_at - first.position
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), best.world_to_camera[2, :3], atol=1e-6)
    assert first.up @ -best.world_to_camera[1, :3] > 0.7


@pytest.mark.parametrize("unit", [1e-3, 1, 1e3])
def test_where_no_photo_shows_anything_the_first_view_looks_as_far_as_the_cameras_stand_apart(around, unit):
    poses = around.cameras.world_to_camera.copy()
    poses[:, :3, 3] *= unit
    cameras = replace(around.cameras, world_to_camera=poses)
    first = start_view(cameras, np.zeros((0, 3), np.float32))
    ahead = np.linalg.norm(first.look_at - first.position)
    assert ahead == pytest.approx(camera_extent(cameras_by_view(cameras)), rel=1e-5)


def test_an_object_is_looked_at_whole_from_the_side_that_a_photo_saw(results, around):
    cameras, scene = around.cameras, results.one("scene")
    for instance in np.unique(scene.instance_id[scene.instance_id > 0]):
        points = scene.means[scene.instance_id == instance]
        position, look_at = view_of_object(cameras, points, fov := 0.9)
        away = position - look_at
        centers = np.array([camera_of(cameras, k).center for k in range(len(cameras.names))]) - look_at
        cosines = centers @ away / np.linalg.norm(centers, axis=1) / np.linalg.norm(away)
        assert cosines.max() == pytest.approx(1)  # on the line to a camera
        nearest = np.linalg.norm(centers[cosines.argmax()])
        assert np.linalg.norm(away) <= nearest * (1 + 1e-9)
        rays = points - position
        depth = rays @ -away / np.linalg.norm(away)
        off_axis = np.arccos(np.clip(depth / np.linalg.norm(rays, axis=1), -1, 1))
        is_near = np.linalg.norm(away) < nearest * (1 - 1e-9)
        assert not is_near or np.mean(off_axis < fov / 2) > 0.9  # it fits into the picture, and fills it
        assert not is_near or np.quantile(off_axis, 0.95) > 0.2 * fov


@pytest.mark.parametrize("count", [1, 200])
def test_a_tiny_object_is_looked_at_from_where_it_is_drawn(around, count):
    points = (1e-4 * np.random.default_rng(0).normal(size=(count, 3))).astype(np.float32) + around.points.points[0]
    position, look_at = view_of_object(around.cameras, points, 0.9)
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    assert np.quantile((points - position) @ forward, 0.05) >= NEAR_PLANE - 1e-6


SPATIAL = {
    *("ingest", "cameras", "depth", "dense", "visibility", "segment", "propagate", "cut", "parts", "reproject"),
    *("masks_split", "truth", "reconstruct", "refine", "masks_refined", "merge", "scene", "masks"),
}


def test_every_result_with_a_place_in_space_is_drawn_and_every_other_refused(scene, results, around):
    for name, digest in results.digests.items():
        value = results.one(name) if isinstance(digest, str) else results.all(name)
        assert is_spatial(value) == (name in SPATIAL), name
        if name in SPATIAL:
            draw(scene, f"/{name}", value, around)
            assert any(node.startswith(f"/{name}") for node in scene._handle_from_node_name), name
        else:
            with pytest.raises(InputError, match="has no place in space"):
                draw(scene, f"/{name}", value, around)


@pytest.mark.parametrize("name", ["propagate", "visibility", "ingest", "masks", "depth"])
def test_what_lacks_its_surroundings_says_what_is_missing(scene, results, name):
    value = results.one(name) if name == "propagate" else results.all(name)
    with pytest.raises(InputError, match="can be placed only with"):
        draw(scene, "/alone", value, Around())


def test_an_empty_list_and_a_figure_have_no_place(scene):
    with pytest.raises(InputError, match="empty list"):
        draw(scene, "/nothing", [], Around())
    assert not is_spatial([Metrics({})])


def test_what_is_selected_is_marked_in_orange_and_keeps_its_light_and_shade():
    dark_and_bright_blue = np.float32([[0.05, 0.1, 0.4], [0.3, 0.5, 1.0]])
    gaussians = initialise(
        np.zeros((2, 3), np.float32),
        np.rint(255 * dark_and_bright_blue).astype(np.uint8),
        np.ones(2, np.int32),
        1.0,
        np.zeros(2, np.int32),
    )
    marked = _colors(1, gaussians, "photos", is_selected=True).astype(int)
    assert (marked[:, 0] > 1.5 * marked[:, 2]).all()
    assert marked[1].sum() > 1.1 * marked[0].sum()
