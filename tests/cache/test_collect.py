from __future__ import annotations

import json
import os
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from aged_store import age_all
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.cache.canonical import digest
from ss_flow.cache.collect import ORPHANS, Roots, collect
from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.pins import pin, read_pins, unpin
from ss_flow.cache.store import GRACE_SECONDS, Action, Store
from ss_flow.cache.survey import Survey
from ss_flow.tasks.artifacts import LabelMap

HOUR = 3600.0


def put(store, number):
    return store.put(LabelMap(f"object {number}", np.full((8, 8), number, np.uint16)))


def act(store, name, *numbers, step="step", code="c0de"):
    """An action under the digest of its name, with objects by number as outputs."""
    outputs = tuple(put(store, number) for number in numbers)
    store.record(Action(digest(name), step, outputs, True, {"code": code}, 1.0, 10.0))
    return digest(name)


def age(store, key, hours):
    """Make an action, and its outputs so far as they are not older, look last used so long ago."""
    used = time.time() - hours * HOUR
    os.utime(store.action_path(key), (used, used))
    for output in store.action(key, whole=False).outputs:
        if (place := store.object_path(output)).exists():
            os.utime(place, (used, used))


def held(*keys, kept=(), objects=()):
    return lambda living: Roots(set(keys), set(kept), set(objects))


def keys_in(store):
    return {entry.name for entry in store.actions()}


def objects_in(store):
    return {entry.name for entry in store.objects()}


def named(store):
    return {output for key in keys_in(store) for output in store.action(key, whole=False).outputs}


def test_what_no_root_reaches_goes_and_the_rest_stays_with_its_outputs(store):
    wanted, unwanted = act(store, "wanted", 1, 2), act(store, "unwanted", 2, 3)
    age_all(store.root)
    done = collect(store, held(wanted))
    assert keys_in(store) == {wanted}
    assert objects_in(store) == {put(store, 1), put(store, 2)}
    assert done.results["step"].count == 1 and done.left.count == 1
    assert unwanted not in keys_in(store)


@pytest.mark.parametrize("what", ["action", "object"])
def test_nothing_that_was_used_within_the_grace_period_goes(store, what):
    key = act(store, "a", 1)
    output = put(store, 1)
    age_all(store.root)
    if what == "action":
        assert store.action(key) is not None  # a hit: action and outputs count as used
    else:
        put(store, 1)  # made again by another task, whose action is still to come
    collect(store, held())
    assert (key in keys_in(store)) == (what == "action")
    assert output in store


def test_the_grace_period_may_be_shorter_but_not_while_anything_runs(store):
    key = act(store, "a", 1)
    age(store, key, 0.1)
    claims = store.open_claims()
    claims.take("something")
    collect(store, held(), grace_seconds=0)
    assert keys_in(store) == {key}
    claims.release_all()
    collect(store, held(), grace_seconds=0)
    assert keys_in(store) == objects_in(store) == set()


def test_the_roots_are_asked_for_with_the_claims_of_the_living_and_claimed_keys_are_held(store):
    key = act(store, "a", 1)
    age_all(store.root)
    claims, asked = store.open_claims(), []
    claims.take(key)
    claims.take("run-1")
    (store.root / "claims" / "run-dead").write_text(json.dumps({**json.loads(claims._token), "pid": 2**22 + 1}))
    done = collect(store, lambda living: asked.append(living) or Roots())
    assert asked == [{key, "run-1"}]
    assert keys_in(store) == {key}
    assert done.others["stale claims"].count == 1
    assert {p.name for p in (store.root / "claims").iterdir()} == {key, "run-1"}
    claims.release_all()


def test_a_claim_of_another_host_counts_while_it_was_touched_within_the_hour(store):
    for name, hours in (("run-elsewhere", 0.9), ("run-long-gone", 1.1)):
        path = store.root / "claims" / name
        path.write_text(json.dumps({"host": "elsewhere", "pid": 1, "started": 0}))
        os.utime(path, (time.time() - hours * HOUR,) * 2)
    asked = []
    collect(store, lambda living: asked.append(living) or Roots())
    assert asked == [{"run-elsewhere"}]
    assert {p.name for p in (store.root / "claims").iterdir()} == {"run-elsewhere"}


