"""What `--help` shows."""

from __future__ import annotations

import typing
from collections.abc import Iterator
from typing import Any

import pytest
from tiny_runs import ss_flow

from ss_flow.flows.cli.main import Command


def commands(union: Any, before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every command, as the words that call it."""
    for choice in typing.get_args(union):
        kind, named = typing.get_args(choice)
        words = (*before, named.name)
        inner = typing.get_type_hints(kind, include_extras=True).get("command")
        yield from [words] if inner is None else commands(inner, words)


COMMANDS = list(commands(typing.get_args(Command)[0]))


def test_all_commands_are_found():
    first = {words[0] for words in COMMANDS}
    assert first >= {"demo", "run", "sweep", "batch", "query", "diff", "status", "cache", "models", "doctor"}
    assert ("cache", "show") in COMMANDS and len(COMMANDS) == len(set(COMMANDS))


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_says_what_to_give_and_not_that_it_may_be_left_out(command):
    shown = ss_flow(*command, "--help")
    assert shown.code == 0 and "usage: ss-flow " + " ".join(command) in shown.out
    assert "None" not in shown.out and "(default: )" not in shown.out
