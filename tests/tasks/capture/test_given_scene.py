"""A scene from elsewhere against the cameras and photos of its capture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import box_scene
import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.capture.given_scene import GivenSceneParams, given_scene, rendered_depth
from ss_flow.tasks.deliver.ply import write_gaussians
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.geometry.cameras import backproject, camera_of

CAMERAS, FRAMES = box_scene.cameras(), box_scene.frames()


@pytest.fixture(scope="module")
def boxes() -> Gaussians:
    """The boxes and their floor as opaque Gaussians."""
    casts = [box_scene.cast(view) for view in range(box_scene.VIEWS)]
    points = [backproject(depth, camera_of(CAMERAS, view)) for view, (depth, _) in enumerate(casts)]
    colors = box_scene.COLORS[np.concatenate([ids.ravel() for _, ids in casts])]
    made = initialise(np.concatenate(points).astype(np.float32), colors, 0, 0.0, opacity=0.95)
    return replace(made, log_scales=np.full_like(made.log_scales, np.log(0.01)))


def read(folder: Path, scene: Gaussians) -> Gaussians:
    file = folder / "splat.ply"
    write_gaussians(file, scene, labelled=True)
    return given_scene.function(FRAMES, CAMERAS, file=FileRef(file, "0"))


def warned(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    said: list[str] = []
    monkeypatch.setattr("ss_flow.tasks.capture.given_scene.warn", said.append)
    return said


def test_a_scene_in_the_cameras_frame_is_taken_without_a_word_and_without_its_labels(boxes, tmp_path, monkeypatch):
    said = warned(monkeypatch)
    found = read(tmp_path, replace(boxes, instance_id=np.full(len(boxes), 3, np.int32)))
    assert not said
    np.testing.assert_array_equal(found.means, boxes.means)
    assert not found.instance_id.any() and not found.instance_conf.any() and not found.part_id.any()


@pytest.mark.parametrize(
    "moved",
    [
        lambda means: means @ np.float32([[-1, 0, 0], [0, 1, 0], [0, 0, -1]]) + np.float32([0, 0, 0.5]),
        lambda means: 0.5 * means,
        lambda means: means + np.float32([0.5, 0, 0]),
    ],
    ids=["turned", "half the size", "beside"],
)
def test_a_scene_in_another_frame_is_warned_of(boxes, tmp_path, monkeypatch, moved):
    said = warned(monkeypatch)
    read(tmp_path, replace(boxes, means=moved(boxes.means).astype(np.float32)))
    (text,) = said
    assert "splat.ply hardly looks like the photos" in text


def test_a_scene_behind_all_cameras_is_refused(boxes, tmp_path):
    with pytest.raises(InputError, match=r"none of the 6 cameras sees the scene of splat\.ply"):
        read(tmp_path, replace(boxes, means=boxes.means + np.float32([0, 0, 90])))


@pytest.mark.parametrize("name", ["means", "opacity_logits", "sh", "quaternions"])
def test_numbers_that_are_none_are_refused_with_their_row(boxes, tmp_path, name):
    values = getattr(boxes, name).copy()
    values[5] = 0 if name == "quaternions" else np.inf if name == "opacity_logits" else np.nan
    with pytest.raises(InputError, match=r"splat\.ply holds 1 Gaussians, the first in row 5"):
        read(tmp_path, replace(boxes, **{name: values}))


def test_a_file_of_no_gaussians_is_refused(boxes, tmp_path):
    none = replace(boxes, **{name: getattr(boxes, name)[:0] for name in boxes.__dataclass_fields__})
    with pytest.raises(InputError, match=r"splat\.ply holds no Gaussians"):
        read(tmp_path, none)


def test_the_depth_of_a_scene_is_that_of_its_surface(boxes):
    for view in (0, 3):
        camera = camera_of(CAMERAS, view)
        true, _ = box_scene.cast(view)
        found = rendered_depth.function(boxes, FRAMES[view], camera)
        known = (found.depth > 0) & (true > 0)
        assert found.source == "rendered" and known.sum() > 0.95 * (true > 0).sum()
        # The floor is seen at an angle: within a pixel its depth changes by about twice the pixel's width.
        error = (np.abs(found.depth - true) / (true / camera.fx + 1e-9))[known]
        assert np.median(error) < 2 and np.mean(error < 6) > 0.9


def test_depth_is_unknown_where_nothing_opaque_is_and_no_larger_than_asked_for(boxes):
    few = replace(boxes, opacity_logits=np.full(len(boxes), -9, np.float32))
    assert not rendered_depth.function(few, FRAMES[0], camera_of(CAMERAS, 0)).depth.any()
    small = rendered_depth.function(boxes, FRAMES[0], camera_of(CAMERAS, 0), params=GivenSceneParams(max_side=48))
    assert small.depth.shape == (36, 48)
