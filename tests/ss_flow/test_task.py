"""What a function must declare to be a task, and what its calls take as parameters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import ss_flow_toy as toy
from toy_parameters import Holder, Linear, Nothing, modelled
from toy_runs import run, value

from ss_flow.graph import Flow
from ss_flow.task import task


def test_a_task_declares_the_types_of_its_artifacts_and_of_its_result():
    def untyped(x, *, by=1):
        return x

    with pytest.raises(TypeError, match="the task t must declare the type of x, its result"):
        task(name="t")(untyped)


def test_a_type_that_only_type_checkers_import_is_told_with_the_task():
    def hidden(x: Linear) -> Linear:
        return x

    hidden.__annotations__["x"] = "NDArray"
    with Flow().building(), pytest.raises(TypeError, match="that the task t declares is not there at run time"):
        task(name="t")(hidden)(None)


def test_a_task_names_its_arguments_one_by_one():
    def several(*xs: Linear) -> Linear:
        return xs[0]

    def only(x: Linear, /) -> Linear:
        return x

    def more(**options: float) -> Linear:
        return Linear(options["slope"])

    for function in (several, only, more):
        with pytest.raises(TypeError, match="the task t must name its arguments one by one"):
            task(name="t")(function)


def test_the_distributions_that_a_task_uses_are_a_tuple_and_no_text():
    with pytest.raises(TypeError, match=r'uses=\("open3d",\)'):
        task(uses="open3d")


def test_a_task_that_another_process_would_not_find_is_refused(store):
    @task(name="t.inner")
    def inner(*, slope: float) -> Linear:
        return Linear(slope)

    renamed = task(name="t.renamed")(toy.clip.function)
    for build in (lambda: inner(slope=1.0), lambda: renamed(toy.source(values=(1.0,))[0], limit=2.0)):
        with pytest.raises(TypeError, match=r"the task t\.\w+ must be declared at the top of its module"):
            run(store, lambda build=build: {"x": build()})


def test_a_call_has_parameters_of_its_own_as_its_key_sees_them():
    @task(name="t")
    def several(*, pair: tuple[int, ...], many: list[int], free: object) -> Linear:
        return Linear()

    given = {"pair": [1, np.int64(2)], "many": (1,), "free": {"b": [1], "a": np.float32(0.5)}}
    with Flow().building():
        kept = several(**given).parameters
    given["free"]["b"].append(2)
    assert repr(kept) == "{'pair': (1, 2), 'many': [1], 'free': {'a': 0.5, 'b': [1]}}"


def test_a_dataclass_of_parameters_has_lists_of_its_own_too():
    shared, changing = Holder(Linear(), (Linear(),)), Holder(Holder(Nothing(), ([1], 2)))
    with Flow().building():
        kept = [modelled(union=one).parameters["union"] for one in (shared, changing)]
    changing.one.many[0].append(2)
    assert kept[0] is shared and kept[1] == Holder(Holder(Nothing(), ([1], 2)))


def test_what_a_dataclass_of_parameters_holds_is_what_its_key_sees():
    with Flow().building():
        kept = modelled(union=Linear(np.float64(0.5))).parameters["union"]
    assert type(kept.slope) is float and kept == Linear(0.5)
    with Flow().building(), pytest.raises(TypeError, match=r"union\.slope holds a set, no plain data"):
        modelled(union=Linear({2.0}))


def test_a_dataclass_that_can_be_changed_is_no_parameter():
    @dataclass
    class Loose:
        slope: float = 1.0

    with Flow().building(), pytest.raises(TypeError, match="union holds a Loose, no plain data and no frozen datac"):
        modelled(union=Loose())
    with Flow().building(), pytest.raises(TypeError, match="make it a FileRef"):
        modelled(union=Path("photo.jpg"))


def test_a_task_that_changes_its_parameters_changes_a_copy(store):
    nodes = []

    def build():
        nodes.append(toy.appended(rows=[1], by=2))
        return {"x": nodes[0]}

    assert value(store, run(store, build, executor="threads").values["x"]) == 2.0
    assert nodes[0].parameters == {"rows": [1], "by": 2}
