"""The documents say what is there."""

from __future__ import annotations

import importlib
import importlib.util
import re
from pathlib import Path

import pytest
from registered_tasks import registered_tasks

from ss_flow.flows import settings
from ss_flow.flows.measures import NAMES as FIGURES
from ss_flow.flows.measures import names_of
from ss_flow.flows.params import Params

ROOT = Path(__file__).parents[1]
FOLDERS = ("cache", "ss_flow", "tasks", "flows", "tests", "docs")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
TO_WRITE = {"on_slurm.py", "ss_flow_growth.py"}
"""Examples that the reader is told to write."""
TASKS = registered_tasks()
SOURCES = {file.name for folder in FOLDERS for file in (ROOT / folder).rglob("*.*")}


def script(name: str):
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def maker():
    return script("make_parameters")


def groups(parameter: str) -> list[str]:
    """The groups that a parameter is in, from the outermost on."""
    parts = parameter.split(".")
    return [".".join(parts[:count]) for count in range(1, len(parts))]


def anchors(page: Path) -> set[str]:
    """The names under which GitHub files the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_table_of_parameters_is_current(maker):
    page = maker.PAGE.read_text(encoding="utf-8")
    assert maker.with_table(page) == page, "run `python docs/make_parameters.py`"


def test_every_parameter_is_in_the_table_with_an_explanation(maker):
    rows = re.findall(r"^\| `([\w.]+)` \| (`[^|]*`) \| [^|]*\| (.+) \|$", maker.table(), re.MULTILINE)
    assert [name for name, _, _ in rows] == list(settings.flat(Params()))
    assert [name for name, _, said in rows if len(said) < 10] == []


def test_the_table_tells_what_0_and_1_mean_and_where_a_preset_differs(maker):
    assert (
        maker.in_short("Most points. More are thinned out. 0 = all. 1 in the paper.")
        == "Most points. 0 = all. 1 in the paper."
    )
    row = next(line for line in maker.table().splitlines() if line.startswith("| `splat.reconstruct.max_iterations` |"))
    assert "paper `1000`<br>paper_lerf `10000`<br>reference `1000`" in row
    assert maker.table().count("paper_lerf") == 3


def test_a_page_without_the_marks_is_refused(maker):
    with pytest.raises(ValueError, match=r"parameters\.md lacks"):
        maker.with_table("# Parameters\n")


def test_the_plots_are_drawn_from_the_tables_of_the_pages(tmp_path):
    plots = script("make_plots")
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    drawn = plots.draw(tmp_path)
    assert [path.name for path in drawn] == [f"{plot.__name__}.svg" for plot in plots.PLOTS]
    assert set(re.findall(r"\(images/(\w+\.svg)\)", page)) == {path.name for path in drawn}
    assert plots.table("measurements/splat.md", "Time and memory")[1][:3] == ["room 50", "54", "108 s"]
    with pytest.raises(ValueError, match="no table under 'Nothing'"):
        plots.table("engine.md", "Nothing")


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_every_relative_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", target):
            continue
        place, _, anchor = target.partition("#")
        found = (page.parent / place).resolve() if place else page
        assert found.exists(), f"{page.name} links to {target}"
        assert not anchor or anchor in anchors(found), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_every_source_file_and_parameter_that_a_page_names_exists(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:tasks|flows|tests|docs|ss_flow|cache)/[\w./]*)`", text):
        assert (ROOT / name).exists(), f"{page.name} names {name}"
    for name in re.findall(r"(?:--set |`)((?:capture|split|splat|semantics|evaluate)(?:\.\w+)+)=", text):
        settings.find(Params(), name)
    for name in re.findall(r"`(\w+\.(?:py|h|cpp|jinja))`", text):
        assert name in SOURCES or name in TO_WRITE, f"{page.name} names {name}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_every_dotted_name_of_a_page_is_a_parameter_a_group_of_them_a_step_or_a_figure(page):
    known = {*TASKS, *names_of(FIGURES)} | {name for one in settings.flat(Params()) for name in groups(one)}
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:capture|split|splat|semantics|evaluate)(?:\.\w+)+)`", text):
        if name not in known and not name.endswith((".md", ".py")):
            settings.find(Params(), name)  # a short name


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_functions_in_the_tables_of_a_page_stand_in_the_files_beside_them(page):
    for names, file in re.findall(r"((?:`\w+`(?: and )?)+) in `([\w/]+\.py)`", page.read_text(encoding="utf-8")):
        source = (ROOT / file).read_text(encoding="utf-8")
        for name in re.findall(r"`(\w+)`", names):
            assert re.search(rf"^(?:def|class) {name}\b", source, re.MULTILINE), f"{name} is not in {file}"


def test_every_repaired_ambiguity_has_the_values_of_the_presets_or_names_the_test_that_holds_it(maker):
    page = (ROOT / "docs" / "algorithm.md").read_text(encoding="utf-8")
    section = page.partition("## Repaired ambiguities")[2].partition("\n## ")[0]
    _, _, *rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    presets = [settings.flat(settings.preset(Params(), name)) for name in ("default", "paper", "reference")]
    assert len(rows) > 30
    for number, _, _, held in rows:
        if re.fullmatch(r"`test_\w+` in `tests/[\w/]+\.py`", held):
            continue  # that it stands there, the test above holds
        for entry in held.split("<br>"):
            name, values = re.fullmatch(r"`([\w.]+)` (.+)", entry).groups()
            assert values == ", ".join(maker.shown(preset[name]) for preset in presets), f"{number}: {name}"


def test_every_parameter_in_which_default_leaves_the_paper_is_on_the_page_or_its_group_is():
    page = (ROOT / "docs" / "algorithm.md").read_text(encoding="utf-8")
    ours, *theirs = (settings.flat(settings.preset(Params(), name)) for name in ("default", "paper", "reference"))
    # The groups of a step's own parameters, such as `splat.merge`, are too wide to tell anything.
    told = {name for name in re.findall(r"`([a-z_.]+)`", page) if name in ours or name.count(".") > 1}
    changed = [name for name in ours if any(preset[name] != ours[name] for preset in theirs)]
    assert len(changed) > 100
    assert [name for name in changed if told.isdisjoint({name, name.rpartition(".")[0]})] == []


def test_the_readme_has_two_command_lines_to_install_run_and_test():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    block = text.partition("<!-- commands -->")[2].partition("<!-- end -->")[0]
    lines = [line for line in block.splitlines() if line.strip() and not line.startswith("```")]
    assert len(lines) == 2
    assert lines[0].endswith("&& .venv/bin/ss-flow demo")
    assert lines[1].endswith("&& .venv/bin/pytest -n auto --dist loadfile")


def test_the_examples_from_python_run_and_print_what_the_page_says(tmp_path, monkeypatch, capsys):
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(python|text)\n(.*?)```", page, re.DOTALL)
    (_, module), *rest = blocks
    (tmp_path / "ss_flow_growth.py").write_text(module, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    printed = ""
    for kind, text in rest:
        if kind == "python":
            exec(compile(text, "docs/python.md", "exec"), names)
            printed = capsys.readouterr().out
        else:
            assert printed == text
    assert sum(kind == "text" for kind, _ in rest) == 4
