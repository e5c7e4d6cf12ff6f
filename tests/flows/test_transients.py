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


def frames(capture, store, *options):
    called = run_tiny(capture, store, "--until", "ingest", *options)
    assert called.code == 0, called.err
    return called, [Store(store).get(digest) for digest in called.results()["ingest"]]


def test_pixels_of_an_arm_do_not_count_and_the_run_says_so(captures, tmp_path):
    _, reached, arms = captures
    called, found = frames(reached, tmp_path / "store")
    ignored = np.array([~decode_valid(frame) for frame in found])
    assert ignored[arms].mean() > 0.9 and ignored[~arms].mean() < 0.03
    assert not ignored[~arms.any(axis=(1, 2))].any()
    (told,) = [text for node in called.document()["nodes"] for text in node["warnings"]]
    assert told.startswith("In 4 of 12 views something moves") and told in called.err
    assert run_tiny(reached, tmp_path / "store", "--until", "without_transients").computed() == {}
    for frame in frames(reached, tmp_path / "store", *KEPT)[1]:
        assert decode_valid(frame).all()


def test_frames_of_a_capture_in_which_nothing_moves_are_those_that_were_read(captures, tmp_path):
    still, _, _ = captures
    called, _ = frames(still, tmp_path / "store")
    assert called.results() == frames(still, tmp_path / "store", *KEPT)[0].results()
    assert called.computed()["capture.transients"] == 1


def test_views_that_were_kept_back_count_whole(captures, tmp_path):
    """Of these only the photos are looked at."""
    import shutil

    reached = tmp_path / "room"
    shutil.copytree(captures[1], reached)
    shutil.copytree(captures[1], reached / "held_out")
    called = run_tiny(reached, tmp_path / "store", "--until", "ingest_held_out")
    assert called.code == 0, called.err
    for digest in called.results()["ingest_held_out"]:
        assert decode_valid(Store(tmp_path / "store").get(digest)).all()
    assert "capture.transients" not in called.computed()
