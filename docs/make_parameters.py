"""Write the table of all parameters into docs/parameters.md: `python docs/make_parameters.py`.

Names and defaults come from `ss_flow.flows.params`, explanations from the docstrings under the fields, and the columns
of the presets from their files, so that the page cannot drift from the code; a test asserts that it is current.
"""

from __future__ import annotations

import ast
import functools
import importlib.util
import itertools
import re
from pathlib import Path
from typing import Any

from ss_flow.flows import settings
from ss_flow.flows.params import Params

PAGE = Path(__file__).with_name("parameters.md")
BEGIN, END = "<!-- table of parameters: written by make_parameters.py -->", "<!-- end of the table -->"
HEAD = ("| parameter | default | presets | what it is |", "|---|---|---|---|")
PRESETS = {"paper": "default", "paper_lerf": "paper", "reference": "default", "fast": "default", "thorough": "default"}
"""Those that have a place in the column of presets, each with the one that it is compared with."""
HEADINGS = {
    "capture": "Capture: photos, poses, depth",
    "split": "Split: masks to view-consistent instances",
    "splat": "Splat: instances to Gaussians to one scene",
    "semantics": "Semantics: Gaussians to descriptors to text",
    "evaluate": "Evaluate: measuring against ground truth",
}


def table() -> str:
    """One table for each part of the DAG, in Markdown."""
    params = Params()
    presets = {name: settings.flat(settings.preset(Params(), name)) for name in ("default", *PRESETS)}
    blocks: list[str] = []
    part = ""
    for path, value in settings.leaves(params):
        if path[0] != part:
            part = path[0]
            blocks += ["", f"### {HEADINGS[part]}", "", *HEAD]
        name = ".".join(path)
        others = [
            f"{preset} {shown(presets[preset][name])}"
            for preset, base in PRESETS.items()
            if presets[preset][name] != presets[base][name]
        ]
        owner = type(functools.reduce(getattr, path[:-1], params))
        said = in_short(docstrings_of(owner.__module__, owner.__name__)[path[-1]])
        blocks.append(f"| `{name}` | {shown(value)} | {'<br>'.join(others)} | {said} |")
    return "\n".join(blocks).strip() + "\n"


@functools.cache
def docstrings_of(module: str, name: str) -> dict[str, str]:
    """The docstring under each field of a dataclass that has one."""
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    body = next(n.body for n in ast.walk(tree) if isinstance(n, ast.ClassDef) and n.name == name)
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }


def in_short(text: str) -> str:
    """The first sentence, and those that tell what 0 or 1 means, ready for a cell of a table."""
    first, *others = re.split(r"(?<=\.) ", text)
    return " ".join([first, *(one for one in others if re.match("[01] ", one))]).replace("|", "\\|")


def with_table(page: str) -> str:
    """The page with the table as it is now. Raises ValueError when the page lacks the marks around it."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{PAGE.name} lacks the lines {BEGIN} and {END}")
    return f"{before}{BEGIN}\n\n{table()}\n{END}{after}"


def shown(value: Any) -> str:
    """A value as the pages write it."""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, float):
        return f"`{value:.4g}`"
    if isinstance(value, tuple):
        return f"`{', '.join(f'{item:g}' if isinstance(item, float) else str(item) for item in value)}`"
    return f"`{'none' if value is None else value}`"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
