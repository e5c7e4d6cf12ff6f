"""A store from someone else: nothing in it runs, leads out of it, or takes more memory than it holds."""

from __future__ import annotations

import json
import os
import pickle
import shutil

import numpy as np
import pytest

from ss_flow.cache.errors import Gone, StoreFailure
from ss_flow.cache.pins import read_pins
from ss_flow.cache.store import Action, Store
from ss_flow.cache.verify import verify
from ss_flow.runs import Run, latest_runs
from ss_flow.tasks.artifacts import LabelMap

SMALL = LabelMap("x", np.eye(8, dtype=np.uint16))
LARGE = LabelMap("x", np.arange(200_000, dtype=np.uint16).reshape(400, 500))


def edited(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def shape(*sides):
    def change(header):
        header["shape"] = list(sides)
        header["chunk_grid"]["configuration"]["chunk_shape"] = list(sides)

    return change


def set_to(*names_and_value):
    *names, value = names_and_value

    def change(header):
        for name in names[:-1]:
            header = header[name]
        header[names[-1]] = value

    return change


@pytest.mark.parametrize("value", [SMALL, LARGE], ids=["small", "large"])
@pytest.mark.parametrize(
    "change",
    [
        shape(2**31, 2**31),
        shape(2**62),
        shape(400, 500_000_000),
        shape(-1, 5),
        shape("400", "x"),
        set_to("data_type", "object"),
        set_to("data_type", "float64"),
        set_to("data_type", "../../etc"),
        set_to("codecs", [{"name": "pickle"}]),
        set_to("codecs", [{"name": "bytes"}, {"name": "numcodecs.pickle"}]),
        set_to("chunk_grid", "configuration", "chunk_shape", [2**40, 2**20]),
        set_to("chunk_grid", "configuration", "chunk_shape", [0, 0]),
        set_to("chunk_key_encoding", {"name": "../../.."}),
    ],
)
def test_an_array_that_is_not_what_it_says_is_never_served(store, value, change):
    output = store.put(value)
    edited(store.object_path(output) / "ids" / "zarr.json", change)
    try:
        back = Store(store.root).get(output)
    except Gone:
        assert output not in store
    else:  # a header that the reader has no use for
        np.testing.assert_array_equal(back.ids, value.ids)


@pytest.mark.parametrize(
    "change",
    [
        set_to("attributes", "type", "os:system"),
        set_to("attributes", "type", "ss_flow.cache.store:Store"),
        set_to("attributes", "type", "ss_flow.cache.store:os.system"),
        set_to("attributes", "type", "ss_flow.nowhere:Thing"),
        set_to("attributes", "type", "ss_flow.tasks.artifacts:PointCloud"),
        set_to("attributes", "type", 7),
        set_to("attributes", "values", {"name": "x", "ids": "../../../etc/passwd"}),
        set_to("attributes", "values", ["x"]),
        set_to("attributes", None),
    ],
)
def test_an_object_that_names_another_type_or_other_fields_is_never_served(store, change):
    output = store.put(SMALL)
    edited(store.object_path(output) / "zarr.json", change)
    with pytest.raises(Gone):
        Store(store.root).get(output)


def test_the_object_of_another_digest_is_never_served(store):
    output, other = store.put(SMALL), store.put(LARGE)
    shutil.rmtree(store.object_path(output))
    shutil.copytree(store.object_path(other), store.object_path(output))
    with pytest.raises(Gone, match="not what its name says"):
        Store(store.root).get(output)


def test_a_link_a_pipe_and_a_device_in_the_place_of_a_file_are_refused(store):
    for replace in (
        lambda place: os.symlink("/dev/zero", place),
        lambda place: os.symlink("/etc/passwd", place),
        os.mkfifo,
        os.mkdir,
    ):
        for name in ("zarr.json", "ids/zarr.json", "ids/c.0.0"):
            output = store.put(SMALL)
            (store.object_path(output) / name).unlink()
            replace(store.object_path(output) / name)
            with pytest.raises(Gone):
                Store(store.root).get(output)


def test_a_pickle_is_never_opened(store, tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    output = store.put(SMALL)
    trap = pickle.dumps(Trap())
    for file in store.object_path(output).rglob("*"):
        if file.is_file():
            file.write_bytes(trap)
    with pytest.raises(Gone):
        Store(store.root).get(output)
    action = Action("ab" * 32, "s", (store.put(SMALL),), False, {}, 0.0, 0.0)
    store.record(action)
    store.action_path(action.key).write_bytes(trap)
    assert store.action(action.key) is None
    assert not (tmp_path / "sprung").exists()


def test_an_action_whose_outputs_lead_out_of_the_store_is_none(store):
    for output in ("../../../../etc", "/etc/passwd", "ab" * 31 + "/.", "AB" * 32, "ab" * 33):
        action = Action("ab" * 32, "s", (output,), False, {}, 0.0, 0.0)
        store.record(action)
        assert store.action(action.key) is None
        assert store.action(action.key, whole=False) is None


def test_a_document_that_is_nested_without_end_is_none(store):
    key, deep = "ab" * 32, "[" * 100_000
    for name in (f"actions/ab/{key}.json", f"parts/{key}.json", f"claims/{key}", "roots/runs/r/run.json"):
        (store.root / name).parent.mkdir(parents=True, exist_ok=True)
        (store.root / name).write_text(deep)
    (store.runs / "r" / "events.jsonl").write_text(deep)
    assert store.action(key) is None and store.part(key) is None and store.open_claims().living() == {key}
    assert list(latest_runs(store.runs)) == list(Run(store.runs / "r", {}).events()) == []
    assert [damage.kind for damage in verify(store).damaged] == ["part", "action"]
    (store.root / "roots" / "pins" / "p.json").write_text(deep)
    with pytest.raises(StoreFailure, match="cannot be read"):
        read_pins(store)


def test_a_checkpoint_from_someone_else_is_left_aside(store, tmp_path):
    from ss_flow.running import Surroundings, load_checkpoint, running

    place = tmp_path / "kept.npz"
    with running(Surroundings(checkpoint=place)):
        for content in (pickle.dumps(print), b"PK\x03\x04" + b"x" * 100, b""):
            place.write_bytes(content)
            assert load_checkpoint() is None
        np.savez(place, a=np.array([print], object))
        assert load_checkpoint() is None
