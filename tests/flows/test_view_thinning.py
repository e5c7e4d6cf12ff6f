"""Fewer Gaussians for browsers without a GPU: which ones, how large, and what still means all of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from box_scene import cameras
from made_gaussians import made_gaussians
from still_life import DOCUMENT, scene
from tiny_runs import ss_flow

from ss_flow.flows.view.session import Session
from ss_flow.flows.view.thinning import thinned
from ss_flow.tasks.gaussians.initialise import initialise, select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera


def cover(gaussians) -> float:
    """Sum of opacity times the area of the ellipse of the two largest axes, but for pi."""
    scales = np.sort(np.exp(gaussians.log_scales.astype(np.float64)), axis=1)
    return float((gaussians.opacities * scales[:, 1] * scales[:, 2]).sum())


@pytest.mark.parametrize(("share", "count"), [(0.5, 50), (0.101, 11), (1e-9, 1)])
def test_a_share_stays_in_its_order_and_covers_as_much(share, count):
    whole = made_gaussians(100, 3)
    some = thinned(whole, share)
    rows = [int(np.flatnonzero((whole.means == mean).all(axis=1))[0]) for mean in some.means]
    assert len(rows) == count and rows == sorted(set(rows))
    assert cover(some) == pytest.approx(cover(whole), rel=1e-4)
    grown = some.log_scales - whole.log_scales[rows]
    assert np.ptp(grown) < 1e-4 and grown.min() > 0
    assert np.array_equal(some.means, thinned(whole, share).means)


def test_all_are_left_as_they_are():
    whole = made_gaussians(10, 0)
    assert thinned(whole, 1.0) is whole and thinned(select(whole, np.arange(0)), 0.1).means.shape == (0, 3)


def test_heavy_ones_stay_rather_than_faint_and_small_ones():
    whole = made_gaussians(1000, 0)
    heavy = np.arange(1000) % 10 == 0
    whole.opacity_logits[:], whole.log_scales[:] = np.where(heavy, 3, -3), np.where(heavy, 0, -3)[:, None]
    kept = thinned(whole, 0.1)
    assert (kept.opacity_logits > 0).sum() > 90


def test_a_wall_of_a_tenth_of_its_gaussians_has_no_holes():
    side = np.linspace(-1, 1, 60)
    means = np.stack([*np.meshgrid(side, side), np.full((60, 60), 2.0)], axis=-1).reshape(-1, 3).astype(np.float32)
    wall = initialise(means, np.full((3600, 3), 128, np.uint8), np.ones(3600, np.int32), 0.02)
    camera = Camera(60, 60, 90.0, 90.0, 30.0, 30.0, np.eye(4))
    some = thinned(wall, 0.1)
    holes = [float((render(one, camera).alpha < 0.1).mean()) for one in (wall, some)]
    assert holes[0] == 0 and holes[1] < 0.1


def test_the_viewer_draws_the_share_of_each_object_and_clicks_and_edits_mean_all(tmp_path):
    viser = pytest.importorskip("viser", reason="needs the extra `view`")
    from ss_flow.flows.view.panel import Panel

    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        session = Session(scene(), json.loads(json.dumps(DOCUMENT)), Path())
        panel = Panel(server, cameras(), session, tmp_path / "s.json", None, draw_at_most=11)
        drawn = {i: len(server.scene.get_handle_by_name(f"/objects/{i}").buffer) for i in session.state.pieces}
        assert drawn == {0: 5, 2: 2, 3: 2, 4: 2}
        notes = [
            getattr(one, "content", "") for one in server.gui._container_handle_from_uuid["root"]._children.values()
        ]
        assert any("11 of 22 Gaussians" in note for note in notes)
        assert len(panel.pick()._scene) == 22
        session.do({"op": "remove", "instances": [2]})
        panel.refresh()
        assert len(session.scene()) == 18
    finally:
        server.stop()


def test_a_number_that_cannot_be_drawn_is_refused(tiny):
    for options in (("--draw-at-most", "0"), ("--draw-at-most", "5", "--html", "x.html")):
        called = ss_flow("view", tiny.out, "--cache", tiny.store, *options)
        assert called.code == 2 and "--draw-at-most takes a number above 0" in called.err