def test_kept_results_go_for_their_age_and_held_ones_never(store):
    old, young, pinned = act(store, "old", 1), act(store, "young", 2), act(store, "pinned", 3)
    for key, hours in ((old, 50), (young, 30), (pinned, 50)):
        age(store, key, hours)
    collect(store, held(pinned, kept=(old, young)), unused_seconds=40 * HOUR)
    assert keys_in(store) == {young, pinned}


def test_for_want_of_room_the_least_recently_used_go_first_and_no_more_than_needed(store):
    keys = [act(store, str(number), number) for number in range(5)]
    for key, hours in zip(keys, (30, 50, 2, 40, 3), strict=True):
        age(store, key, hours)
    most = Survey.of(store).bytes * 3 // 5 + 10
    done = collect(store, held(kept=keys), max_bytes=most)
    assert keys_in(store) == {keys[0], keys[2], keys[4]}
    assert done.left.bytes == Survey.of(store).bytes <= most


def test_held_results_stay_even_where_there_is_no_room_for_them(store):
    pinned, other = act(store, "pinned", 1, 2), act(store, "other", 2, 3)
    age_all(store.root)
    done = collect(store, held(pinned, kept=[other]), max_bytes=0)
    assert keys_in(store) == {pinned} and objects_in(store) == named(store)
    assert done.left.bytes == Survey.of(store).bytes > 0


def test_a_pinned_object_stays_without_an_action(store):
    put(store, 1)
    put(store, 2)
    age_all(store.root)
    done = collect(store, held(objects=[put_digest(1)]))
    assert objects_in(store) == {put_digest(1)}
    assert done.others[ORPHANS].count == 1


def put_digest(number):
    return digest(LabelMap(f"object {number}", np.full((8, 8), number, np.uint16)))


def test_actions_that_can_never_be_hits_go_although_a_run_names_them(store):
    broken, bare = act(store, "unreadable", 1), act(store, "outputs gone", 2)
    store.action_path(broken).write_text("{")
    store.discard(put_digest(2))
    age_all(store.root)
    done = collect(store, held(kept=[broken, bare]))
    assert keys_in(store) == objects_in(store) == set()
    assert {step: tally.count for step, tally in done.results.items()} == {"": 1, "step": 1}


def test_leftovers_are_swept_by_age(store):
    used, unused = act(store, "used", 1, code="aa" * 32), "bb" * 32
    for code in ("aa" * 32, unused):
        store.put_part(code, {"f": code})
    gone, claimed, half = digest("gone"), digest("claimed"), "cd" * 16
    place = store.checkpoint(gone).parent
    place.mkdir()
    names = [place / f"{gone}.npz", place / f"{gone}.partial", place / f"{claimed}.npz"]
    names += [store.root / f".files.json.{half}", store.root / "roots" / "runs" / f".run.json.{half}"]
    names += [store.root / "tmp" / half]
    theirs = [store.root / ".profile", place / "epoch-3.npz"]
    for name in names + theirs:
        name.write_text("x")
    age_all(store.root)
    fresh = store.checkpoint(digest("fresh"))
    fresh.write_text("x")
    claims = store.open_claims()
    claims.take(claimed)
    done = collect(store, held(used))
    assert "parts of keys" not in done.others, "a run that is alive may be about to use one"
    assert {name for name in names if name.exists()} == {place / f"{claimed}.npz"}
    assert done.others["checkpoints"].count == 2 and done.others["temporary files"].count == 3
    claims.release_all()
    done = collect(store, held(used))
    assert [p.stem for p in (store.root / "parts").iterdir()] == ["aa" * 32]
    assert done.others["parts of keys"].count == 1
    assert set(place.iterdir()) == {fresh, theirs[1]}
    assert all(name.exists() for name in theirs), "the folder was someone's before it was a store"


