from __future__ import annotations

import importlib
import zipfile
from importlib.machinery import EXTENSION_SUFFIXES

import pytest

from ss_flow import closure

STEP = """
from probe.maths import twice

def run(x):
    return twice(x)
"""
MATHS = """
FACTOR = 2

def twice(x):
    return FACTOR * x

def unrelated(x):
    return x
"""


def test_the_closure_holds_helpers_and_constants_but_nothing_unrelated(package):
    assert set(package(step=STEP, maths=MATHS)) == {"probe.step.run", "probe.maths.twice", "probe.maths.FACTOR"}


@pytest.mark.parametrize(
    "edit",
    [
        lambda s: s.replace("def twice", "# a remark\ndef twice"),
        lambda s: s.replace("    return FACTOR * x", '    """Says what it does."""\n    return (FACTOR\n  * x)'),
        lambda s: s.replace("return x", "return -x"),
    ],
    ids=["comment", "docstring and layout", "unrelated function"],
)
def test_an_edit_that_cannot_change_the_result_changes_no_digest(package, edit):
    assert package(step=STEP, maths=MATHS) == package(step=STEP, maths=edit(MATHS))


@pytest.mark.parametrize(
    ("edit", "changed"),
    [
        (lambda s: s.replace("FACTOR * x", "FACTOR + x"), "probe.maths.twice"),
        (lambda s: s.replace("FACTOR = 2", "FACTOR = 3"), "probe.maths.FACTOR"),
    ],
    ids=["helper", "constant"],
)
def test_an_edited_helper_or_constant_is_named(package, edit, changed):
    before, after = package(step=STEP, maths=MATHS), package(step=STEP, maths=edit(MATHS))
    assert {name for name in before if before[name] != after[name]} == {changed}


@pytest.mark.parametrize(
    "step",
    [
        "def run(x):\n    from probe.maths import twice\n    return twice(x)\n",
        "from probe import maths\n\ndef run(x):\n    return maths.twice(x)\n",
        "from .maths import twice as double\n\ndef run(x):\n    return double(x)\n",
        "import probe.maths as m\n\ndef run(x):\n    return m.twice(x)\n",
        "import probe.maths\n\ndef run(x):\n    return probe.maths.twice(x)\n",
        "def run(x):\n    import probe.maths\n    return probe.maths.twice(x)\n",
        "import probe as p\n\ndef run(x):\n    return p.maths.twice(x)\n",
        "from probe.maths import *\n\ndef run(x):\n    return twice(x)\n",
        "from probe.all import *\n\ndef run(x):\n    return twice(x)\n",
        "from probe.all import m\n\ndef run(x):\n    return m.twice(x)\n",
        "import contextlib\nwith contextlib.suppress(ImportError):\n    from probe.maths import twice\n\n"
        "def run(x):\n    return twice(x)\n",
    ],
    ids=[
        "local import",
        "module attribute",
        "relative import with alias",
        "module alias",
        "dotted",
        "dotted, local",
        "dotted through an alias",
        "star",
        "star of a star",
        "alias of another module",
        "in a block",
    ],
)
def test_every_form_of_import_is_followed(package, step):
    further = "from probe.maths import *\nfrom probe.all import *\nfrom probe import maths as m\n"
    assert "probe.maths.FACTOR" in package(step=step, maths=MATHS, all=further)


def test_a_function_of_a_script_is_refused_since_its_code_cannot_be_followed():
    exec("def run(x):\n    return x\n", namespace := {"__name__": "__main__"})
    with pytest.raises(TypeError, match=r"code of __main__\.run cannot be followed"):
        closure.closure_of(namespace["run"])


def test_what_only_a_type_checker_sees_does_not_count(package):
    step = """
        from __future__ import annotations
        from typing import TYPE_CHECKING
        if TYPE_CHECKING:
            from probe.maths import twice

        def run(x: twice):
            return x
    """
    assert set(package(step=step, maths=MATHS)) == {"probe.step.run"}


