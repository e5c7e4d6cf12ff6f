from __future__ import annotations

import dataclasses
import errno
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import ss_flow_toy as toy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ss_flow.cache import codec
from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import Gone, OtherVersion, StoreFailure, writing
from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.files import write_atomically
from ss_flow.cache.store import GRACE_SECONDS, Action, Store
from ss_flow.cache.survey import Survey
from ss_flow.cache.verify import verify
from ss_flow.tasks import artifacts
from ss_flow.tasks.artifacts import Cameras, Gaussians, LabelMap, Metrics, PointCloud

arrays = st.integers(0, 5).flatmap(lambda rows: hnp.arrays(np.float32, (rows, 3)))


@given(arrays, st.floats(allow_nan=False), st.floats(allow_nan=False))
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_stored_reads_back_equal_to_the_bit(store, points, unit, spacing):
    cloud = PointCloud(points, np.zeros(points.shape, np.uint8), unit, spacing)
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


def test_an_action_counts_only_while_its_outputs_are_there(store):
    output = store.put(LabelMap("x", np.ones((2, 2), np.uint16)))
    action = Action("ab" * 32, "step", (output,), False, {"parameters": {"p": 1}}, 1.5, 10.0)
    store.record(action)
    assert store.action(action.key) == action
    shutil.rmtree(store.object_path(output))
    assert store.action(action.key) is None
    assert store.action(action.key, whole=False) == action


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


def test_an_object_of_a_foreign_type_is_refused():
    with pytest.raises(ValueError, match="foreign"):
        codec.type_named("subprocess:Popen")


def test_only_dataclasses_of_arrays_and_plain_data_are_stored(store):
    with pytest.raises(TypeError, match="only dataclasses"):
        codec.write([1, 2], store.root / "tmp" / "x")
    with pytest.raises(TypeError, match="neither an array nor plain"):
        codec.write(Metrics({"a": object()}), store.root / "tmp" / "y")  # type: ignore[dict-item]


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


def test_a_store_of_a_group_stays_the_groups_though_a_user_has_a_private_umask(tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "store").chmod(0o2770)
    before = os.umask(0o077)
    try:
        store = Store(tmp_path / "store")
        if not hasattr(os, "getxattr") or "system.posix_acl_default" not in os.listxattr(store.root):
            pytest.skip("a file system without access control lists")
        store.record(
            Action("ab" * 32, "toy", (store.put(LabelMap("x", np.ones((2, 2), np.uint16))),), False, {}, 0.0, 0.0)
        )
        store.checkpoint("k").parent.mkdir()
        write_atomically(store.runs / "run" / "run.json", "{}")
        assert store.open_claims().take("k")
    finally:
        os.umask(before)
    made = list(store.root.rglob("*"))
    assert {"zarr.json", f"{'ab' * 32}.json", "checkpoints", "run.json", "k"} <= {path.name for path in made}
    assert [p for p in made if p.stat().st_mode & 0o070 != (0o070 if p.is_dir() else 0o060)] == []


def test_a_store_of_ones_own_stays_private(tmp_path):
    before = os.umask(0o077)
    try:
        store = Store(tmp_path / "store")
        store.put(LabelMap("x", np.ones((2, 2), np.uint16)))
    finally:
        os.umask(before)
    assert [path for path in store.root.rglob("*") if path.stat().st_mode & 0o077] == []


def test_a_file_that_another_user_keeps_private_is_named_with_what_to_do(store, monkeypatch):
    def refuse(path, *_):
        raise PermissionError(errno.EACCES, "Permission denied", path)

    monkeypatch.setattr(os, "utime", refuse)
    with pytest.raises(StoreFailure, match=rf"Permission denied for {store.root}/objects/.*`chmod -R g\+rwX`"):
        store.put(LabelMap("x", np.ones((2, 2), np.uint16)))


def test_a_file_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    target = tmp_path / "x.json"
    write_atomically(target, "old")

    def crash(handle):
        raise OSError("power cut")

    monkeypatch.setattr(os, "fsync", crash)
    with pytest.raises(OSError, match="power cut"):
        write_atomically(target, "new")
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


@pytest.mark.parametrize(
    "name", ["x" * 255, "\u5199" * 85, os.fsdecode(b"\xff" * 250)], ids=["long", "3 bytes", "no text"]
)
def test_a_file_may_have_the_longest_name_that_file_systems_take(tmp_path, name):
    write_atomically(tmp_path / name, "content")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "content"}


