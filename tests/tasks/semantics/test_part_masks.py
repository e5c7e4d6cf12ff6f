from dataclasses import replace

import numpy as np
import pytest
from made_gaussians import made_cameras, made_gaussians

from ss_flow.tasks.artifacts import Cameras, Gaussians, LabelMap
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.semantics.part_masks import part_masks


@pytest.fixture
def scene() -> Gaussians:
    """Opaque enough for surfaces."""
    cloud = made_gaussians(300, 0)
    return replace(cloud, opacity_logits=np.full(300, 4, np.float32), log_scales=np.maximum(cloud.log_scales, -2.6))


def maps_of(scene: Gaussians, cameras: Cameras) -> tuple[LabelMap, ...]:
    """The instance of the heaviest Gaussian of each pixel."""
    return tuple(
        LabelMap(name, np.where((top := render(scene, camera_of(cameras, k)).top_contributor) >= 0,
                                scene.instance_id[top], 0).astype(np.uint16))
        for k, name in enumerate(cameras.names)
    )  # fmt: skip


def test_each_pixel_of_an_instance_shows_the_part_of_its_heaviest_gaussian(scene):
    cameras = made_cameras()
    maps = maps_of(scene, cameras)
    found = part_masks(cameras, scene, maps)
    assert [(p.instance_id, p.part_id) for p in found] == [(i, p) for i in (1, 2, 3) for p in (1, 2)]
    for k, name in enumerate(cameras.names):
        seen = render(scene, camera_of(cameras, k))
        solid = (seen.top_contributor >= 0) & (seen.alpha >= 0.5)
        for part in found:
            expected = solid & (maps[k].ids == part.instance_id) & (scene.part_id[seen.top_contributor] == part.part_id)
            assert np.array_equal(part.mask(part.views.index(name)), expected)


def test_pixels_where_the_map_says_something_else_show_no_part(scene):
    cameras = made_cameras()
    none = tuple(LabelMap(one.name, np.where(one.ids == 2, 0, one.ids)) for one in maps_of(scene, cameras))
    assert {part.instance_id for part in part_masks(cameras, scene, none)} == {1, 3}
    other = tuple(LabelMap(one.name, np.full_like(one.ids, 9)) for one in none)
    assert part_masks(cameras, scene, other) == ()


def test_views_that_do_not_show_a_part_are_left_out(scene):
    cameras = made_cameras()
    first, second = maps_of(scene, cameras)
    hidden = (first, LabelMap(second.name, np.where(second.ids == 1, 0, second.ids)))
    by_key = {(part.instance_id, part.part_id): part for part in part_masks(cameras, scene, hidden)}
    assert by_key[1, 1].views == (first.name,) and by_key[2, 1].views == (first.name, second.name)


def test_a_scene_without_gaussians_has_no_parts():
    assert part_masks(made_cameras(), made_gaussians(0, 0), (LabelMap("0000", np.ones((4, 4), np.uint16)),)) == ()
