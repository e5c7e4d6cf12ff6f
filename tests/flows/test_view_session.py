"""What a viewer holds of a scene that is being changed."""

from __future__ import annotations

import copy
import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from still_life import DOCUMENT, scene
from tiny_runs import ss_flow

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.edit_objects import Objects
from ss_flow.flows.edit_script import check
from ss_flow.flows.view.session import Operation, Session, read_operations, write_script
from ss_flow.tasks.artifacts import EditedScene
from ss_flow.tasks.gaussians.initialise import select


def mixed() -> EditedScene:
    """The still life with its rows in no order, turned Gaussians, and harmonics of degree 1."""
    rng = np.random.default_rng(1)
    whole = scene()
    changed = {
        "quaternions": rng.normal(size=(len(whole), 4)).astype(np.float32),
        "sh": rng.normal(size=(len(whole), 4, 3)).astype(np.float32),
    }
    return select(EditedScene(**{**vars(whole), **changed}), rng.permutation(len(whole)))


def session(*operations: Operation) -> Session:
    return Session(mixed(), copy.deepcopy(DOCUMENT), Path(), operations)


def by_the_command(script: dict) -> EditedScene:
    """The scene as `ss-flow edit` makes it: each operation on the whole of it."""
    steps, _ = check(script, Objects.of(copy.deepcopy(DOCUMENT), mixed()), Path())
    now = mixed()
    for step in steps:
        now = step.apply(now)
    return now


def assert_same(one: EditedScene, other: EditedScene) -> None:
    for field in fields(EditedScene):
        assert np.array_equal(getattr(one, field.name), getattr(other, field.name)), field.name


MUG, LAMP, BOWL = 2, 3, 4
TURN = {"axis": [0.3, 1, 0.2], "degrees": 33.0}
ids = st.lists(st.integers(0, 14), min_size=1, max_size=3)
number = st.integers(-300, 300).map(lambda n: n / 100)
acts = st.one_of(
    st.just("undo"),
    st.just("redo"),
    st.fixed_dictionaries({"op": st.sampled_from(["remove", "keep", "merge"]), "instances": ids}),
    st.fixed_dictionaries({"op": st.just("recolour"), "instances": ids, "color": st.just("#3060d0")}),
    st.fixed_dictionaries(
        {"op": st.just("transform"), "instances": ids},
        optional={
            "move": st.lists(number, min_size=3, max_size=3),
            "rotate": st.just(TURN),
            "scale": st.sampled_from([0.5, 1.7]),
        },
    ),
    st.fixed_dictionaries(
        {"op": st.just("duplicate"), "instance": st.integers(2, 14)}, optional={"rotate": st.just(TURN)}
    ),
    st.fixed_dictionaries({"op": st.just("split"), "instance": st.integers(2, 14)}),
    st.fixed_dictionaries({"op": st.just("relabel"), "instance": st.integers(2, 14), "name": st.sampled_from("ab")}),
)


@given(st.lists(acts, max_size=12))
def test_whatever_is_done_and_undone_the_scene_is_the_one_that_the_script_gives(todo):
    held = session()
    wanted: list[list[Operation]] = [[]]
    place = 0
    for act in todo:
        if act == "undo":
            held.undo()
            place = max(0, place - 1)
        elif act == "redo":
            held.redo()
            place = min(len(wanted) - 1, place + 1)
        else:
            try:
                held.do(act)
            except InputError:
                continue
            wanted = [*wanted[: place + 1], [*wanted[place], act]]
            place += 1
    assert held.script() == {"version": 1, "operations": wanted[place]}
    if held.state.pieces:
        assert_same(held.scene(), by_the_command(held.script()))
    else:
        assert not len(by_the_command(held.script()))
    assert held.state.pieces.keys() - {0} <= held.state.objects.entries.keys()


def test_an_operation_touches_no_piece_that_it_does_not_name():
    held = session()
    before = held.state.pieces
    held.do({"op": "transform", "instances": [MUG], "move": [1, 0, 0]})
    after = held.state.pieces
    assert {i for i in before if after[i] is not before[i]} == {MUG}


