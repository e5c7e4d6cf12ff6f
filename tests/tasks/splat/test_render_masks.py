"""Which instance weighs most in each pixel of a view: the same, however many mask images are held at once."""

from __future__ import annotations

import numpy as np
from made_gaussians import made_cameras, made_gaussians

from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.splat import render_masks as module


def test_it_is_the_same_however_many_mask_images_are_held_at_once(monkeypatch):
    scene, camera = made_gaussians(300, 0), camera_of(made_cameras(), 0)
    known = np.zeros((camera.height, camera.width), np.uint16)
    at_once = module._ids_of_view(scene, camera, known, 0.0)
    rendered = []
    monkeypatch.setattr(module, "render", lambda *a, **k: rendered.append(k) or render(*a, **k))
    monkeypatch.setattr(module, "_MASK_BYTES", 1)
    one_by_one = module._ids_of_view(scene, camera, known, 0.0)
    assert [len(k.get("label_ids", ())) for k in rendered] == [0, 1, 1, 1, 1]
    assert np.array_equal(at_once, one_by_one) and len(np.unique(at_once)) == 4
