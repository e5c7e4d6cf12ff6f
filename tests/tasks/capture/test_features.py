from dataclasses import replace

import numpy as np
import pytest
from generated_views import views

from ss_flow.tasks.capture.features import FeatureParams, features
from ss_flow.tasks.geometry.images import encode_png


@pytest.fixture(scope="module")
def frame():
    return views([(0.2, 0.1, 0.0)], width=320, height=240, focal=300.0)[0][0]


def test_features_lie_in_the_photo_and_are_whole_bytes_of_one_length(frame):
    found = features(frame)
    assert (found.name, found.width, found.height) == (frame.name, 320, 240)
    assert len(found.points) == len(found.descriptors) > 200
    assert found.points.min() >= 0
    assert (found.points < (320, 240)).all()
    np.testing.assert_allclose(np.linalg.norm(found.descriptors.astype(float), axis=1), 512, rtol=0.02)


def test_features_of_a_photo_are_the_same_every_time(frame):
    once, again = features(frame), features(frame)
    np.testing.assert_array_equal(once.points, again.points)
    np.testing.assert_array_equal(once.descriptors, again.descriptors)


def test_the_largest_features_come_first(frame):
    everything, few = features(frame), features(frame, params=FeatureParams(max_features=50))
    assert 40 <= len(few.points) <= 50
    head = {tuple(point) for point in everything.points[:60].tolist()}
    assert np.mean([tuple(point) in head for point in few.points.tolist()]) > 0.9


def test_pixels_that_do_not_count_have_no_features(frame):
    valid = np.full((240, 320), 255, np.uint8)
    valid[:, :160] = 0
    half = features(replace(frame, valid=encode_png(valid)))
    assert len(half.points) > 50
    assert half.points[:, 0].min() >= 160
    assert features(frame).points[:, 0].min() < 160


def test_features_of_a_photo_scaled_down_are_in_pixels_of_the_frame(frame):
    small = features(frame, params=FeatureParams(max_image_side=160))
    assert small.points[:, 0].max() > 240
    everything = features(frame).points
    off = np.linalg.norm(small.points[:20, None] - everything, axis=-1).min(axis=1)
    assert np.median(off) < 1.0


def test_light_features_do_not_keep_descriptors_in_memory(frame):
    found = features(frame)
    light = found.light()
    assert light.descriptors.shape == (0, 128)
    assert light.descriptors.base is None
    assert light.points is found.points
