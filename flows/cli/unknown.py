"""What is said of a word of the command line that nobody knows: a sentence, with what may have been meant."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ss_flow.errors import InputError
from ss_flow.flows.cli.commands import COMMANDS, Entry, Group


def refuse_unknown(arguments: Sequence[str], left: Sequence[str], show_help: Callable[[list[str]], Any]) -> None:
    """Raise InputError about the first word that is no command, no option of its command, or one too many.

    arguments: all words of the command line.
    left: those of them that were read as nothing.
    show_help: prints the help of a command, and exits.
    Returns where the fault is another one.
    """
    commands: Mapping[str, Entry | Group] = COMMANDS
    words = list(arguments)
    called = "ss-flow"
    while commands and words and not words[0].startswith("-"):
        word = words.pop(0)
        if word not in commands:
            near = "; `ss-flow run PATH` runs a capture," if Path(word).exists() else ";"
            near = _perhaps(get_close_matches(word, commands)) or near
            raise InputError(f"`{called}` has no command {word!r}{near} `{called} --help` lists all.")
        called += f" {word}"
        entry = commands[word]
        commands = entry.commands if isinstance(entry, Group) else {}
    known = _options(called.split()[1:], show_help)
    for word in words:
        option = word.partition("=")[0].replace("_", "-")
        if re.match("--?[A-Za-z]", option) and option not in known:
            near = _perhaps(_like(option.lstrip("-").lower(), known))
            raise InputError(f"`{called}` has no option {option}{near or ';'} `{called} --help` lists all.")
    if left:
        raise InputError(f"`{called}` has no use for {left[0]!r}; a name with blanks stands in quotation marks.")


def _options(command: list[str], show_help: Callable[[list[str]], Any]) -> list[str]:
    """The options that the help of a command tells of."""
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        show_help([*command, "--help"])
    return ["-h", *re.findall(r"^\W*(--[a-z-]+)", text.getvalue(), re.MULTILINE), "--help"]


def _like(name: str, known: Iterable[str]) -> list[str]:
    """Options that begin like a name, or with which it begins; else those that are spelt like it."""
    names = [option[2:] for option in known]
    begin = [option for option in names if option and (option.startswith(name) or name.startswith(option))]
    return [f"--{option}" for option in begin or get_close_matches(name, names)]


def _perhaps(near: Sequence[str]) -> str:
    return f"; did you mean {' or '.join(near)}?" if near else ""