def test_the_task_decorator_does_not_count_but_other_decorators_do(package):
    plain = package(step="from ss_flow.task import task, Resources\n\n@task()\ndef run(x: int) -> int:\n    return x\n")
    more = package(
        step="from ss_flow.task import task, Resources\n\n"
        "@task(resources=Resources(cores=2))\ndef run(x: int) -> int:\n    return x\n"
    )
    cached = package(step="import functools\n\n@functools.cache\ndef run(x: int) -> int:\n    return x\n")
    assert plain == more != cached


def test_native_sources_of_a_module_count(package, tmp_path):
    (tmp_path / "probe" / "kernel.cpp").write_text("int f() { return 1; }")
    module = 'NATIVE_SOURCES = ("kernel.cpp",)\n\ndef twice(x):\n    return x\n'
    before = package(step=STEP, maths=module)
    (tmp_path / "probe" / "kernel.cpp").write_text("int f() { return 2; }")
    after = package(step=STEP, maths=module)
    assert {name for name in before if before[name] != after[name]} == {"probe.maths:kernel.cpp"}


def test_functions_that_call_each_other_end(package):
    step = "def run(x):\n    return other(x)\n\ndef other(x):\n    return run(x)\n"
    assert set(package(step=step)) == {"probe.step.run", "probe.step.other"}


def test_a_package_that_imports_a_module_of_its_own_under_the_name_of_the_module_ends(package):
    step = "from probe import maths\n\ndef run(x):\n    return maths.twice(x)\n"
    assert "probe.maths.FACTOR" in package(step=step, maths=MATHS, __init__="from . import maths\n")


def modules_of(package, **modules: str) -> frozenset[str]:
    package(**modules)
    return closure.closure_of(importlib.import_module("probe.step").run).modules


@pytest.mark.parametrize(
    "step",
    [
        "import scipy.ndimage\n\ndef run(x):\n    return scipy.ndimage.label(x)\n",
        "def run(x):\n    import scipy.ndimage as nd\n    return nd.label(x)\n",
        "def run(x):\n    from scipy.ndimage import label\n    return label(x)\n",
        "def run(x):\n    import scipy  # for what it does when it is imported\n    return x\n",
        "def run(x):\n    def inner():\n        import scipy\n    return inner\n",
        "from probe.maths import label\n\ndef run(x):\n    return label(x)\n",
        "from probe import maths\n\ndef run(x):\n    return maths.label(x)\n",
        "from probe.maths import outer\n\ndef run(x):\n    return outer(x)\n",
        "import importlib\n\ndef run(x):\n    return importlib.import_module('scipy.ndimage')\n",
        "try:\n    import scipy as lib\nexcept ImportError:\n    import math as lib\n\ndef run(x):\n    return lib\n",
    ],
    ids=[
        "top", "local alias", "local name", "never named", "nested", "through another module",
        "attribute of another module", "of a helper", "by name", "one of two",
    ],
)  # fmt: skip
def test_every_form_of_import_of_a_library_is_seen(package, step):
    maths = "from scipy.ndimage import label\n\ndef outer(x):\n    return label(x)\n"
    assert modules_of(package, step=step, maths=maths) == {"scipy"}


@pytest.mark.parametrize(
    "step",
    [
        "import scipy\n\ndef run(x):\n    return x\n",
        "import math\nfrom collections import abc\n\ndef run(x):\n    import os.path\n    return math, abc, os\n",
        "from probe.maths import twice\nfrom ss_flow.running import warn\n\ndef run(x):\n    return warn(twice(x))\n",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import scipy\n\ndef run(x: 'scipy'):\n    return x\n",
        "import scipy\nfrom ss_flow.task import task\n\n"
        "@task(environment=lambda: {'x': scipy})\ndef run(x: int) -> int:\n    return x\n",
    ],
    ids=["not used", "of Python", "ours", "for type checkers", "of the task's declaration"],
)
def test_what_no_result_depends_on_is_not_among_the_libraries(package, step):
    assert modules_of(package, step=step, maths=MATHS) == frozenset()


def test_of_two_things_imported_under_one_name_both_are_followed(package):
    step = """
        def run(x):
            if x:
                from probe.maths import twice as chosen
            else:
                from probe.maths import unrelated as chosen
            return chosen(x)
    """
    assert {"probe.maths.twice", "probe.maths.unrelated"} <= set(package(step=step, maths=MATHS))