@pytest.mark.parametrize("synced", [True, False])
def test_a_file_is_synced_where_nothing_makes_it_again(tmp_path, monkeypatch, synced):
    calls = []
    monkeypatch.setattr(os, "fsync", calls.append)
    write_atomically(tmp_path / "a", "content", synced=synced)
    assert (tmp_path / "a").read_text() == "content" and len(calls) == synced


def test_what_killed_writers_left_beside_a_file_is_taken_away_by_age_and_nothing_else_is(tmp_path):
    left, young = (tmp_path / f".a[1].ply.{digit * 32}" for digit in "0f")
    others = [tmp_path / name for name in (".a[1].ply.0123", f".a1.ply.{'0' * 32}", f".b.a[1].ply.{'0' * 32}")]
    for path in (left, young, *others):
        path.write_text("x")
        if path != young:
            os.utime(path, (0, time.time() - 2 * GRACE_SECONDS))
    write_atomically(tmp_path / "a[1].ply", "new")
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "a[1].ply", young, *others])


def test_a_file_is_read_once_until_it_changes(tmp_path, monkeypatch):
    from ss_flow.cache import file_digests

    reads = []
    real = file_digests.digest_file
    monkeypatch.setattr(file_digests, "digest_file", lambda p: reads.append(p) or real(p))
    photo = tmp_path / "photo"
    photo.write_text("one")
    with FileDigests(tmp_path / "files.json") as first:
        value = first(photo)
    again = FileDigests(tmp_path / "files.json")
    assert again(photo) == value
    assert len(reads) == 1
    photo.write_text("another")
    assert again(photo) != value
    FileDigests(tmp_path / "files.json", verify=True)(photo)
    assert len(reads) == 3


def test_a_damaged_table_of_files_is_learnt_again(tmp_path):
    photo = tmp_path / "photo"
    photo.write_text("one")
    digests = FileDigests(tmp_path / "files.json")
    right = digests(photo)
    digests.save()
    good = (tmp_path / "files.json").read_text()
    for bad in ("{", "[]", good.replace(right[:8], "0" * 8), good[:-9]):
        (tmp_path / "files.json").write_text(bad)
        assert FileDigests(tmp_path / "files.json")(photo) == right


def test_a_table_of_files_that_cannot_be_read_or_written_is_learnt_again_and_nothing_fails(tmp_path, monkeypatch):
    photo = tmp_path / "photo"
    photo.write_text("one")
    with FileDigests(tmp_path / "files.json") as first:
        right = first(photo)

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "read_text", refuse)
        patched.setattr(os, "fsync", refuse)
        with FileDigests(tmp_path / "files.json") as digests:
            assert digests._known == {} and digests(photo) == right
    assert FileDigests(tmp_path / "files.json")._known == first._known


def test_a_store_that_was_moved_away_is_not_there_again_for_what_was_learnt_of_files(tmp_path):
    photo = tmp_path / "photo"
    photo.write_text("one")
    with FileDigests(tmp_path / "moved" / "files.json") as digests:
        digests(photo)
    assert not (tmp_path / "moved").exists()


def test_files_of_folders_that_are_gone_are_forgotten_and_what_was_checked_is_not(tmp_path):
    files = [tmp_path / name / "photo" for name in ("here", "gone")]
    with FileDigests(tmp_path / "files.json") as digests:
        for file in files:
            file.parent.mkdir()
            file.write_text("one")
            digests(file)
        digests.once(lambda subject: None, None, ["of a model"])
        shutil.rmtree(files[1].parent)
    assert list(FileDigests(tmp_path / "files.json")._known) == [str(files[0]), "checked of a model"]