def test_a_list_of_inputs_stays_as_long_as_a_record_names_it(store):
    wanted, other = digest(["a", "b"]), digest(["b", "a"])
    for name, members in ((wanted, ["a", "b"]), (other, ["b", "a"])):
        store.put_part(name, members)
    components = {"code": "aa" * 32, "inputs": {"frames": wanted, "cameras": "cc" * 32}}
    key = digest("uses the list")
    store.record(Action(key, "step", (put(store, 1),), False, components, 1.0, 10.0))
    age_all(store.root)
    collect(store, held(key))
    assert [entry.name for entry in store.parts()] == [wanted]
    collect(store, held())
    assert list(store.parts()) == []


ages = st.floats(1.5, 100)
plans = st.fixed_dictionaries(
    {
        "actions": st.lists(st.tuples(st.sets(st.integers(0, 5), max_size=3), ages), max_size=7),
        "orphans": st.sets(st.integers(4, 9), max_size=3),
        "held": st.sets(st.integers(0, 6)),
        "kept": st.sets(st.integers(0, 6)),
        "young": st.sets(st.integers(0, 6), max_size=2),
        "fresh": st.sets(st.integers(0, 9), max_size=2),
        "pinned": st.sets(st.integers(0, 9), max_size=2),
        "share": st.none() | st.floats(0, 1.2),
        "unused": st.none() | st.floats(1, 100),
    }
)


@given(plans)
@settings(max_examples=60, deadline=None)
def test_whatever_the_store_and_the_limits(plan):
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        keys = [act(store, i, *sorted(numbers)) for i, (numbers, _) in enumerate(plan["actions"])]
        for number in plan["orphans"]:
            put(store, number)
        age_all(store.root)
        for i in sorted(range(len(keys)), key=lambda i: -plan["actions"][i][1]):
            age(store, keys[i], plan["actions"][i][1])
        chosen = {name: {key for i, key in enumerate(keys) if i in plan[name]} for name in ("held", "kept", "young")}
        for key in chosen["young"]:
            age(store, key, 0.1)
        for number in plan["fresh"]:
            put(store, number)
        pinned = {put_digest(number) for number in plan["pinned"]}
        before = Survey.of(store)
        limits = {
            "max_bytes": None if plan["share"] is None else round(plan["share"] * before.bytes),
            "unused_seconds": float("inf") if plan["unused"] is None else plan["unused"] * HOUR,
        }
        told = collect(store, held(*chosen["held"], kept=chosen["kept"], objects=pinned), dry=True, **limits)
        assert Survey.of(store) == before, "a dry run changes nothing"
        done = collect(store, held(*chosen["held"], kept=chosen["kept"], objects=pinned), **limits)
        after = Survey.of(store)

        assert told == done
        assert after.actions.items() <= before.actions.items()
        assert done.left.count == len(after.actions) and done.left.bytes == after.bytes
        gone = sum(tally.bytes for tally in (*done.results.values(), *done.others.values()))
        assert gone == before.bytes - after.bytes
        protected = chosen["held"] | chosen["young"]
        assert protected <= after.actions.keys()
        assert all(after.is_whole(key) for key in after.actions), "no action loses an output"
        grace = time.time() - GRACE_SECONDS
        young = {name for name, entry in before.objects.items() if entry.used > grace}
        wanted = {name for action in after.actions.values() for name in action.outputs}
        assert set(after.objects) == wanted | young | (pinned & before.objects.keys())
        by_age = {key for key in chosen["kept"] if before.actions[key].used > time.time() - limits["unused_seconds"]}
        if limits["max_bytes"] is None:
            assert set(after.actions) == protected | by_age
        elif after.bytes > limits["max_bytes"]:
            assert set(after.actions) == protected
        else:
            given_up = [before.actions[key].used for key in by_age - protected - after.actions.keys()]
            spared = [before.actions[key].used for key in by_age - protected if key in after.actions]
            assert not given_up or not spared or max(given_up) <= min(spared)


