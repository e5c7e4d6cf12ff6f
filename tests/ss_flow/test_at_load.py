"""What a module changes when it is loaded belongs to what it changes."""

from __future__ import annotations

import ast
import time
from pathlib import Path

import pytest

from ss_flow import at_load


@pytest.mark.parametrize(
    "filling",
    [
        "for k in range(3):\n    TABLE[k] = k * TWO\n",
        "TABLE.update(a=TWO)\n",
        "TABLE.setdefault('a', []).append(TWO)\n",
        "TABLE['a'] = 1\nTABLE['a'] += TWO\n",
        "fill(TABLE, TWO)\n",
        "while not TABLE:\n    fill(TABLE, TWO)\n",
        "import contextlib\nwith contextlib.suppress(KeyError):\n    TABLE = {1: TWO}\n",
        "match TWO:\n    case int(TABLE):\n        pass\n",
        "_ = fill(TABLE, TWO)\n",
        "assert fill(TABLE, TWO) is None\n",
        "kept = TABLE.setdefault('a', TWO)\n",
        "[TABLE.update({k: TWO}) for k in range(3)]\n",
        "list(map(TABLE.update, [{'a': TWO}]))\n",
        "alias = TABLE\nalias['a'] = TWO\n",
        "for one in (TABLE, {}):\n    one['a'] = TWO\n",
        "def among(f, t=TABLE.setdefault('a', TWO)):\n    pass\n",
        "class Filling:\n    TABLE['a'] = TWO\n",
        "class Filling:\n    def __init__(self, x):\n        TABLE['a'] = x\n\nmade = Filling(TWO)\n",
        "class Filling:\n    @staticmethod\n    def fill(x):\n        TABLE['a'] = x\n\nFilling.fill(TWO)\n",
        "class Base:\n    def __init_subclass__(cls):\n        TABLE[0] = cls\n\nclass A(Base):\n    x = TWO\n",
        "class Meta(type):\n    def __init__(cls, *of):\n        TABLE[0]=cls\n\nclass A(metaclass=Meta):\n    x=TWO\n",
        "def into(t):\n    return lambda f: t.update(f=f)\n\n@into(TABLE)\ndef f(x):\n    return TWO\n",
    ],
    ids=[
        "loop",
        "method",
        "chain",
        "added to",
        "argument",
        "while",
        "block",
        "pattern",
        "call whose value is kept",
        "assertion",
        "method whose value is kept",
        "comprehension",
        "map",
        "another name",
        "loop over tables",
        "default",
        "body of a class",
        "making an object",
        "method of a class",
        "hook of a base",
        "metaclass",
        "decorator",
    ],
)
def test_the_statements_that_fill_a_table_belong_to_it(package, filling):
    step = "TWO = 2\nOTHER = 1\nTABLE = {}\n\ndef fill(t, x):\n    t[x] = x\n\n\ndef run(x):\n    return TABLE\n\n"
    found = package(step=step + filling)
    assert "probe.step.TWO" in found and "probe.step.OTHER" not in found
    edited = package(step=step + filling.replace("TWO", "3"))
    assert found["probe.step.TABLE"] != edited["probe.step.TABLE"]


def test_a_call_whose_function_another_one_chose_belongs_to_the_table_that_it_fills(package):
    step = "TWO = 2\nTABLE = {}\n\ndef put():\n    TABLE[0] = TWO\n\nchosen = None\n\n"
    step += "def use():\n    return chosen and chosen()\n\ndef choose():\n    global chosen\n    chosen = put\n\n"
    step += "first = use()\nchoose()\nsecond = use()\n\ndef run(x):\n    return TABLE\n"
    found = package(step=step)
    assert {"probe.step.TWO", "probe.step.put"} <= found.keys()


def test_what_a_library_makes_for_a_function_is_no_change_of_the_library(package):
    step = (
        "import numpy as np\n\ndef made(n):\n    found = np.zeros(3)\n    found[n] = 1\n    return found\n\n"
        "FIRST = made(1)\n\ndef run(x):\n    return np.abs(x)\n"
    )
    assert set(package(step=step)) == {"probe.step.run"}


def test_a_table_that_is_only_read_does_not_depend_on_who_reads_it(package):
    step = (
        "TABLE = {1: 'a b'}\nWORDS = [TABLE[1].split(), *TABLE.items(), len(TABLE)]\n\ndef run(x):\n    return TABLE\n"
    )
    assert package(step=step) == package(step=step.replace("len(TABLE)", "sum(TABLE)"))


def test_a_module_in_which_much_is_called_when_it_is_loaded_is_read_in_a_moment(package):
    methods = "".join(f"    def m{n}(self, x{n}):\n        return f{n}(x{n}), M(x{n})\n" for n in range(60))
    functions = "".join(f"def f{n}(x):\n    return M(x), f{(7 * n) % 60}(x)\n" for n in range(60))
    made = "".join(f"A{n} = M({n})\n" for n in range(100))
    step = f"class M:\n    def __init__(self, x):\n        pass\n{methods}{functions}{made}def run(x):\n    return A1\n"
    began = time.process_time()
    assert "probe.step.M" in package(step=step)
    assert time.process_time() - began < 3


def test_a_walk_goes_through_a_module_as_python_s_own_does_but_for_how_names_are_used():
    for file in Path(at_load.__file__).parent.glob("*.py"):
        tree = ast.parse(file.read_text())
        assert at_load.walk(tree) == [node for node in ast.walk(tree) if not isinstance(node, ast.expr_context)]