def test_what_one_method_imports_hides_from_another_nothing_that_its_module_imports(package):
    step = """
    from probe.maths import twice

    class Both:
        def ours(self, x):
            return twice(x)

        def theirs(self, x):
            from probe.others import twice

            return twice(x)

    def run(x):
        return Both().ours(x)
    """
    found = package(step=step, maths=MATHS, others="def twice(x):\n    return 2 * x\n")
    assert {"probe.maths.twice", "probe.others.twice"} <= set(found)


def test_the_branches_of_single_dispatch_belong_to_the_function(package):
    step = """
    import functools
    from probe.maths import twice

    def run(x):
        return told(x)

    @functools.singledispatch
    def told(x):
        return x

    @told.register
    def _(x: int):
        return twice(x)

    @told.register(list)
    @told.register(tuple)
    def _(x):
        return 3
    """
    found = package(step=step, maths=MATHS)
    assert "probe.maths.twice" in found
    edited = package(step=step.replace("return 3", "return 4"), maths=MATHS)
    assert {name for name in found if found[name] != edited[name]} == {"probe.step.told"}


EDITS = {
    "what is imported from a library": ("from numpy import mean as reduce\n", "mean", "median", "reduce(x)"),
    "what is imported from Python": ("from math import floor as rounded\n", "floor", "ceil", "rounded(x)"),
    "names exchanged": ("from probe.maths import twice as f, unrelated as g\n", "f, unrelated as g",
                        "g, unrelated as f", "f(g(x))"),
    "flag of a condition": ("HIGH = True\nif HIGH:\n    N = 1\nelse:\n    N = 2\n", "True", "False", "N"),
    "condition": ("if 1 > 0:\n    N = 1\nelse:\n    N = 2\n", "1 > 0", "1 < 0", "N"),
    "outer condition": ("if 1 > 0:\n    if True:\n        N = 1\n", "1 > 0", "1 < 0", "N"),
    "condition of a function": ("if 1 > 0:\n    def f(x): return x\n", "1 > 0", "1 > 2", "f(x)"),
    "condition of an import": ("if 1 > 0:\n    from math import sin as f\nelse:\n    from math import cos as f\n",
                               "1 > 0", "1 > 2", "f(x)"),
    "not for type checkers": ("from typing import TYPE_CHECKING\nif not TYPE_CHECKING:\n    N = 1\n",
                              "= 1", "= 2", "N"),
    "named in an expression": ("print(N := 3)\n", "3", "4", "N"),
    "named in a condition": ("if (N := 3) > 1:\n    pass\n", "3", "4", "N"),
    "group of exceptions": ("try:\n    N = 3\nexcept* ValueError:\n    N = 2\n", "3", "4", "N"),
    "filled by a decorator": (
        "TABLE = {}\ndef add(f):\n    TABLE[f.__name__] = f\n    return f\n@add\ndef g(): return 3\n",
        "3", "4", "TABLE"),
    "filled by a decorator with arguments": (
        "TABLE = {}\ndef add(n):\n    def inner(f):\n        TABLE[n] = f\n        return f\n    return inner\n"
        "@add(1)\ndef g(): return 3\n", "3", "4", "TABLE"),
    "filled by a call of a call": (
        "TABLE = {}\ndef add(n, v):\n    TABLE[n] = v\ndef fill():\n    add('f', 3)\nfill()\n", "3", "4", "TABLE"
    ),
    "filled by a call": ("TABLE = {}\ndef add(n, v):\n    TABLE[n] = v\nadd('f', 3)\n", "3", "4", "TABLE"),
    "set by a call": ("TABLE = None\ndef _start():\n    global TABLE\n    TABLE = 3\n_start()\n", "3", "4", "TABLE"),
    "registered by a method": (
        "class Table(dict):\n    def add(self, f):\n        self[f.__name__] = f\n        return f\n"
        "TABLE = Table()\n@TABLE.add\ndef g(): return 3\n", "return 3", "return 4", "TABLE"),
    "class that is registered": (
        "class Table(dict):\n    def register(self, f):\n        self[f.__name__] = f\n        return f\n"
        "TABLE = Table()\n@TABLE.register\nclass G:\n    k = 3\n", "k = 3", "k = 4", "TABLE"),
    "classes changed in a loop": ("class A: pass\nclass B: pass\nfor one in (A, B):\n    one.k = 3\n", "3", "4", "A.k"),
    "what a library is told": (
        "import numpy as np\nnp.set_printoptions(precision=3)\n", "3", "5", "np.array2string(x)"),
    "what a library is told by a part of it": (
        "import decimal\nfrom decimal import Decimal\ndecimal.getcontext().prec = 3\n", "3", "5", "Decimal(x)"),
    "which exception": ("try:\n    raise KeyError\nexcept KeyError:\n    N = 1\nexcept LookupError:\n    N = 2\n",
                        "except KeyError", "except ValueError", "N"),
    "module as a value": ("from probe import maths\n", "", "", "{1: maths}[1].twice(x)"),
}  # fmt: skip