def test_operations_that_are_done_at_once_are_undone_at_once_and_refused_at_once():
    held = session()
    copies = [{"op": "duplicate", "instance": i} for i in (MUG, BOWL)]
    held.do(*copies)
    assert len(held.state.pieces) == 6
    held.undo()
    assert held.script()["operations"] == []
    held.undo()
    with pytest.raises(InputError, match=r"operation 2 \(remove\): instances is \[77\]"):
        held.do(copies[0], {"op": "remove", "instances": [77]})
    assert held.script()["operations"] == []
    held.redo()
    assert len(held.state.pieces) == 6


def test_something_new_ends_what_could_be_done_again():
    held = session({"op": "remove", "instances": [MUG]})
    held.undo()
    held.do({"op": "remove", "instances": [BOWL]})
    held.redo()
    assert held.script()["operations"] == [{"op": "remove", "instances": [BOWL]}]


def test_selecting_one_more_adds_it_and_selecting_it_again_lets_it_go():
    held = session()
    held.select(MUG)
    held.select(LAMP, more=True)
    assert held.selected == (MUG, LAMP)
    held.select(MUG, more=True)
    assert held.selected == (LAMP,)
    held.select(99)
    assert held.selected == ()


def test_what_is_gone_is_neither_selected_nor_hidden_and_comes_back_shown():
    held = session()
    held.select(MUG)
    held.hide([MUG])
    held.do({"op": "remove", "instances": [MUG]})
    assert held.selected == () and held.hidden == frozenset()
    held.undo()
    assert MUG in held.visible()


def test_isolating_shows_nothing_else_and_showing_all_shows_everything():
    held = session()
    held.isolate([LAMP])
    assert set(held.visible()) == {LAMP}
    held.show()
    assert set(held.visible()) == {0, MUG, LAMP, BOWL}


def test_the_center_of_several_is_what_a_transform_turns_them_about():
    held = session()
    about = held.center([MUG, BOWL])
    held.do({"op": "transform", "instances": [BOWL, MUG], "rotate": TURN, "scale": 1.5})
    assert held.center([MUG, BOWL]) == pytest.approx(about, abs=1e-6)


def test_a_script_is_read_back_as_it_was_saved(tmp_path):
    file = tmp_path / "deep" / "script.json"
    script = session({"op": "relabel", "instance": MUG, "name": "Blümchentasse"}).script()
    write_script(file, script)
    assert json.loads(file.read_text(encoding="utf-8")) == script
    assert session(*read_operations(file)).script() == script
    file.write_text("\ufeff" + file.read_text())  # as editors on Windows save it
    assert session(*read_operations(file)).script() == script


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"operations": 3}', '{"operations": [], "operations": []}', "\0"])
def test_what_is_no_script_is_refused_with_its_name(tmp_path, content):
    file = tmp_path / "no.json"
    file.write_text(content)
    with pytest.raises(InputError, match=r"no\.json is no edit script"):
        read_operations(file)


def test_the_command_line_makes_the_same_bytes_of_a_saved_script(warm, tmp_path):
    store = Store(warm.store)
    document = json.loads((warm.out / "run.json").read_text())
    instances = json.loads((warm.out / "instances.json").read_text())
    held = Session(store.get(document["results"]["scene"]), instances, tmp_path)
    first, *others = (e["id"] for e in instances["instances"] if e["num_gaussians"])
    held.do({"op": "duplicate", "instance": first, "move": [0.5, 0, 0], "rotate": TURN})
    held.do({"op": "recolour", "instances": [first], "color": [10, 200, 30]})
    held.do({"op": "remove", "instances": ["background"]})
    held.undo()
    held.do({"op": "merge", "instances": [first, *others[:1], held.state.objects.next_id - 1]})
    held.do({"op": "transform", "instances": [first], "scale": 1.25})
    write_script(tmp_path / "s.json", held.script())
    called = ss_flow(
        "edit", warm.out, tmp_path / "s.json", "--out", tmp_path / "edited", "--cache", warm.store, "--json"
    )
    assert called.code == 0, called.err
    assert_same(held.scene(), store.get(called.document()["results"]["scene"]))
