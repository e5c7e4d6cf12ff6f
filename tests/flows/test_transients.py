"""An arm that reaches into the photos is neither a thing nor part of the scene."""

from __future__ import annotations

import numpy as np
import pytest
from altered_captures import reach_in
from tiny_runs import run_tiny

from ss_flow.cache.store import Store
from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.tasks.geometry.images import decode_valid

KEPT = ("--set", "capture.transients.views=0")


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """A room as it is, and with an arm before each third camera; and where that is: [views, H, W]."""
    base = tmp_path_factory.mktemp("transients")
    room = generate(RoomParams(objects=8, views=12, width=320, height=240, held_out=0))
    for name in ("still", "reached"):
        write_scene(room, base / name, masks="truth")
    return base / "still", base / "reached", reach_in(base / "reached", every=3)


def learnt_from(capture, store, *options):
    """A run up to the trainings of instances, and its frames, by name, some pixels of which do not count."""
    called = run_tiny(capture, store, "--until", "reconstruct", *options)
    assert called.code == 0, called.err
    changed = [node["outputs"] for node in called.document()["nodes"] if node["step"] == "capture.without_transients"]
    return called, {frame.name: frame for (digest,) in changed for frame in [Store(store).get(digest)]}


def test_nothing_is_learnt_from_pixels_of_an_arm_and_the_run_says_so(captures, tmp_path):
    _, reached, arms = captures
    called, found = learnt_from(reached, tmp_path / "store")
    assert sorted(found) == [f"{view:04d}" for view in np.flatnonzero(arms.any(axis=(1, 2)))]
    for name, frame in found.items():
        ignored, arm = ~decode_valid(frame), arms[int(name)]
        assert ignored[arm].mean() > 0.9 and ignored[~arm].mean() < 0.06
    told = [text for node in called.document()["nodes"] for text in node["warnings"] if "something moves" in text]
    assert len(told) == 1 and told[0].startswith("In 4 of 12 views") and told[0] in called.err
    assert run_tiny(reached, tmp_path / "store", "--until", "without_transients").computed() == {}


def test_a_capture_in_which_nothing_moves_is_learnt_as_it_was_read(captures, tmp_path):
    still, _, _ = captures
    called, found = learnt_from(still, tmp_path / "store")
    assert called.computed()["capture.transients"] == 1 and found == {}
    assert learnt_from(still, tmp_path / "store", *KEPT)[0].computed() == {}


def test_masks_of_single_views_stay_as_they_are(captures, tmp_path):
    """Points of what moves are confirmed by no other view, so Split does without."""
    _, reached, _ = captures
    called = run_tiny(reached, tmp_path / "store", "--until", "masks_split")
    assert called.code == 0 and "capture.transients" not in called.computed()
