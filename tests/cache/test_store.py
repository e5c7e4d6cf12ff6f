"""What is stored once is read back as it was, and nothing else is taken for an object."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
import ss_flow_toy as toy
from clouds import even_cloud
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ss_flow.cache import codec
from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import Gone
from ss_flow.cache.store import GRACE_SECONDS, Store
from ss_flow.cache.verify import verify
from ss_flow.tasks.artifacts import Cameras, Gaussians, LabelMap, Metrics

arrays = st.integers(0, 5).flatmap(lambda rows: hnp.arrays(np.float32, (rows, 3)))


@given(arrays, st.floats(allow_nan=False), st.floats(allow_nan=False))
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_stored_reads_back_equal_to_the_bit(store, points, unit, spacing):
    cloud = even_cloud(points, np.zeros(points.shape, np.uint8), unit, spacing)
    object_digest = store.put(cloud)
    back = Store(store.root).get(object_digest)
    assert digest(back) == object_digest
    assert back.points.shape == points.shape
    assert isinstance(back.unit, float)


def test_texts_flags_tuples_and_tables_survive(store):
    cameras = Cameras(("a", "ü"), np.ones((2, 2), np.int32), np.ones((2, 4)), np.ones((2, 4, 4)), True)
    back = Store(store.root).get(store.put(cameras))
    assert (back.names, back.metric) == (("a", "ü"), True)
    metrics = Metrics({"miou": 0.5, "psnr": 30.0})
    assert Store(store.root).get(store.put(metrics)) == metrics


def test_arrays_come_back_read_only(store):
    value = Store(store.root).get(store.put(LabelMap("x", np.ones((2, 2), np.uint16))))
    with pytest.raises(ValueError, match="read-only"):
        value.ids[0, 0] = 2


def test_storing_the_same_twice_writes_once(store):
    value = LabelMap("x", np.ones((2, 2), np.uint16))
    first = store.put(value)
    files = {f: f.stat().st_mtime_ns for f in store.object_path(first).rglob("*")}
    assert store.put(value) == first
    assert {f: f.stat().st_mtime_ns for f in store.object_path(first).rglob("*")} == files


def test_an_object_in_the_format_of_another_version_is_written_anew(store):
    value = LabelMap("x", np.ones((2, 2), np.uint16))
    header = store.object_path(store.put(value)) / "zarr.json"
    header.write_text(header.read_text().replace(f'"format": {codec.FORMAT}', '"format": 0'))
    again = Store(store.root)
    assert again.get(again.put(value)).ids.sum() == 4


def test_a_writer_that_loses_the_race_takes_it_as_a_hit(store, monkeypatch):
    value = LabelMap("x", np.ones((2, 2), np.uint16))
    write = codec.write

    def slow(content, folder):
        write(content, folder)
        monkeypatch.setattr(codec, "write", write)
        Store(store.root).put(value)

    monkeypatch.setattr(codec, "write", slow)
    assert store.put(value) in store
    assert list((store.root / "tmp").iterdir()) == []


def test_a_failed_write_leaves_nothing_behind(store, monkeypatch):
    def full(content, folder):
        folder.mkdir()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(codec, "write", full)
    value = LabelMap("x", np.ones((2, 2), np.uint16))
    with pytest.raises(OSError, match="No space"):
        store.put(value)
    assert list((store.root / "tmp").iterdir()) == []
    assert digest(value) not in store


def test_an_unknown_object_is_gone(store):
    with pytest.raises(Gone, match="not in the store"):
        store.get("00" * 32)


@pytest.mark.parametrize("name", ["", ".", "..", "ab", "../../elsewhere", "AB" * 32])
def test_what_is_no_digest_is_not_in_the_store_and_costs_nothing(store, name):
    output = store.put(LabelMap("x", np.ones((2, 2), np.uint16)))
    assert name not in store
    with pytest.raises(Gone, match="not in the store"):
        store.get(name)
    with pytest.raises(ValueError, match="no digest"):
        store.discard(name)
    assert output in store


def test_what_others_put_among_the_objects_is_none_and_stays(store):
    output = store.put(LabelMap("x", np.ones((2, 2), np.uint16)))
    stranger = store.object_path(output).with_name("notes")
    stranger.mkdir()
    assert [entry.name for entry in store.objects()] == [output]
    assert not verify(store).damaged and stranger.is_dir()


def test_files_that_lie_about_in_a_store_are_no_hindrance(store):
    output = store.put(LabelMap("x", np.ones((2, 2), np.uint16)))
    for folder in ("objects", "actions", "actions/ab", "parts"):
        (store.root / folder).mkdir(exist_ok=True)
        (store.root / folder / ".DS_Store").write_text("x")
    assert [entry.name for entry in store.objects()] == [output]
    assert list(store.actions()) == list(store.parts()) == [] and not verify(store).damaged


def test_an_object_of_a_foreign_type_is_refused():
    with pytest.raises(ValueError, match="foreign"):
        codec.type_named("subprocess:Popen")


def test_only_dataclasses_of_arrays_and_plain_data_are_stored(store):
    with pytest.raises(TypeError, match="only dataclasses"):
        codec.write([1, 2], store.root / "tmp" / "x")
    with pytest.raises(TypeError, match="neither an array nor plain"):
        codec.write(Metrics({"a": object()}), store.root / "tmp" / "y")  # type: ignore[dict-item]


def test_what_cannot_be_digested_is_refused_with_the_name_of_its_field(store):
    with pytest.raises(TypeError, match=r"Table\.rows holds a set, which is neither an array nor plain data"):
        store.put(toy.Table({"a": {1}}, []))


def test_large_arrays_are_chunked_and_gaussians_keep_their_ids(store):
    n = 400_000
    gaussians = Gaussians(
        *(np.random.default_rng(0).random(s, np.float32) for s in ((n, 3), (n, 4), (n, 3), (n,), (n, 1, 3))),
        np.arange(n, dtype=np.int32),
        np.ones(n, np.float32),
        np.zeros(n, np.int32),
    )
    object_digest = store.put(gaussians)
    chunks = list((store.object_path(object_digest) / "means" / "c").rglob("*"))
    assert sum(c.is_file() for c in chunks) == 2
    assert np.array_equal(Store(store.root).get(object_digest).instance_id, gaussians.instance_id)


def test_what_a_killed_writer_left_is_swept_by_age(store):
    mine = store.root / "tmp" / "thesis.txt"
    with store.temporary() as place:
        left = place
    for path in (left, mine):
        path.write_text("x")
    assert store.sweep_temporaries() == 0
    for path in (left, mine):
        os.utime(path, (0, time.time() - 2 * GRACE_SECONDS))
    assert store.sweep_temporaries() == 1
    assert mine.exists() and not left.exists()


@pytest.mark.parametrize("left", [b"", b'["one","tvo"]'])
def test_a_part_that_is_empty_or_damaged_is_written_again(store, left):
    store.put_part("0a", ["one", "two"])
    (store.root / "parts" / "0a.json").write_bytes(left)
    store.put_part("0a", ["one", "two"])
    assert store.part("0a") == ["one", "two"]


def test_a_store_may_be_named_by_a_text(tmp_path):
    output = Store(str(tmp_path / "store")).put(LabelMap("x", np.ones((2, 2), np.uint16)))
    assert output in Store(tmp_path / "store")


def test_a_store_that_was_named_by_a_relative_path_stays_where_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = Store(Path("here"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert store.put(toy.number(1.0)) in Store(tmp_path / "here")


@pytest.mark.parametrize(
    "score",
    [toy.Score(3), toy.Score(0.5, (0.5, 7)), toy.Score(0.5, (1, 2)), toy.Score(0.5, path=((1, 2), "right"))],
    ids=["whole number", "types in turn", "whole numbers", "nested"],
)
def test_what_is_stored_comes_back_as_it_was_and_not_as_its_type_declares(store, score):
    digest = store.put(score)
    for found in (store.get(digest), store.get(digest), Store(store.root).get(digest)):
        for name in ("value", "at", "path"):
            assert repr(getattr(found, name)) == repr(getattr(score, name))


@pytest.mark.parametrize("at", [(1, 2), None, ()])
def test_a_type_that_only_type_checkers_know_is_no_hindrance_and_a_tuple_of_a_union_comes_back_as_one(store, at):
    found = store.get(store.put(toy.Checked(np.ones(2), at, ("x", 1))))
    assert (found.at, found.other, found.cells.sum()) == (at, ("x", 1), 2.0)


def test_lists_and_tables_belong_to_who_asked_for_them(store):
    digest = store.put(toy.Table({"a": [1]}, ["a"], ({"a": 1},)))
    for _ in range(2):
        found = store.get(digest)
        assert found == toy.Table({"a": [1]}, ["a"], ({"a": 1},))
        found.rows["a"].append(2)
        found.names.clear()
        found.entries[0]["a"] = 2
