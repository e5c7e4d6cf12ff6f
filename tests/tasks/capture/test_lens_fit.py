"""A lens that is stated wrongly is told by points in common under right poses; wrong poses are not taken for one."""

from dataclasses import replace

import numpy as np
import pytest
from generated_views import compared, jittered

from ss_flow.tasks.capture.lens import distorted, found_lens
from ss_flow.tasks.capture.lens_fit import with_focal
from ss_flow.tasks.capture.pose_fit import PoseFit, pose_fit, with_lens


@pytest.fixture(scope="module")
def scene():
    return compared()


def bent(scene, radial):
    """The scene as a lens of such a radial coefficient shows it, of which its cameras do not tell."""
    cameras, pairs, photos, matches, depths = scene
    lens = found_lens(replace(cameras, radial=np.full(len(cameras), radial)), 0)
    pulled = [replace(photo, points=distorted(photo.points, lens).astype(np.float32)) for photo in photos]
    return cameras, pairs, pulled, matches, depths


def fitted(*scene, lens="all"):
    return pose_fit(*scene, lens=lens)


@pytest.mark.parametrize("radial", [-0.3, 0.2])
def test_a_distortion_of_which_nothing_is_said_is_found(scene, radial):
    seen = bent(scene, radial)
    found = fitted(*seen)
    assert found.focal == 1 and found.radial == pytest.approx(radial, abs=0.015)
    assert found.as_given == pose_fit(*seen).distance > 2 * found.distance
    # A stated distortion was taken out of the photos already, and no focal length stands in for what is left.
    assert not fitted(*seen, lens="focal").other_lens


@pytest.mark.parametrize("factor", [0.7, 0.95, 1.3])
def test_a_wrong_focal_length_is_found(scene, factor):
    cameras, *seen = scene
    found = fitted(with_focal(cameras, factor), *seen)
    assert found.focal == pytest.approx(1 / factor, rel=0.005) and found.radial == 0
    assert found == fitted(with_focal(cameras, factor), *seen, lens="focal")


def test_both_are_found_together(scene):
    cameras, *seen = bent(scene, -0.3)
    found = fitted(with_focal(cameras, 0.9), *seen)
    assert found.focal == pytest.approx(1 / 0.9, rel=0.01)
    assert found.radial == pytest.approx(-0.3, abs=0.03)


def test_poses_that_are_wrong_are_not_taken_for_a_lens(scene):
    cameras, *seen = scene
    for degrees in (0.2, 0.5, 1.0):
        wrong = jittered(cameras, 0.03 * degrees, degrees)
        found = fitted(wrong, *seen)
        assert found == replace(pose_fit(wrong, *seen), lens_gain=found.lens_gain)


def test_photos_with_nothing_in_common_tell_of_no_lens(scene):
    cameras, pairs, photos, matches, depths = scene
    few = [replace(m, first=m.first * 0, pair=m.pair[:5]) for m in matches]
    found = fitted(with_focal(cameras, 0.8), pairs, photos, few, depths)
    assert np.isnan(found.distance) and not found.other_lens


def test_the_other_lens_is_that_of_the_cameras_and_is_told(scene):
    cameras, *_ = scene
    fit = PoseFit(0.0003, 0.001, focal=1.25, radial=-0.1, as_given=0.002)
    with pytest.warns(
        UserWarning, match=r"1\.250 times as long and photos straightened by .* of -0\.1, .* 0\.30 instead"
    ):
        found = with_lens(cameras, fit)
    np.testing.assert_allclose(found.intrinsics[0], (375, 375, 160, 120))
    assert found_lens(found, 0).distortion[0] == -0.1
    with pytest.warns(UserWarning, match="1.250 times as long, matched"):
        assert not with_lens(cameras, replace(fit, radial=0.0)).radial.size
