"""Mistakes in a flow, or in what is asked of its run, are refused in one sentence."""

from __future__ import annotations

import re

import numpy as np
import pytest
import ss_flow_toy as toy
from toy_runs import run, value

from ss_flow.graph import INDEX, Flow, each, expand, gather, otherwise, pick, stored


def test_an_unknown_executor_is_refused_in_one_sentence(store):
    from ss_flow.errors import InputError

    with pytest.raises(InputError, match="threads, processes"):
        run(store, toy.flow, executor="mesos")


@pytest.mark.parametrize("name", ["jobs", "memory_mb", "gpus"])
def test_a_negative_number_is_refused_in_one_sentence(store, name):
    from ss_flow.errors import InputError

    with pytest.raises(InputError, match=f"{name} is -1; it must be 0 or more"):
        run(store, toy.flow, **{name: -1})


def test_an_input_that_is_no_node_is_refused():
    flow = Flow()
    with flow.building(), pytest.raises(TypeError, match="must be a node"):
        gather([1.0])


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: None, "a dict of nodes, not NoneType"),
        (lambda: {"x": [toy.source(values=(1.0,))]}, "the output x must be a node, not list"),
        (lambda: {"x": OF_ANOTHER_FLOW}, "the output x is a node of another flow"),
        (lambda: {"x": toy.square(OF_ANOTHER_FLOW)}, "the input x of ss_flow_toy.square is a node of another flow"),
        (lambda: {"x": toy.total((OF_ANOTHER_FLOW,))}, "is a node of another flow"),
        (lambda: {"x": toy.source(values=(1.0, {2}))}, "the parameter values holds a set"),
    ],
)
def test_a_mistake_in_a_flow_is_told_in_one_sentence(store, build, said):
    with pytest.raises(TypeError, match=said):
        run(store, build)


with Flow().building():
    OF_ANOTHER_FLOW = toy.source(values=(1.0,))


def test_a_node_that_depends_on_what_it_expands_to_ends_the_run_in_one_sentence(store):
    run(store, lambda: {"start": toy.source(values=(1.0,))[0]})

    def flow():
        again = []

        def build(_):
            # A call that has yet to be made leads into the circle.
            return toy.total((again[0], toy.square(toy.source(values=(2.0,))[0])))

        again.append(expand(toy.source(values=(1.0,))[0], build))
        return {"end": again[0]}

    with pytest.raises(RuntimeError, match="the flow waits for itself"):
        run(store, flow)


def test_positions_alone_have_no_length_and_are_refused_at_the_call(store):
    with pytest.raises(TypeError, match="INDEX alone says no length"):
        run(store, lambda: {"all": each(INDEX, build=lambda i: toy.number(i))})


def test_only_a_node_has_items_to_pick():
    with Flow().building(), pytest.raises(TypeError, match="not a list"):
        pick([1, 2], [0])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda node: each([node], build=lambda one: one), "`each` goes through must be a node, not list"),
        (lambda node: expand([node], lambda one: node), "`expand` waits for must be a node, not list"),
        (lambda node: otherwise([node], lambda: node), "`otherwise` replaces must be a node, not list"),
        (lambda node: each(node, build=lambda one: one, on_error="ignore"), "must be one of fail, skip"),
    ],
)
def test_what_is_no_node_is_refused_at_the_call(wrong, said):
    with Flow().building(), pytest.raises((TypeError, ValueError), match=said):
        wrong(toy.source(values=(1.0,)))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda node: each(node, build=lambda one: None), "`build` returns for an item must be a node, not NoneType"),
        (lambda node: each(node, build=lambda one: (one, one)), "must be a node, not tuple"),
        (lambda node: each(node, build=lambda one: OF_ANOTHER_FLOW), "is a node of another flow"),
        (lambda node: each(node, build=lambda one: one, names=["a"]), "1 names for the 2 items"),
        (lambda node: pick(node, [0, 2]), "item 2 is not among the 2 items of ss_flow_toy.source"),
    ],
)
def test_a_mistake_that_shows_only_when_a_list_is_known_fails_its_node_alone(store, wrong, said):
    report = run(store, lambda: {"x": wrong(toy.source(values=(1.0, 2.0))), "y": toy.source(values=(1.0, 2.0))})
    assert re.search(said, str(report.values["x"].error)) and len(report.all("y")) == 2


def test_a_node_cannot_be_gone_through_as_a_list():
    flow = Flow()
    with flow.building(), pytest.raises(TypeError, match="use `each`"):
        tuple(toy.source(values=(1.0,)))


def test_an_artifact_at_hand_is_no_input_but_becomes_one_through_the_store(store):
    for at_hand in (toy.number(1.0), np.zeros(2), None):
        with pytest.raises(TypeError, match=r"the input x of ss_flow_toy\.clip is a \w+, no node; .* stored\("):
            run(store, lambda at_hand=at_hand: {"x": toy.clip(at_hand, limit=2.0)})
    report = run(store, lambda: {"x": toy.clip(stored("x", store.put(toy.number(3.0))), limit=2.0)})
    assert value(store, report.values["x"]) == 2.0


def test_a_generator_is_no_list_of_results(store):
    """Its code would run when its files and its code have been looked at, and nobody hears what it says."""
    report = run(store, lambda: {"x": toy.yielded(count=2)})
    said = "the task ss_flow_toy.yielded declares a list and returned a generator; return a tuple"
    assert str(report.values["x"].error) == said