@pytest.mark.parametrize("case", EDITS)
def test_an_edit_that_changes_what_a_name_stands_for_is_seen(package, case):
    before, old, new, used = EDITS[case]
    step = f"{before}\ndef run(x):\n    return {used}\n"
    found = package(step=step, maths=MATHS)
    maths = MATHS if old else MATHS.replace("2", "3")
    assert found != package(step=step.replace(before, before.replace(old, new)) if old else step, maths=maths)


PASSED_ON = {
    "name of a library": ("from numpy import mean as f\n", "mean", "median", "probe.f(x)"),
    "names": ("from probe.maths import twice as f, unrelated as g\n", "f, unrelated as g", "g, unrelated as f",
              "probe.f(x) - probe.g(x)"),
    "modules": ("from probe import maths as f, other as g\n", "f, other as g", "g, other as f",
                "probe.f.twice(x) - probe.g.twice(x)"),
}  # fmt: skip


@pytest.mark.parametrize("case", PASSED_ON)
def test_what_a_package_passes_on_counts(package, case):
    passing, old, new, used = PASSED_ON[case]
    modules = {"step": f"import probe\n\ndef run(x):\n    return {used}\n", "maths": MATHS, "other": MATHS}
    found, edited = (package(**modules, __init__=text) for text in (passing, passing.replace(old, new)))
    assert "probe.f" in found and {name for name in found if found[name] != edited[name]} == {
        name for name in found if name.startswith("probe.") and name.count(".") == 1
    }


def test_of_two_modules_that_a_package_passes_on_under_one_name_both_are_followed(package):
    passing = "try:\n    from probe import fast as f\nexcept ImportError:\n    from probe import maths as f\n"
    modules = {"maths": MATHS, "fast": "import not_here\n\ndef twice(x):\n    return x\n", "__init__": passing}
    found = package(step="import probe\n\ndef run(x):\n    return probe.f.twice(x)\n", **modules)
    assert {"probe.fast.twice", "probe.maths.twice"} <= set(found)


def test_what_a_module_that_is_used_as_a_value_passes_on_counts(package):
    step = "from probe import passing\n\ndef run(x, how):\n    return getattr(passing, how)(x)\n"
    assert "probe.maths.twice" in package(step=step, passing="from probe.maths import twice\n", maths=MATHS)


def test_a_library_of_which_all_is_imported_counts(package):
    step = "from scipy.special import *\n\ndef run(x):\n    return expit(x)\n"
    assert modules_of(package, step=step) == {"scipy"}


@pytest.mark.parametrize("hints", ["x: 'Out'", "x: list['Out']", "x: 'list[Out]'"])
def test_a_class_that_only_an_annotation_in_quotes_names_is_followed(package, hints):
    step = f"class Out:\n    pass\n\ndef twice():\n    pass\n\ndef run({hints}) -> Literal['twice']:\n    return x\n"
    assert set(package(step=f"from typing import Literal\n{step}")) == {"probe.step.run", "probe.step.Out"}


def test_a_name_that_a_module_makes_when_it_is_asked_for_leads_to_what_makes_it(package):
    lazy = "def late(x):\n    return x\n\n\ndef __getattr__(name):\n    return late\n"
    for step in ("from probe.lazy import made\n\n\ndef run(x):\n    return made(x)\n",
                 "import probe.lazy\n\n\ndef run(x):\n    return probe.lazy.made(x)\n"):  # fmt: skip
        assert set(package(step=step, lazy=lazy)) == {"probe.step.run", "probe.lazy.__getattr__", "probe.lazy.late"}


