from __future__ import annotations

import functools
import typing
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.flows import settings
from ss_flow.flows.params import Params
from ss_flow.tasks.ranges import Count, Fraction


@dataclass(frozen=True)
class Inner:
    share: Fraction = 0.7
    grids: tuple[Count, ...] = (1, 4)
    rule: Literal["child", "union"] = "child"
    limit: float | None = None
    on: bool = True
    name: str = "auto"


@dataclass(frozen=True)
class Group:
    inner: Inner = field(default_factory=Inner)
    other: Inner = field(default_factory=Inner)


@dataclass(frozen=True)
class Top:
    group: Group = field(default_factory=Group)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("group.inner.share=0.5", {"group.inner.share": 0.5}),
        ("inner.share=1", {"group.inner.share": 1.0}),
        ("inner.grids=2,8", {"group.inner.grids": (2, 8)}),
        ("inner.grids=(2)", {"group.inner.grids": (2,)}),
        ("inner.rule=union", {"group.inner.rule": "union"}),
        ("inner.limit=3", {"group.inner.limit": 3.0}),
        ("inner.limit=none", {"group.inner.limit": None}),
        ("inner.limit=NULL", {"group.inner.limit": None}),
        ("inner.on=false", {"group.inner.on": False}),
        ("inner.on=No", {"group.inner.on": False}),
        ("inner.on=0", {"group.inner.on": False}),
        ("inner.on=Yes", {"group.inner.on": True}),
        ("inner.on=1", {"group.inner.on": True}),
        (" inner.share = 0.5 ", {"group.inner.share": 0.5}),
        ("inner.rule = union ", {"group.inner.rule": "union"}),
        ("inner.grids=[2, 8,]", {"group.inner.grids": (2, 8)}),
        ("inner.name=a=b", {"group.inner.name": "a=b"}),
        ("inner.name=sam", {"group.inner.name": "sam"}),
    ],
)
def test_a_parameter_is_set_by_name(text, expected):
    before, after = settings.flat(Top()), settings.flat(settings.apply(Top(), [text]))
    assert {name: after[name] for name in after if after[name] != before[name] or name in expected} == expected


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("inner.share", "not of the form"),
        ("inner.shard=1", "did you mean 'group.inner.share'"),
        ("inner.share=1.5", "between 0 and 1"),
        ("inner.share=much", "a number"),
        ("inner.share=nan", "a number"),
        ("inner.grids=0", "at least 1"),
        ("inner.grids=1.5", "a whole number"),
        ("inner.grids=", "is empty; it takes a whole number, or several"),
        ("inner.grids=()", "is empty"),
        ("inner.rule=or", "'child' or 'union'"),
        ("inner.on=maybe", "true or false"),
        ("inner.limit=much", "a number"),
        ("inner.limit=inf", "a number"),
        ("group.share=0.5", "ambiguous"),
        ("zzz.qqq=1", "they begin with group"),
    ],
)
def test_a_bad_assignment_is_refused_in_one_sentence(text, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        settings.apply(Top(), [text])
    assert "\n" not in str(caught.value)


FINER = {
    "grids": "1,4,8,16,32",
    "stability_offset": "0.8,0.8,0.8,1,1",
    "mask_threshold": "0.5,0.5,0.3,0.3,0.3",
    "box_nms": "0.3,0.3,0.5,0.3,0.3",
}
"""Lists of one length, another than that of the defaults."""


@pytest.mark.parametrize("names", [list(FINER), list(reversed(FINER))])
def test_lists_that_belong_together_are_set_in_any_order(names):
    params = settings.apply(Params(), [f"split.segment.{name}={FINER[name]}" for name in names])
    assert {len(getattr(params.split.segment, name)) for name in FINER} == {5}
    table = {name: list(getattr(params.split.segment, name)) for name in names}
    assert settings.overlaid(Params(), {"split": {"segment": table}}) == params
    with pytest.raises(InputError, match=r"stability_offset has 4 values but segment\.grids has 5"):
        settings.apply(Params(), [f"split.segment.grids={FINER['grids']}"])


def test_the_last_of_two_values_counts():
    assert settings.apply(Top(), ["group.inner.share=0.5", "inner.share=0.6"]).group.inner.share == 0.6


@pytest.mark.parametrize("name", ["default", "paper", "paper_lerf", "reference", "fast", "thorough"])
def test_every_preset_names_only_parameters_that_exist(name):
    settings.preset(Params(), name)


@pytest.mark.parametrize("name", ["default", "paper", "paper_lerf", "reference", "fast", "thorough"])
def test_every_value_of_a_preset_is_in_its_range(name):
    params = settings.preset(Params(), name)
    assert settings.apply(params, [f"{path}={value}" for path, value in settings.flat(params).items()]) == params


def test_every_number_declares_its_range():
    free = []
    for path, _ in settings.leaves(Params()):
        owner = functools.reduce(getattr, path[:-1], Params())
        if {int, float} & parts(typing.get_type_hints(type(owner), include_extras=True)[path[-1]]):
            free.append(".".join(path))
    assert free == ["split.segment.mask_threshold"]


def parts(kind):
    """The types that a type is made of, down to those that declare something."""
    inner = () if typing.get_origin(kind) in (None, typing.Annotated) else typing.get_args(kind)
    return {kind}.union(*map(parts, inner)) if typing.get_origin(kind) is not typing.Literal else set()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("split.propagate.passes=0", "out of range: 0; it must be at least 1"),
        ("split.propagate.lambda_init=1", "greater than 0 and less than 1"),
        ("split.propagate.tau_label=1.5", "out of range: 1.5; it must be between 0 and 1"),
        ("split.segment.stability=0.9,0.9,0.9,1.1", "out of range: 1.1"),
        ("split.rgbd.crease=200", "greater than 0 and at most 180"),
        ("capture.sfm.matching=all", "it takes 'auto' or 'exhaustive' or 'sequential'"),
        ("capture.ingest.jpeg_quality=101", "between 0 and 100"),
        ("capture.agreement.min_views=9", "only 8 neighbors are asked"),
        ("split.segment.grids=1,4,8,100000", "between 1 and 1024"),
        ("split.dense.max_points=1", "at least 100"),
        ("semantics.query.prompt=an image", r"has no \{text\} in it"),
        ("capture.sweep.planes=2", "at least 3"),
        ("splat.plan.bbox_quantile=0.5", "at least 0 and less than 0.5"),
        ("splat.reconstruct.objective.background=white", "it takes 'random' or 'black'"),
    ],
)
def test_a_value_that_a_step_cannot_take_is_refused_before_any_work(text, sentence):
    with pytest.raises(InputError, match=sentence):
        settings.apply(Params(), [text])


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"inner": {"share": "0.5"}}, "share cannot be '0.5'; it takes a number"),
        ({"inner": {"share": True}}, "share cannot be True; it takes a number"),
        ({"inner": {"limit": float("nan")}}, "limit cannot be nan; it takes a number"),
        ({"inner": {"grids": [1, 2.5]}}, "grids cannot be 2.5; it takes a whole number"),
        ({"inner": {"grids": [True]}}, "grids cannot be True; it takes a whole number"),
        ({"inner": {"grids": 3}}, "grids cannot be 3; it takes a whole number, or several"),
        ({"inner": {"on": 1}}, "on cannot be 1; it takes true or false"),
        ({"inner": {"name": None}}, "name cannot be None; it takes a text"),
        ({"inner": {"rule": 1}}, "rule cannot be 1; it takes 'child' or 'union'"),
        ({"iner": {"share": 0.5}}, "the group of parameters 'iner' is unknown; there are inner, other"),
        ({"inner": {"share": {"x": 1}}}, "the group of parameters 'share' is unknown; there are none"),
    ],
)
def test_a_table_with_a_value_of_another_type_is_refused_in_one_sentence(table, sentence):
    with pytest.raises(InputError, match=sentence):
        settings.overlaid(Group(), table)


def test_a_table_takes_numbers_of_numpy_and_whole_ones_for_numbers():
    changed = settings.overlaid(Inner(), {"share": 1, "grids": [np.int64(2)], "limit": np.float32(0.5)})
    assert (changed.share, changed.grids, changed.limit) == (1, (2,), 0.5)


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match="default, fast, paper, paper_lerf, reference, thorough"):
        settings.preset(Params(), "papre")


@pytest.mark.parametrize("name", ["split.tau_depth", "split.tau_label", "propagate.tau_label", "semantics.tau_corr"])
def test_the_short_names_of_the_thresholds_stand_for_one_parameter(name):
    assert settings.find(Params(), name)
