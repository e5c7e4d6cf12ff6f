import numpy as np
from generated_views import views

from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture.completion import CompletionParams, completed, gaps, sized
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import encode_png


def maps(*depths):
    return tuple(DepthMap(f"view{k}", np.asarray(depth, np.float32), "sensor") for k, depth in enumerate(depths))


def test_gaps_are_the_views_of_whose_valid_pixels_too_few_are_known():
    frames, _, _ = views([(0, 0, 0)] * 3, width=40, height=20)
    left = np.arange(40) < 20
    whole, half = np.ones((20, 40)), np.where(left, 1, 0) * np.ones((20, 1))
    seen = np.where(left, 255, 0).astype(np.uint8) * np.ones((20, 1), np.uint8)
    cut = type(frames[2])("view2", 40, 20, frames[2].encoded, encode_png(seen), 40, 20)
    found = gaps((*frames[:2], cut), maps(whole, half, half))
    assert found.view.tolist() == [1]
    assert gaps(frames, maps(whole, half, half), params=CompletionParams(below=0.5)).view.tolist() == []


def test_thin_holes_between_known_pixels_are_no_gaps():
    frames, _, _ = views([(0, 0, 0)], width=40, height=20)
    lattice = np.ones((20, 40))
    lattice[4::9], lattice[:, 4::9] = 0, 0
    assert (lattice > 0).mean() < 0.9 and not len(gaps(frames, maps(lattice)).view)


def test_a_sensor_keeps_what_it_knows_and_gets_the_rest_at_its_own_size():
    (sensor,) = maps([[0, 2, 2, 0], [0, 2, 2, 2]])
    (found,) = maps([[3, 5]])
    result = completed(sensor, found)
    assert result.depth.tolist() == [[3, 2, 2, 5], [3, 2, 2, 2]] and result.depth.dtype == np.float32
    assert (result.name, result.source) == ("view0", "completed")


def test_a_sensor_is_compared_at_the_size_of_the_photos():
    _, cameras, (depth,) = views([(0, 0, 0)])
    small = sized(maps(depth)[0], camera_of(cameras, 0), max_side=40)
    assert small.depth.shape == (30, 40) and np.isin(small.depth, depth.astype(np.float32)).all()
