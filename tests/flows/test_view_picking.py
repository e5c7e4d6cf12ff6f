"""Which instance a click meets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ss_flow.flows.view.picking import Picker, pixel_met
from ss_flow.flows.view.session import Piece, Session
from ss_flow.tasks.edit.operations import begin
from ss_flow.tasks.gaussians.initialise import initialise, select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera

FOCAL = 80.0


def instance_at(picker: Picker, pixel: Camera) -> int | None:
    met = picker.met(pixel)
    return None if met is None else met[0]


def cloud(seed: int, count: int = 400) -> Session:
    """Gaussians of every size and shape around a point before the camera, and behind it, of seven instances."""
    rng = np.random.default_rng(seed)
    means = (rng.normal(size=(count, 3)) * (1.5, 1.2, 2) + (0, 0, 3)).astype(np.float32)
    scene = initialise(means, np.zeros((count, 3), np.uint8), rng.integers(0, 7, count).astype(np.int32), 0.05)
    scene.log_scales[:] = rng.normal(-3, 1.2, (count, 3))
    scene.quaternions[:] = rng.normal(size=(count, 4))
    scene.opacity_logits[:] = rng.normal(1, 2, count)
    return Session(scene, {"instances": [], "groups": []}, Path())


@pytest.mark.parametrize("seed", range(3))
def test_a_click_meets_exactly_what_a_picture_shows_at_that_pixel(seed):
    session = cloud(seed)
    scene, wxyz = session.scene(), Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat(scalar_first=True)
    pose, center = np.eye(4), np.array([0.1, 0.2, -0.3])
    pose[:3, :3] = Rotation.from_quat(wxyz, scalar_first=True).as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ center
    ids = np.unique(scene.instance_id)
    drawn = render(scene, Camera(64, 48, FOCAL, FOCAL, 32, 24, pose), label_ids=ids.tolist())
    top, together = drawn.top_contributor, ids[drawn.label_masks.argmax(axis=0)]
    picker, shown = Picker(session.visible()), np.where(top < 0, -1, together)
    for v in range(0, 48, 3):
        for u in range(0, 64, 3):
            ray = pose[:3, :3].T @ np.array([(u + 0.5 - 32) / FOCAL, (v + 0.5 - 24) / FOCAL, 1])
            pixel = pixel_met(center, 3 * ray, wxyz, FOCAL, (64, 48))
            assert pixel is not None
            found = instance_at(picker, pixel)
            assert (-1 if found is None else found) == shown[v, u]
    assert len(np.unique(shown)) > 2
    assert (scene.instance_id[top] != together)[top >= 0].any()  # one Gaussian alone does not tell


def test_a_ray_that_points_away_from_the_picture_meets_no_pixel():
    ahead = np.array([1.0, 0, 0, 0])
    assert pixel_met(np.zeros(3), np.array([0, 0, -1.0]), ahead, FOCAL, (64, 48)) is None
    far = pixel_met(np.zeros(3), np.array([0, 0, 1e300]), ahead, FOCAL, (64, 48))
    assert far is not None and (far.cx, far.cy) == (0.5, 0.5)


def test_what_is_hidden_is_not_met_and_nothing_is_met_where_nothing_is():
    places, ids = np.array([[0, 0, 2], [0, 0, 3]], np.float32), np.array([5, 6], np.int32)
    scene = begin(initialise(places, np.zeros((2, 3), np.uint8), ids, 0.1))
    near, far = (Piece(np.array([row]), select(scene, np.array([row]))) for row in (0, 1))
    pixel = Camera(1, 1, FOCAL, FOCAL, 0.5, 0.5, np.eye(4))
    behind = Camera(1, 1, FOCAL, FOCAL, 0.5, 0.5, np.diag([1.0, -1, -1, 1]))
    assert instance_at(Picker({5: near, 6: far}), pixel) == 5
    assert instance_at(Picker({6: far}), pixel) == 6
    assert instance_at(Picker({6: far}), behind) is None
    assert instance_at(Picker({}), pixel) is None