def test_an_action_that_is_used_while_the_collector_is_at_it_stays_with_its_outputs(store, monkeypatch):
    key = act(store, "a", 1)
    other = act(store, "b", 2)
    age_all(store.root)
    forget = Store.forget

    def used_just_before(self, name, **limits):
        if name == key:
            assert Store(store.root).action(key) is not None
        return forget(self, name, **limits)

    monkeypatch.setattr(Store, "forget", used_just_before)
    done = collect(store, held())
    assert keys_in(store) == {key} and objects_in(store) == {put_digest(1)}
    assert done.left.count == 1 and other not in keys_in(store)


def test_several_collectors_at_once_take_each_thing_once(store):
    keys = [act(store, str(i), i, i + 1) for i in range(40)]
    age_all(store.root)
    totals, wanted = [], set(keys[::4])

    def go():
        done = collect(Store(store.root), held(*wanted))
        totals.append(sum(tally.count for tally in done.results.values()))

    several = [threading.Thread(target=go) for _ in range(4)]
    for one in several:
        one.start()
    for one in several:
        one.join()
    assert keys_in(store) == wanted
    assert objects_in(store) == named(store)
    assert len(totals) == 4 and sum(totals) == 30


def test_what_another_process_sweeps_from_under_a_collector_is_gone_all_the_same(store, monkeypatch):
    act(store, "a", 1)
    age_all(store.root)
    rename = Path.rename

    def swept_at_once(path, target):
        rename(path, target)
        Store(store.root).sweep_temporaries()

    monkeypatch.setattr(Path, "rename", swept_at_once)
    assert collect(store, held()).results["step"].count == 1
    assert keys_in(store) == objects_in(store) == set()


def test_pins_are_kept_until_they_are_removed(store):
    first = pin(store, "propagate", "/room", ["aa" * 32], ())
    pin(store, "propagate", "/room", ["aa" * 32], ())
    second = pin(store, "propagate", "/room", ["bb" * 32], ["cc" * 32])
    assert [p.keys for p in read_pins(store)] == [first.keys, second.keys]
    unpin(store, first)
    assert read_pins(store) == [second]


def test_a_pin_that_cannot_be_read_stops_the_collector(store):
    key = act(store, "a", 1)
    age_all(store.root)
    (store.root / "roots" / "pins" / "x.json").write_text('{"what": "a"}')
    with pytest.raises(StoreFailure, match=r"x\.json cannot be read"):
        collect(store, lambda living: Roots({k for p in read_pins(store) for k in p.keys}))
    assert keys_in(store) == {key}


def test_room_is_told_by_group_and_what_is_shared_counts_once_in_the_total(store):
    a, b, c = act(store, "a", 1, 2, step="one"), act(store, "b", 2, step="two"), act(store, "c", 3, step="two")
    d = act(store, "lost its output", 5, step="three")
    store.discard(put_digest(5))
    put(store, 4)
    survey = Survey.of(store)
    size = {number: survey.objects[put_digest(number)].bytes for number in range(1, 5)}
    record = {key: survey.actions[key].bytes for key in (a, b, c, d)}
    usage = survey.usage(survey.by_step())
    assert {step: (t.count, t.bytes) for step, t in usage.rows.items()} == {
        "one": (1, record[a] + size[1] + size[2]),
        "two": (2, record[b] + record[c] + size[2] + size[3]),
        "three": (1, record[d]),
    }
    assert usage.shared_bytes == size[2]
    assert (usage.unreachable.count, usage.unreachable.bytes) == (0, size[4])
    assert survey.bytes == sum(record.values()) + sum(size.values())
    of_runs = survey.usage({"room": [a, b, "not here"]})
    assert (of_runs.shared_bytes, of_runs.unreachable.count) == (0, 2)
    assert of_runs.unreachable.bytes == record[c] + record[d] + size[3] + size[4]
