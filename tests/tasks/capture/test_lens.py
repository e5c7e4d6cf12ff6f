import cv2
import numpy as np
import pytest

from ss_flow.tasks.capture.lens import Lens, distorted, inside_source, undistortion_map

SIDE = 400


def lens_of(focal, distortion, *, fisheye=False):
    return Lens(SIDE, SIDE, focal, focal, SIDE / 2, SIDE / 2, distortion, fisheye)


def slopes(lens):
    """[H, W] of the rays through the pixels of the undistorted image, to the axis."""
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    return np.hypot(x, y) / lens.fx


@pytest.mark.parametrize(
    ("lens", "turning"),
    [
        # The derivatives are 1 - 0.9 r^2, 1 - 0.6 a^2 by the angle a, and r / (1 - r^2 / 2) has a pole.
        (lens_of(130, (-0.3, 0.0, 0.0, 0.0)), np.sqrt(1 / 0.9)),
        (lens_of(50, (-0.2, 0.0, 0.0, 0.0), fisheye=True), np.tan(np.sqrt(1 / 0.6))),
        (lens_of(100, (0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0)), np.sqrt(2)),
    ],
    ids=["radial", "fisheye", "rational"],
)
def test_no_pixel_counts_beyond_where_the_lens_model_turns_round(lens, turning):
    inside, slope = inside_source(undistortion_map(lens)), slopes(lens)
    assert (slope > turning).mean() > 0.02
    assert not inside[slope > turning].any()
    points = np.column_stack([g.ravel() + 0.5 for g in np.meshgrid(np.arange(SIDE), np.arange(SIDE))])
    in_photo = ((distorted(points, lens) >= 0) & (distorted(points, lens) < SIDE)).all(axis=1).reshape(SIDE, SIDE)
    sure = slope < 0.99 * turning
    np.testing.assert_array_equal(inside[sure], in_photo[sure])


@pytest.mark.parametrize("distortion", [(-0.28, 0.07, 1e-3, -5e-4), (0.1, -0.05, 0.0, 0.0, 0.02), (0.0,) * 4])
def test_the_map_of_a_lens_that_does_not_turn_round_is_that_of_opencv(distortion):
    lens = lens_of(300, distortion)
    matrix = np.array([[300, 0, SIDE / 2 - 0.5], [0, 300, SIDE / 2 - 0.5], [0, 0, 1]])
    u, v = cv2.initUndistortRectifyMap(matrix, np.array(distortion), None, matrix, (SIDE, SIDE), cv2.CV_32FC1)
    np.testing.assert_array_equal(undistortion_map(lens), np.stack([u, v], axis=-1))


@pytest.mark.parametrize("distortion", [(0.05, -0.01, 0.002, -0.0005), (), (0.0,) * 4])
def test_the_map_of_a_fisheye_that_does_not_turn_round_is_that_of_opencv(distortion):
    lens = lens_of(150, distortion, fisheye=True)
    matrix = np.array([[150, 0, SIDE / 2 - 0.5], [0, 150, SIDE / 2 - 0.5], [0, 0, 1]])
    coefficients = np.array(distortion or (0.0,) * 4)
    u, v = cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, (SIDE, SIDE), cv2.CV_32FC1)
    np.testing.assert_array_equal(undistortion_map(lens), np.stack([u, v], axis=-1))