def test_a_damaged_object_is_taken_out_and_never_served(store):
    output = store.put(LabelMap("x", np.eye(64, dtype=np.uint16)))
    files = {f: f.read_bytes() for f in store.object_path(output).rglob("*") if f.is_file()}
    for file, whole in files.items():
        for position in range(0, len(whole), max(1, len(whole) // 20)):
            flipped = bytearray(whole)
            flipped[position] ^= 1
            store.put(LabelMap("x", np.eye(64, dtype=np.uint16)))
            file.write_bytes(flipped)
            try:
                value = Store(store.root).get(output)
            except Gone:
                assert output not in store
            else:  # a bit that says nothing: white space, or how a number is written
                assert digest(value) == output
            shutil.rmtree(store.object_path(output), ignore_errors=True)


def _changed_label_map(*fields: str) -> type:
    """LabelMap as another version might have it."""
    kind = dataclasses.make_dataclass("LabelMap", fields, frozen=True)
    kind.__module__ = LabelMap.__module__
    return kind


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (("name", "ids", "scale"), "LabelMap has the new field scale"),
        (("name",), "LabelMap has no field ids any more"),
        (("name", "labels"), "LabelMap has no field ids any more, has the new field labels"),
    ],
)
def test_an_object_whose_type_has_other_fields_by_now_stays_and_is_not_called_damaged(store, monkeypatch, fields, said):
    output = store.put(LabelMap("x", np.eye(64, dtype=np.uint16)))
    store.record(Action("ab" * 32, "split.look", (output,), False, {}, 1.5, 10.0))
    with monkeypatch.context() as patch:
        patch.setattr(artifacts, "LabelMap", _changed_label_map(*fields))
        with pytest.raises(OtherVersion) as told:
            Store(store.root).get(output)
        assert said in str(told.value) and "split.look" in str(told.value) and "damaged" not in str(told.value)
        walks, actions = [], Store.actions
        patch.setattr(Store, "actions", lambda store: walks.append(store) or actions(store))
        assert verify(store).damaged == ()
        assert len(walks) == 1  # not once for each such object
    assert Store(store.root).get(output).name == "x"


@pytest.mark.parametrize("missing", ["module", "class"])
def test_an_object_whose_type_is_not_to_be_found_here_stays_and_is_not_called_damaged(store, monkeypatch, missing):
    output = store.put(toy.number(2.0))
    with monkeypatch.context() as patch:
        if missing == "module":
            patch.setitem(sys.modules, "ss_flow_toy", None)
        else:
            patch.delattr(toy, "Number")
        with pytest.raises(OtherVersion, match="there is no type ss_flow_toy:Number here") as told:
            Store(store.root).get(output)
        assert "damaged" not in str(told.value)
        assert verify(store).damaged == ()
        chunk = store.object_path(output) / "value/c.0"
        whole = chunk.read_bytes()
        chunk.write_bytes(whole[::-1])
        assert [damage.name for damage in verify(Store(store.root)).damaged] == [output]
    assert store.get(store.put(toy.number(2.0))).value[0] == 2.0


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EACCES, errno.EIO, errno.ENOMEM])
def test_an_object_that_cannot_be_read_now_stays_and_the_store_says_why_in_one_sentence(store, monkeypatch, number):
    value = LabelMap("x", np.eye(3, dtype=np.uint16))
    output = store.put(value)
    refused = OSError(number, os.strerror(number))
    for trouble in ("open", "lstat"):
        with monkeypatch.context() as patch:
            place, name = (codec, "open") if trouble == "open" else (codec.os, "lstat")
            patch.setattr(place, name, lambda *_: (_ for _ in ()).throw(refused), raising=False)
            for ask in (Store(store.root).get, lambda _: store.put(value), lambda _: verify(store)):
                with pytest.raises(StoreFailure, match=os.strerror(number)):
                    ask(output)
    assert Store(store.root).get(output).ids.trace() == 3


def test_a_part_that_a_power_cut_left_empty_is_written_again(store):
    store.put_part("0a", ["one", "two"])
    (store.root / "parts" / "0a.json").write_bytes(b"")
    store.put_part("0a", ["one", "two"])
    assert store.part("0a") == ["one", "two"]


def test_files_that_lie_about_in_a_store_are_no_hindrance(store):
    output = store.put(LabelMap("x", np.ones((2, 2), np.uint16)))
    for folder in ("objects", "actions"):
        (store.root / folder / ".DS_Store").write_text("x")
    assert [entry.name for entry in store.objects()] == [output]
    assert list(store.actions()) == [] and not verify(store).damaged


def test_a_store_may_be_named_by_a_text(tmp_path):
    output = Store(str(tmp_path / "store")).put(LabelMap("x", np.ones((2, 2), np.uint16)))
    assert output in Store(tmp_path / "store")


