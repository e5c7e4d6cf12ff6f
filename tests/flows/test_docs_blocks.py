"""Every block of code in README and docs: command lines parse, Python runs, data are read; or the block says why not.

The commands are run in test_docs_commands.py.
"""

from __future__ import annotations

import itertools
import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import tyro
import yaml
from docs_blocks import BLOCKS, ROOT, commands, of_kind

from ss_flow.cache.store import Store
from ss_flow.flows import settings
from ss_flow.flows.cli.commands import chosen
from ss_flow.flows.cli.sweep import values_of
from ss_flow.flows.edit import open_edit
from ss_flow.flows.params import Params

EXTRAS = set(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"])
PLAIN = ("mkdir", "source", "export", "kubectl", "dask", "open", "mkdocs")
"""Commands of others that the pages call without more ado."""
SHELL = [block for block in of_kind("bash", "", "text") if list(commands(block))]


def test_every_block_is_of_a_kind_that_is_checked():
    for block in BLOCKS:
        assert block.kind in ("bash", "python", "json", "yaml", "text", ""), str(block)
        if block.kind == "" and not block.marked:
            first = next((line for line in block.text.splitlines() if line.strip()), "")
            is_command = re.match(r"(ss-flow|pip|python|dask|kubectl) ", first)
            assert not is_command, f"{block} holds commands: call it bash, or put `$ ` before them"


@pytest.mark.parametrize("block", SHELL, ids=str)
def test_every_command_line_parses(block):
    for words in commands(block):
        if ">" in words:
            words = words[: words.index(">")]
        program = words[0].rpartition("/")[2]
        if program == "ss-flow":
            check_ours(words[1:], str(block))
        elif program in ("pip", "python", "python3", "pytest", "ruff", "mypy"):
            check_python(words, str(block))
        else:
            assert program in PLAIN, f"{block}: {words}"


def check_ours(arguments: list[str], where: str) -> None:
    """Read a call of ss-flow as the command line does, without running it."""
    if not arguments or arguments[-1] in ("--help", "--version"):
        return
    config = (tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff)
    try:
        tyro.cli(chosen(arguments), prog="ss-flow", args=arguments, config=config)
    except SystemExit as error:
        raise AssertionError(f"{where}: ss-flow {shlex.join(arguments)}") from error
    preset = arguments[arguments.index("--preset") + 1] if "--preset" in arguments else "default"
    params = settings.preset(Params(), preset)
    for option, assignment in itertools.pairwise(arguments):
        if option == "--set":
            name, _, value = assignment.partition("=")
            for one in values_of(value, separator=",") if arguments[0] == "sweep" else [value]:
                settings.apply(params, [f"{name}={one}"])


def check_python(words: list[str], where: str) -> None:
    """Scripts and extras that a call of Python's tools names are there."""
    for word in words[1:]:
        for extras in re.findall(r"(?:ss-flow|\.)\[([\w,]+)\]", word):
            assert set(extras.split(",")) <= EXTRAS, f"{where}: {word}"
        if word.endswith(".py") and "/" in word:
            assert (ROOT / word).is_file(), f"{where}: {word}"


@pytest.mark.parametrize("block", of_kind("json", "yaml"), ids=str)
def test_data_are_read(block):
    assert yaml.safe_load(block.text) if block.kind == "yaml" else json.loads(block.text)


EXAMPLES = [block for block in of_kind("python") if block.page != "docs/python.md"]
"""Those of docs/python.md are run in tests/test_docs.py."""


@pytest.fixture
def demo(warm, tmp_path, monkeypatch):
    """A finished run where `ss-flow demo` leaves its result, with the objects that the pages speak of."""
    monkeypatch.chdir(tmp_path)
    run = json.loads((warm.out / "run.json").read_text()) | {"store": str(warm.store)}
    listed = json.loads((warm.out / "instances.json").read_text())
    things = [entry for entry in listed["instances"] if entry["num_gaussians"]]
    for entry, name in zip(things, ("red object", "blue object", "green object"), strict=False):
        entry["name"] = name
    (warm.out / "run.json").write_text(json.dumps(run))
    (warm.out / "instances.json").write_text(json.dumps(listed))
    (tmp_path / "ss-flow-demo").mkdir()
    return warm.out.rename(tmp_path / "ss-flow-demo" / "result"), things


@pytest.mark.parametrize("block", EXAMPLES, ids=str)
def test_an_example_from_python_runs_on_a_finished_run(block, demo, tmp_path):
    names: dict[str, object] = {}
    exec(compile(block.text, str(block), "exec"), names)
    if block.page == "docs/editing.md":
        assert (tmp_path / "only-red" / "scene.ply").is_file()
    else:
        assert block.page == "docs/rasterizer.md"
        out = names["out"]
        assert out.rgb.requires_grad and out.alpha.max() > 0.5


def test_the_edit_script_of_the_page_is_one_for_a_run_that_has_its_objects(demo):
    result, things = demo
    (block,) = (block for block in of_kind("json") if "operations" in block.text)
    script = json.loads(block.text.replace('"red object", 5', f'"red object", {things[3]["id"]}'))
    store = Store(Path(json.loads((result / "run.json").read_text())["store"]))
    edit = open_edit(result, script, store)
    assert [step.number for step in edit.steps] and len(script["operations"]) == 5
