"""Where the borders of a photo are, whatever part of it a camera shows."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.geometry.cameras import Camera


def test_borders_are_the_slopes_of_the_rays_through_them():
    camera = Camera(40, 30, 20.0, 25.0, 15.0, 20.0, np.eye(4))
    assert camera.borders == pytest.approx((-0.75, -0.8, 1.25, 0.4))


def test_a_crop_keeps_the_borders_of_its_photo():
    camera = Camera(40, 30, 20.0, 25.0, 15.0, 20.0, np.eye(4))
    assert camera.cropped(20, 3, 38, 12).scaled(5, 7).cropped(1, 1, 3, 4).borders == camera.borders
    assert camera.scaled(80, 15).borders == pytest.approx(camera.borders)
    assert camera.scaled(80, 15).photo_borders is None
