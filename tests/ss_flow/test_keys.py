"""What of a call's inputs and parameters its key holds."""

from __future__ import annotations

import numpy as np
import pytest
import ss_flow_toy as toy
from toy_parameters import Holder, Linear, Nothing, Square, modelled
from toy_runs import ran, run

from ss_flow import keys
from ss_flow.cache.canonical import digest
from ss_flow.closure import Closure, closure_of
from ss_flow.keys import Keys


def test_lists_that_differ_only_in_order_or_length_have_other_keys():
    keys = Keys()
    lists = [("aa", "bb"), ("bb", "aa"), ("aa",), ("aa", "bb", "bb"), ("aabb",), ()]
    assert len({keys.key(toy.total, {"xs": each_list}, {}) for each_list in lists}) == len(lists)
    assert keys.key(toy.total, {"xs": ("aa",)}, {}) != keys.key(toy.total, {"xs": "aa"}, {})


def test_the_class_of_a_parameter_counts_where_its_declared_type_does_not_tell_it():
    given = [
        {},
        {"base": Square()},
        {"union": Linear()},
        {"union": Square()},
        {"union": Holder(Linear())},
        {"union": Holder(Square())},
        {"union": Holder(Nothing())},
        {"union": Holder(Nothing(), (Linear(),))},
        {"union": Holder(Nothing(), (Square(),))},
        {"several": (Linear(),)},
        {"several": (Square(),)},
        {"empty": Nothing()},
    ]
    assert len({Keys().key(modelled, {}, one) for one in given}) == len(given)
    parts = [Keys().components(modelled, {}, one)["parameters"] for one in ({"base": Linear()}, {"base": Square()})]
    code = digest(closure_of(Square).definitions)[:32]
    assert parts == [{"base.slope": 1.0}, {"base": f"{Square.__module__}.Square (code {code})", "base.slope": 1.0}]
    assert Keys().components(modelled, {}, {"several": (Linear(2.0),)})["parameters"] == {"several.0.slope": 2.0}


def test_the_code_of_a_parameter_counts_where_its_declared_type_does_not_name_it(monkeypatch):
    given = ({"base": Linear()}, {"union": Linear()}, {"base": Square()})
    before = [Keys().key(modelled, {}, one) for one in given]
    edited = Closure({"Square": "edited"}, frozenset(), {})
    monkeypatch.setattr(keys, "closure_of", lambda of: edited if of is Square else closure_of(of))
    assert [Keys().key(modelled, {}, one) == key for one, key in zip(given, before, strict=True)] == [True, True, False]


def test_a_parameter_that_two_tasks_share_has_the_same_keys_whoever_comes_first():
    shared = Linear(2.0)
    calls = [{"base": shared}, {"union": shared}]
    one, other = Keys(), Keys()
    found = {one.key(modelled, {}, call) for call in calls} | {other.key(modelled, {}, call) for call in calls[::-1]}
    assert len(found) == 2


def test_of_two_parameters_of_one_name_neither_hides_the_other():
    def parts(slope: float, within: float) -> dict:
        return Keys().components(toy.clip, {}, {"params": Linear(within), "slope": slope})["parameters"]

    assert parts(1.0, 2.0).items() >= {"params.slope": 2.0, "slope": 1.0}.items()


def test_a_numpy_scalar_counts_as_the_number_that_it_is(store):
    first = run(store, lambda: toy.flow(limit=5.0))
    assert ran(run(store, lambda: toy.flow(limit=np.float64(5.0)))) == []
    assert ran(run(store, lambda: toy.flow(values=(np.float64(1.0), 2, np.float32(3.0)))))
    assert first.failures == []


@pytest.mark.parametrize("value", [np.zeros(2), b"bytes", {"a": (1, np.zeros(2))}, {1: 2}, 1j])
def test_a_parameter_that_is_not_plain_data_is_refused_before_anything_is_computed(value):
    with pytest.raises(TypeError, match="the parameter limit holds a"):
        Keys().key(toy.clip, {"x": "aa"}, {"limit": value})