def test_how_text_is_written_does_not_count(package):
    assert package(step="def run(x):\n    return u'abc'\n") == package(step="def run(x):\n    return 'abc'\n")


@pytest.mark.parametrize("way", ["import ss_flow.task as sst", "from ss_flow import task as sst"])
def test_the_task_decorator_does_not_count_whatever_it_is_called(package, way):
    step = "@sst.task({})\ndef run(x: int) -> int:\n    return x\n"
    plain, more = (package(step=f"{way}\n{step.format(given)}") for given in ("", "isolate=True"))
    assert plain == more
    other = "def task(given):\n    return lambda f: f\n"
    one, two = (package(step=f"from probe import other as sst\n{step.format(x)}", other=other) for x in (1, 2))
    assert one != two


def test_a_module_beside_that_no_distribution_holds_is_followed(package, tmp_path):
    (tmp_path / "beside_probe.py").write_text("def f(x):\n    return x\n")
    step = "from beside_probe import f\nimport numpy as np\n\ndef run(x):\n    return np.abs(f(x))\n"
    assert {"beside_probe.f"} < set(package(step=step))
    assert modules_of(package, step=step) == {"numpy"}


def test_a_module_elsewhere_that_no_distribution_holds_is_followed(package, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "far_probe.py").write_text("def f(x):\n    return x\n")
    monkeypatch.syspath_prepend(tmp_path / "elsewhere")
    assert "far_probe.f" in package(step="import far_probe\n\ndef run(x):\n    return far_probe.f(x)\n")
    assert modules_of(package, step="import far_probe\n\ndef run(x):\n    return far_probe.f(x)\n") == frozenset()


@pytest.mark.parametrize(
    ("form", "call"),
    [
        ("import {}.ops", "{}.ops.edge"),
        ("from {} import ops", "ops.edge"),
        ("from {}.ops import edge", "edge"),
        ("import {} as sub", "sub.ops.edge"),
    ],
)
@pytest.mark.parametrize("name", ["loose_probe", "probe.sub"])
def test_a_folder_without_an_init_is_followed(package, tmp_path, name, form, call):
    folder = tmp_path / name.replace(".", "/")
    folder.mkdir()
    (folder / "ops.py").write_text("def edge(x):\n    return x\n")
    step = f"{form}\n\ndef run(x):\n    return {call}(x)\n".replace("{}", name)
    assert f"{name}.ops.edge" in package(step=step)


@pytest.mark.parametrize(
    "step",
    [
        "def run(x):\n    import fast_probe\n    return fast_probe.f(x)\n",
        "def run(x):\n    from fast_probe import f\n    return f(x)\n",
        "def run(x):\n    import fast_probe\n    return vars(fast_probe)['f'](x)\n",
    ],
    ids=["attribute", "name", "as a value"],
)
def test_compiled_code_that_no_distribution_holds_counts_as_a_whole(package, tmp_path, step):
    def digest_of(content: bytes) -> str:
        (tmp_path / f"fast_probe{EXTENSION_SUFFIXES[0]}").write_bytes(content)
        return package(step=step)["fast_probe"]

    assert digest_of(b"2.0") != digest_of(b"7.0")


def test_a_source_in_another_encoding_is_read_as_python_reads_it(package, tmp_path):
    (tmp_path / "latin_probe.py").write_bytes(b"# -*- coding: latin-1 -*-\ndef f(x):\n    return '\xe9'\n")
    (tmp_path / "marked_probe.py").write_bytes(b"\xef\xbb\xbfdef f(x):\n    return x\n")
    step = "import latin_probe, marked_probe\n\ndef run(x):\n    return latin_probe.f(marked_probe.f(x))\n"
    assert {"latin_probe.f", "marked_probe.f"} < set(package(step=step))


def test_a_module_in_an_archive_is_followed(package, tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "packed.zip", "w") as archive:
        archive.writestr("packed_probe.py", "def f(x):\n    return x\n")
    monkeypatch.syspath_prepend(tmp_path / "packed.zip")
    assert "packed_probe.f" in package(step="from packed_probe import f\n\ndef run(x):\n    return f(x)\n")
