"""Code that is edited while a run goes on: a key stands for the code that computed its result."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
import textwrap
import time
from pathlib import Path

import pytest

from ss_flow import closure, distributions, sameness
from ss_flow.engine import run_flow
from ss_flow.errors import ExecutorLost
from ss_flow.events import Reporter

STEPS = """
    import numpy as np

    from ss_flow.task import task
    from ss_flow_toy import Number, number
    from probed_helper import double


    @task()
    def first(*, value: float) -> Number:
        return number(value)


    @task()
    def second(x: Number) -> Number:
        return number(double(float(x.value[0])))


    @task(isolate=True)
    def alone(x: Number) -> Number:
        return number(double(float(x.value[0])))


    @task()
    def late(x: Number) -> Number:
        from probed_late import double

        return number(double(float(x.value[0])))
"""
PACKAGED = """

    @task()
    def packaged(x: Number) -> Number:
        from probed_package import double

        return number(double(float(x.value[0])))
"""
HELPER = "def double(x):\n    return 2 * x\n"
EDITED = "def double(x):\n    return x + x + 1\n"


class Editing(Reporter):
    """Edits a file as soon as something happens to a step."""

    def __init__(self, path, kind, step):
        self.path, self.moment = path, (kind, step)

    def event(self, kind, **details):
        if (kind, details.get("step")) == self.moment:
            self.path.write_text(EDITED)


@pytest.fixture
def probed(tmp_path, monkeypatch):
    """Modules of tasks in a folder, and a function that imports them as a new process would."""
    folder = tmp_path / "code"
    folder.mkdir()
    (folder / "ss_flow_probed.py").write_text(textwrap.dedent(STEPS))
    for name in ("helper", "late"):
        (folder / f"probed_{name}.py").write_text(HELPER)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # whose times are too coarse for what is edited at once

    def forget():
        for name in [n for n in sys.modules if n.startswith(("ss_flow_probed", "probed_"))]:
            del sys.modules[name]
        importlib.invalidate_caches()
        closure.forget()

    def load():
        forget()
        return importlib.import_module("ss_flow_probed")

    load.folder, load.forget = folder, forget
    yield load
    closure.forget()


def run(store, steps, name, reporter=None):
    """The value of a step, and what happened to it."""
    task = getattr(steps, name)
    report = run_flow(lambda: {"x": task(steps.first(value=3.0))}, store, scene="probed", reporter=reporter, jobs=1)
    return float(store.get(report.values["x"]).value[0]), report.nodes[-1]["event"]


def test_what_the_old_code_computed_is_no_result_of_the_code_that_was_edited_meanwhile(store, probed):
    editing = Editing(probed.folder / "probed_helper.py", "finished", "ss_flow_probed.first")
    assert run(store, probed(), "second", editing) == (6.0, "finished")
    assert run(store, probed(), "second") == (7.0, "finished")
    (probed.folder / "probed_helper.py").write_text(HELPER)
    assert run(store, probed(), "second") == (6.0, "hit")


def test_a_key_stands_for_the_code_as_it_was_loaded_long_before_the_run(store, probed):
    steps = probed()
    (probed.folder / "probed_helper.py").write_text(EDITED)
    assert run(store, steps, "second") == (6.0, "finished")
    assert run(store, probed(), "second") == (7.0, "finished")


def test_code_that_is_loaded_again_counts_as_it_is_then(store, probed):
    steps = probed()
    assert run(store, steps, "second") == (6.0, "finished")
    (probed.folder / "probed_helper.py").write_text(EDITED)
    importlib.reload(sys.modules["probed_helper"])
    assert run(store, importlib.reload(steps), "second") == (7.0, "finished")


def test_a_function_of_before_its_module_was_loaded_again_is_refused(store, probed):
    steps = probed()
    assert run(store, steps, "second") == (6.0, "finished")
    (probed.folder / "probed_helper.py").write_text(EDITED)
    importlib.reload(sys.modules["probed_helper"])
    with pytest.raises(ExecutorLost, match=r"ss_flow_probed holds probed_helper\.double as it was before"):
        run(store, steps, "second")
    assert run(store, importlib.reload(steps), "second") == (7.0, "finished")


def test_a_module_that_is_loaded_again_unchanged_is_the_same(store, probed):
    steps = probed()
    importlib.reload(sys.modules["probed_helper"])
    assert run(store, steps, "second") == (6.0, "finished")


@pytest.mark.parametrize("before", [HELPER, "FACTOR = 2\n\n\ndef double(x):\n    return FACTOR * x\n"])
def test_what_was_put_into_a_module_that_stays_loaded_is_refused(store, probed, before):
    file = probed.folder / "probed_helper.py"
    file.write_text(before)
    steps = probed()
    assert run(store, steps, "second") == (6.0, "finished")
    helper = sys.modules["probed_helper"]
    if before == HELPER:  # as IPython's autoreload does it
        file.write_text(EDITED)
        edited = {}
        exec(EDITED, vars(helper), edited)
        helper.double.__code__ = edited["double"].__code__
    else:
        file.write_text(before.replace("2", "3"))
        helper.FACTOR = 3
    with pytest.raises(ExecutorLost, match="probed_helper was edited after it was loaded"):
        run(store, steps, "second")
    importlib.reload(helper)
    value, happened = run(store, importlib.reload(steps), "second")
    assert value > 6 and happened == "finished"


def test_what_is_put_below_the_tasks_of_a_module_before_the_first_run_is_refused(store, probed):
    file = probed.folder / "ss_flow_probed.py"
    text = file.read_text().replace("from probed_helper import double\n", "") + f"\n\n{HELPER}"
    file.write_text(text)
    steps = probed()
    file.write_text(text.replace(HELPER, EDITED))
    exec(EDITED, vars(steps))
    with pytest.raises(ExecutorLost, match="ss_flow_probed was edited after it was loaded"):
        run(store, steps, "second")
    assert run(store, importlib.reload(steps), "second") == (7.0, "finished")


def test_what_a_module_changes_of_itself_does_not_count_as_edited(store, probed):
    helper = probed.folder / "probed_helper.py"
    helper.write_text(f"calls = 0\n\n\n{HELPER}")
    steps = probed()
    assert run(store, steps, "second") == (6.0, "finished")
    sys.modules["probed_helper"].calls = 1
    helper.write_text(f"calls = 0\n\n\n{EDITED}")
    assert run(store, steps, "second") == (6.0, "hit")


def test_a_helper_that_was_edited_between_being_loaded_and_the_first_task_is_refused(store, probed):
    probed.forget()
    importlib.import_module("probed_helper")
    (probed.folder / "probed_helper.py").write_text(EDITED)
    steps = importlib.import_module("ss_flow_probed")
    with pytest.raises(ExecutorLost, match="probed_helper was edited after it was loaded"):
        run(store, steps, "second")
    importlib.reload(sys.modules["probed_helper"])
    assert run(store, importlib.reload(steps), "second") == (7.0, "finished")


@pytest.mark.parametrize(
    ("step", "file", "moment"),
    [
        ("alone", "probed_helper.py", ("finished", "ss_flow_probed.first")),
        ("late", "probed_late.py", ("started", "ss_flow_probed.late")),
    ],
    ids=["by a process that starts late", "within a task"],
)
def test_code_that_was_edited_before_it_is_loaded_is_refused(store, probed, step, file, moment):
    with pytest.raises(ExecutorLost, match=f"otherwise than its key says: code of ss_flow_probed:{step} changed"):
        run(store, probed(), step, Editing(probed.folder / file, *moment))
    assert run(store, probed(), step) == (7.0, "finished")


def test_bytecode_that_python_takes_for_that_of_an_edited_file_is_refused(store, probed, monkeypatch):
    file = probed.folder / "probed_helper.py"
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    for text in (HELPER, HELPER.replace("2", "3")):
        file.write_text(text)
        os.utime(file, (1, 1))
        steps = probed()
        if text == HELPER:
            assert run(store, steps, "second") == (6.0, "finished")
            assert run(store, probed(), "second") == (6.0, "hit")
    assert steps.double(3.0) == 6.0  # Python compares sizes and times alone
    with pytest.raises(ExecutorLost, match=r"probed_helper was loaded from .*__pycache__.*: delete that, and start"):
        run(store, steps, "second")
    Path(sys.modules["probed_helper"].__cached__).unlink()
    assert run(store, probed(), "second") == (9.0, "finished")


class Updating(Reporter):
    """Updates a package as soon as a step has begun."""

    def __init__(self, site):
        self.site = site

    def event(self, kind, **details):
        if (kind, details.get("step")) == ("started", "ss_flow_probed.packaged"):
            install(self.site, "2.0", EDITED)


def install(site, version, text):
    for old in site.glob("*.dist-info"):
        shutil.rmtree(old)
    about = site / f"probed_package-{version}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: probed-package\nVersion: {version}\n")
    (about / "RECORD").write_text("probed_package.py,sha256=x,1\n")
    (site / "probed_package.py").write_text(text)


def test_a_package_that_is_updated_before_it_is_loaded_is_refused(store, probed, monkeypatch):
    site = probed.folder.parent / "site-packages"
    install(site, "1.0", HELPER)
    monkeypatch.syspath_prepend(str(site))
    (probed.folder / "ss_flow_probed.py").write_text(textwrap.dedent(STEPS) + textwrap.dedent(PACKAGED))

    def load():
        forget_packages()
        return probed()

    steps = load()
    time.sleep(0.05)  # as fine as a kernel's clock
    with pytest.raises(ExecutorLost, match=r"its key says: package probed-package 1\.0 -> 2\.0"):
        run(store, steps, "packaged", Updating(site))
    assert run(store, load(), "packaged") == (7.0, "finished")
    install(site, "1.0", HELPER)
    assert run(store, load(), "packaged") == (6.0, "finished")
    forget_packages()


def forget_packages():
    for name in ("_distributions", "_read", "_folders", "is_distributed"):
        getattr(distributions, name).cache_clear()
    sameness._recipe.cache_clear()


def test_a_package_that_was_updated_before_its_version_was_read_is_refused(probed, monkeypatch):
    site = probed.folder.parent / "site-packages"
    install(site, "1.0", HELPER)
    monkeypatch.syspath_prepend(str(site))
    forget_packages()
    probed.forget()
    assert distributions.is_distributed("probed_package")
    install(site, "2.0", EDITED)
    with pytest.raises(ExecutorLost, match="site-packages was updated or removed since this process began"):
        distributions.versions_of("probed_package")
    forget_packages()
    assert distributions.versions_of("probed_package") == {"probed-package": "2.0"}
    forget_packages()
