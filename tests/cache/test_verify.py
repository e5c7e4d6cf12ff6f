from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from ss_flow.cache.canonical import digest
from ss_flow.cache.store import Action, Store
from ss_flow.cache.verify import verify
from ss_flow.tasks.artifacts import LabelMap

CLOSURE = {"tasks.step": "00" * 32}


@pytest.fixture
def filled(store):
    """Twenty actions with an output each, and the closure that they name."""
    store.put_part(digest(CLOSURE), CLOSURE)
    for number in range(20):
        output = store.put(LabelMap(str(number), np.full((9, 9), number, np.uint16)))
        store.record(Action(digest(number), "step", (output,), False, {"code": digest(CLOSURE)}, 1.0, 10.0))
    return store


def output_of(store, number):
    return store.action(digest(number), whole=False).outputs[0]


def test_a_whole_store_is_read_to_the_end_and_stays_as_it_is(filled):
    heard = []
    seen = verify(filled, lambda done, total: heard.append((done, total)))
    assert (seen.damaged, seen.incomplete) == ((), 0)
    assert (seen.objects.count, seen.actions.count, seen.parts.count) == (20, 20, 1)
    assert heard == [(done, 20) for done in range(1, 21)]
    assert all(filled.action(digest(number)) is not None for number in range(20))


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_each_damaged_thing_is_named_and_taken_out_and_only_that(filled):
    broken = output_of(filled, 3)
    flip(next(path for path in (filled.object_path(broken) / "ids").rglob("c*") if path.is_file()))
    filled.action_path(digest(5)).write_text("{")
    misplaced = filled.action_path(digest(7))
    misplaced.write_text(filled.action_path(digest(8)).read_text())
    (filled.root / "parts" / f"{digest(CLOSURE)}.json").write_text('{"tasks.step": "changed"}')
    seen = verify(filled)
    assert {(damage.kind, damage.name) for damage in seen.damaged} == {
        ("object", broken),
        ("action", digest(5)),
        ("action", digest(7)),
        ("part", digest(CLOSURE)),
    }
    assert seen.incomplete == 1, "the action whose output was taken out"
    lost = {number for number in range(20) if Store(filled.root).action(digest(number)) is None}
    assert lost == {3, 5, 7}
    again = verify(filled)
    assert (again.damaged, again.incomplete, again.objects.count) == ((), 1, 19)


@pytest.mark.parametrize("foreign", [Path.touch, lambda place: place.symlink_to("nowhere")], ids=["file", "link"])
def test_what_is_no_folder_in_the_place_of_an_object_is_damaged_and_makes_way_for_the_object(filled, foreign):
    broken, value = output_of(filled, 3), LabelMap("3", np.full((9, 9), 3, np.uint16))
    place = filled.object_path(broken)
    for mend in (verify, lambda store: store.put(value)):
        shutil.rmtree(place)
        foreign(place)
        mended = mend(filled)
        if mend is verify:
            assert [(damage.kind, damage.name) for damage in mended.damaged] == [("object", broken)]
            assert not os.path.lexists(place) and filled.put(value) == broken
        assert Store(filled.root).get(broken).name == "3"


def test_what_a_collector_takes_meanwhile_is_no_damage(filled, monkeypatch):
    read, taken = Store.read, output_of(filled, 2)

    def read_late(self, name):
        if name == taken:
            Store(self.root).discard(name)
        return read(self, name)

    monkeypatch.setattr(Store, "read", read_late)
    assert verify(filled).damaged == ()


@pytest.mark.parametrize("content", ["[]", "{}", '{"components": []}', "\x00" * 40, ""])
def test_a_record_of_any_other_form_is_damaged(filled, content):
    path = filled.action_path(digest(0))
    if content.startswith('{"comp'):
        content = path.read_text().replace('"components":{', '"components":["').replace("}", '"]', 1)
    path.write_text(content)
    (damage,) = verify(filled).damaged
    assert (damage.kind, damage.name) == ("action", digest(0))
    assert not path.exists()