def test_a_store_that_was_named_by_a_relative_path_stays_where_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = Store(Path("here"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert store.put(toy.number(1.0)) in Store(tmp_path / "here")


@pytest.mark.parametrize("kind", ["folder", "loop", "unreadable"])
def test_a_record_that_cannot_be_read_counts_for_nothing_and_is_recorded_again(store, monkeypatch, kind):
    action = Action("ab" * 32, "step", (store.put(toy.number(1.0)),), False, {}, 1.5, 10.0)
    store.record(action)
    path = store.action_path(action.key)
    if kind == "unreadable":
        refused = PermissionError(errno.EACCES, "Permission denied")
        monkeypatch.setattr("ss_flow.cache.store.read_stamped", lambda _: (_ for _ in ()).throw(refused))
    else:
        path.unlink()
        path.mkdir() if kind == "folder" else path.symlink_to(path)
    assert store.action(action.key) is None
    assert not Survey.of(store).is_whole(action.key)
    assert [damage.name for damage in verify(store).damaged] == [action.key]
    if kind == "folder":
        path.mkdir()
    store.record(action)
    monkeypatch.undo()
    assert store.action(action.key) == action


def test_a_process_that_can_open_no_file_takes_no_record_for_missing(store, monkeypatch):
    action = Action("ab" * 32, "step", (store.put(toy.number(1.0)),), False, {}, 1.5, 10.0)
    store.record(action)
    refused = OSError(errno.EMFILE, "Too many open files")
    monkeypatch.setattr("ss_flow.cache.store.read_stamped", lambda _: (_ for _ in ()).throw(refused))
    with pytest.raises(StoreFailure, match="cannot be read: Too many open files"):
        verify(store)
    monkeypatch.undo()
    assert store.action(action.key) == action


def test_an_object_that_memory_is_too_short_for_stays(store, monkeypatch):
    output = store.put(LabelMap("x", np.zeros((400, 500), np.uint16)))
    for name in ("_read_chunks", "_read_file"):
        with monkeypatch.context() as patch:
            patch.setattr(codec, name, lambda *_: (_ for _ in ()).throw(MemoryError))
            with pytest.raises(MemoryError):
                Store(store.root).get(output)
    assert Store(store.root).get(output).ids.shape == (400, 500)


def test_an_object_that_lost_a_field_on_the_disk_is_damaged(store):
    output = store.put(LabelMap("x", np.eye(64, dtype=np.uint16)))
    shutil.rmtree(store.object_path(output) / "ids")
    with pytest.raises(Gone, match="was damaged"):
        Store(store.root).get(output)
    assert output not in store


def test_an_action_that_is_not_of_its_key_or_not_json_is_none(store):
    action = Action("ab" * 32, "step", (store.put(LabelMap("x", np.ones((2, 2)))),), False, {}, 1.5, 10.0)
    store.record(action)
    path = store.action_path(action.key)
    good = path.read_text()
    changes = (good.replace("abab", "abac"), good[:-3], "[]", "{}", good.replace(action.outputs[0], "../" * 20))
    for bad in changes:
        path.write_text(bad)
        assert store.action(action.key) is None
    path.write_text(good)
    assert store.action(action.key) == action


def test_a_store_that_can_open_no_file_to_write_says_what_is_wanted(store):
    said = r"Too many open files.* when more files may be open \(`ulimit -n`"
    with pytest.raises(StoreFailure, match=said), writing(store.root):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def test_a_store_that_cannot_be_written_says_so_in_one_sentence(store, monkeypatch):
    value = LabelMap("x", np.ones((2, 2), np.uint16))
    monkeypatch.setattr(codec, "write", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(StoreFailure, match="No space left on device"):
        store.put(value)
    monkeypatch.undo()
    shutil.rmtree(store.root)
    with pytest.raises(StoreFailure, match="it has vanished"):
        store.put(value)
    with pytest.raises(StoreFailure, match="it has vanished"):
        store.open_claims().take("k")


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
    digest = store.put(toy.Table({"a": [1]}, ["a"]))
    for _ in range(2):
        found = store.get(digest)
        assert found == toy.Table({"a": [1]}, ["a"])
        found.rows["a"].append(2)
        found.names.clear()


def test_the_digest_of_a_file_whose_name_is_no_text_is_remembered(tmp_path):
    file = tmp_path / "a\udcff.jpg"
    file.write_bytes(b"x")
    digests = FileDigests(tmp_path / "files.json")
    known = digests(file)
    digests.save()
    assert FileDigests(tmp_path / "files.json")._known[str(file)][3] == known


def test_what_cannot_be_digested_is_refused_with_the_name_of_its_field(store):
    with pytest.raises(TypeError, match=r"Table\.rows holds a set, which is neither an array nor plain data"):
        store.put(toy.Table({"a": {1}}, []))
