"""What `--help` shows."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest
from tiny_runs import ss_flow

from ss_flow.flows.cli.commands import COMMANDS, Entry, Group

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


@pytest.mark.parametrize("arguments", [(), ("--help",), ("cache", "--help"), ("models", "--help")], ids=" ".join)
def test_the_overview_loads_no_command_and_nothing_that_takes_long(arguments):
    loaded = loaded_by(*arguments)
    assert {m for m in loaded if m.startswith("ss_flow.flows.cli.")} == {
        "ss_flow.flows.cli.main",
        "ss_flow.flows.cli.commands",
    }
    assert not loaded & {"numpy", "blake3", "psutil", "rich", "networkx", "torch", "scipy", "cv2"}


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
