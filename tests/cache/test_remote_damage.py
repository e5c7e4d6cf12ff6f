"""Nothing damaged is served, whether it is in the bucket, on its way or here."""

from __future__ import annotations

import sys

import pytest
import ss_flow_toy as toy
from remote_stores import action_of, emptied, label_map, names, run

from ss_flow.cache.bucket import Bucket
from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import Gone, OtherVersion, StoreFailure
from ss_flow.cache.remote import MANIFEST, RemoteStore
from ss_flow.cache.verify import verify


def test_a_damaged_object_in_the_bucket_is_never_served_and_is_taken_out_and_made_again(here, bucket):
    object_digest = here.put(label_map())
    files = {name: bucket.get(name)[0] for name in names(bucket, "objects")}
    for file, whole in files.items():
        for damage in (b"", whole[:-1], bytes([whole[0] ^ 1]) + whole[1:], whole[:40] + b"\x00" + whole[41:]):
            bucket.put(file, damage)
            reader = emptied(here)
            try:
                value = reader.get(object_digest)
            except Gone as gone:
                assert "damaged" in str(gone)
                assert object_digest not in reader
                assert names(bucket, "objects") == []
                reader.put(label_map())
            else:  # a bit that says nothing, such as white space
                assert digest(value) == object_digest
            assert digest(emptied(here).get(object_digest)) == object_digest
            bucket.put(file, whole)


@pytest.mark.parametrize("read", ["get", "read"])
def test_what_is_damaged_only_on_its_way_is_downloaded_again_and_stays_in_the_bucket(
    here, there, bucket, monkeypatch, read
):
    object_digest = here.put(label_map())
    held = names(bucket, "objects")
    real, damaged = Bucket.blocks, []

    def once(self, name):
        whole = b"".join(real(self, name))
        if damaged:
            return [whole]
        damaged.append(name)
        return [whole[: len(whole) // 2]]

    monkeypatch.setattr(Bucket, "blocks", once)
    assert digest(getattr(there, read)(object_digest)) == object_digest
    assert damaged and names(bucket, "objects") == held
    assert list((there.root / "tmp").iterdir()) == []


def test_a_damaged_copy_here_is_downloaded_again(here, there):
    object_digest = here.put(label_map())
    there.get(object_digest)
    place = there.object_path(object_digest) / "ids" / MANIFEST
    place.write_text("{}")
    assert digest(RemoteStore(there.location, there.root).get(object_digest)) == object_digest
    assert place.read_text() != "{}"


def test_an_object_whose_type_is_not_to_be_found_here_stays_in_the_bucket_and_here(here, there, monkeypatch):
    output = here.put(toy.number(2.0))
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "ss_flow_toy", None)
        for store in (there, here):
            with pytest.raises(OtherVersion, match="there is no type ss_flow_toy:Number here"):
                store.get(output)
            assert verify(store).damaged == ()
        assert here.object_path(output).is_dir()
    assert there.get(output).value[0] == 2.0


def test_a_damaged_copy_here_that_the_bucket_does_not_hold_is_gone(here, bucket):
    object_digest = here.put(label_map())
    (here.object_path(object_digest) / "ids" / MANIFEST).write_text("{}")
    bucket.delete(names(bucket, "objects"))
    reader = RemoteStore(here.location, here.root)
    with pytest.raises(Gone):
        reader.get(object_digest)
    assert object_digest not in reader


def test_files_with_names_that_lead_elsewhere_are_not_downloaded(here, there, bucket):
    object_digest = here.put(label_map())
    folder = f"objects/{object_digest[:2]}/{object_digest}"
    bucket.put(f"{folder}/.hidden", b"x")
    assert digest(there.get(object_digest)) == object_digest
    assert not (there.object_path(object_digest) / ".hidden").exists()


def test_a_full_disk_here_names_the_folder_and_leaves_nothing(here, there, monkeypatch):
    object_digest = here.put(label_map())
    monkeypatch.setattr(Bucket, "blocks", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(StoreFailure, match=rf"{there.root} cannot be written: No space left"):
        there.get(object_digest)
    assert list((there.root / "tmp").iterdir()) == []
    assert not there.object_path(object_digest).exists()


def test_a_folder_here_that_was_moved_away_is_not_there_again(here, there):
    object_digest = here.put(label_map())
    there.root.rename(there.root.with_name("moved"))
    with pytest.raises(StoreFailure, match=rf"{there.root} cannot be written: it has vanished"):
        there.get(object_digest)
    assert not there.root.exists()


def test_an_object_that_the_bucket_lost_is_restored_from_here_when_it_is_whole(here, there, bucket):
    whole, damaged = here.put(label_map()), here.put(label_map(8))
    (here.object_path(damaged) / "ids" / MANIFEST).write_text("{}")
    bucket.delete(names(bucket, "objects"))
    for object_digest in (whole, damaged):
        with pytest.raises(Gone):
            there.get(object_digest)
        here.restore(object_digest)
    assert digest(there.get(whole)) == whole
    assert damaged not in there and damaged not in here


def test_a_damaged_action_in_the_bucket_counts_for_nothing_and_is_recorded_again(here, there, bucket):
    action = action_of(here.put(label_map()))
    here.record(action)
    (name,) = names(bucket, "actions")
    good = bucket.get(name)[0]
    for bad in (
        good.replace(b"abab", b"abac"),
        good[:-3],
        b"[]",
        b"\xff",
        good.replace(action.outputs[0].encode(), b"../"),
    ):
        bucket.put(name, bad)
        assert there.action(action.key) is None
    there.record(action)
    assert there.action(action.key) == action
    assert emptied(here).action(action.key) == action


def test_a_flow_heals_what_is_damaged_in_the_bucket(here, there, bucket):
    report = run(here)
    damaged = report.values["squares"][1]
    file = next(n for n in names(bucket, f"objects/{damaged[:2]}/{damaged}") if not n.endswith(MANIFEST))
    bucket.put(file, b"\x00" * 8)
    total = there.action_path(next(n["key"] for n in report.nodes if n["label"] == "ss_flow_toy.total"))
    bucket.delete([total.relative_to(there.root).as_posix()])
    again = run(there)
    assert again.values == report.values
    assert {n["label"] for n in again.nodes if n["event"] == "finished"} == {
        "ss_flow_toy.square[n1]",
        "ss_flow_toy.total",
    }
    assert digest(emptied(here).get(damaged)) == damaged


def test_verifying_reads_the_bucket_even_where_the_copy_here_is_whole(here, bucket):
    good, damaged = here.put(label_map()), here.put(label_map(8))
    bucket.put(f"objects/{damaged[:2]}/{damaged}/ids/{MANIFEST}", b"{}")
    found = verify(here)
    assert [damage.name for damage in found.damaged] == [damaged]
    assert found.objects.count == 2
    assert good in emptied(here) and damaged not in emptied(here)
