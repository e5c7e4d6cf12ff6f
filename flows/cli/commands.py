"""The commands by name: where each is, and what the overview says of it, so that only the one that is called is loaded.

A summary is the docstring of its class, said a second time; a test holds that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, make_dataclass
from importlib import import_module
from typing import Annotated, Any, Union

import tyro


@dataclass(frozen=True)
class Entry:
    """One command."""

    place: str
    """Module of this package and class, "run:Demo"."""
    summary: str

    def load(self) -> Any:
        """The command's class."""
        module, _, name = self.place.partition(":")
        return getattr(import_module(f"ss_flow.flows.cli.{module}"), name)


@dataclass(frozen=True)
class Group:
    """Several commands under one word."""

    summary: str
    commands: Mapping[str, Entry]


COMMANDS: Mapping[str, Entry | Group] = {
    "demo": Entry(
        "run:Demo", "Build a small room, run everything on it, and measure the result against its ground truth."
    ),
    "run": Entry("run:Run", "Turn a capture into instance-labelled Gaussians."),
    "sweep": Entry(
        "sweep:Sweep",
        """Run scenes with several values of parameters, as in --set split.tau_depth=0.001,0.02,0.1, and compare them.

Values have commas between them, values that are lists themselves semicolons; lo:hi:n are n values from lo to hi,
lo:hi:nlog the same evenly in the logarithm. What variants share is computed once. No output folders are written:
`ss-flow run` with the chosen values gives one at once, since all its results are there.""",
    ),
    "batch": Entry(
        "batch:Batch", "Run many scenes, each into a folder of its own; one that fails leaves the others alone."
    ),
    "status": Entry("inspect:Status", "Tell what the latest run did, step by step; also while it runs."),
    "why": Entry(
        "why:Why",
        "Tell why a step ran in the latest run that got to it: what of its key had changed, back to the first cause.",
    ),
    "graph": Entry("inspect:Graph", "Draw what feeds what in the latest run, a box a step, in Mermaid's notation."),
    "diff": Entry(
        "diff:Diff",
        """Tell what two results differ in: files given, parameters, networks, metrics, steps, which objects are which.

Objects are compared in the masks of the views that both results have; ids need not agree.""",
    ),
    "report": Entry(
        "report:WriteReport",
        "Write the report of a result anew, from what the store holds of it; nothing is computed.",
    ),
    "eval": Entry("evaluate:Evaluate", "Measure a result against ground truth, by a published protocol."),
    "reproduce": Entry(
        "reproduce:Reproduce",
        """Measure one of the paper's tables on data at hand, and lay it beside what the paper prints.

Every cell is a run like any other: what runs share is computed once, and an interrupted table goes on where it was.
A cell that was not measured stays empty.""",
    ),
    "query": Entry("query:Query", "Find the instances of a result that a text describes."),
    "export": Entry("export:Export", "Write a result, or some of its instances, in another format."),
    "render": Entry("render:Render", "Render a result along a path of cameras, as PNG files or an MP4 film."),
    "view": Entry(
        "view:View",
        "Look at a finished run, or at any cached result of one, in the browser; a run can be changed there.",
    ),
    "edit": Entry("edit:EditRun", "Change a finished scene by a script: remove, move, recolour, replace its objects."),
    "cache": Group(
        "Look into the store, and take care of it.",
        {
            "ls": Entry("inspect:CacheList", "List what the latest run left in the store: a line a result."),
            "show": Entry("inspect:CacheShow", "Describe one result, or draw it as a picture."),
            "du": Entry(
                "care:CacheUsage", "Tell how much room results take, by step and by scene, and what is pinned."
            ),
            "pin": Entry(
                "pins:CachePin",
                "Keep results from being deleted by `cache gc`; without a name, list what is pinned.",
            ),
            "unpin": Entry("pins:CacheUnpin", "Let go what was pinned; `cache gc` may then delete it."),
            "gc": Entry(
                "care:CacheCollect",
                "Delete results that neither a pin nor a run needs; with limits, also those that were not used for "
                "long.",
            ),
            "verify": Entry(
                "care:CacheVerify",
                "Read the whole store, and take out what is damaged; the next run makes it again.",
            ),
        },
    ),
    "models": Group(
        "The networks that can be used.",
        {
            "list": Entry("setup:ModelsList", "List the networks that can be used, and which are here."),
            "fetch": Entry("setup:ModelsFetch", "Download a network's weights into the user's cache folder."),
            "verify": Entry("setup:ModelsVerify", "Check the weights that are here against their digests."),
        },
    ),
    "doctor": Entry(
        "setup:Doctor", "Tell whether this machine has all that runs need, and what to do where it has not."
    ),
    "completion": Entry(
        "setup:Completion",
        """Print a script with which the shell completes commands and options at the Tab key.

bash: ss-flow completion bash > ~/.local/share/bash-completion/completions/ss-flow
zsh:  ss-flow completion zsh > FOLDER/_ss-flow, where FOLDER is in your $fpath""",
    ),
}


def chosen(arguments: list[str]) -> Any:
    """The type that tyro reads `arguments` as: of the commands only those that they name are loaded.

    The others are there for the overview, and for what is said of a wrong word. A shell's completion asks for all.
    """
    every = bool(arguments) and arguments[0].replace("_", "-").startswith("--tyro-")
    return _union(COMMANDS, None if every else arguments)


def _union(commands: Mapping[str, Entry | Group], named: list[str] | None) -> Any:
    """One of several commands. named: those to load; None = all."""
    kinds = []
    for name, entry in commands.items():
        if isinstance(entry, Group):
            kind = _made(name, entry.summary, {"command": _union(entry.commands, named)})
        elif named is None or name in named:
            kind = entry.load()
        else:
            kind = _made(name, entry.summary, {})
        kinds.append(Annotated[kind, tyro.conf.subcommand(name)])
    return Union[tuple(kinds)]  # noqa: UP007 - as many as there are commands


def _made(name: str, summary: str, fields: Mapping[str, Any]) -> Any:
    """A class that is not loaded, or a group, which does what the command in it does."""
    namespace = {"__doc__": summary, "run": lambda group: group.command.run()}
    return make_dataclass(name.title(), fields.items(), namespace=namespace, frozen=True)
