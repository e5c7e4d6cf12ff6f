"""What one machine computed into a bucket is all hits on another, on the command line too."""

from __future__ import annotations

import os

from remote_stores import computed, names, run
from tiny_runs import run_tiny, ss_flow, write_room

from ss_flow.cache.location import open_store


def test_what_one_machine_computed_is_all_hits_on_another(here, there):
    first = run(here)
    assert computed(first) == 8
    again = run(there)
    assert computed(again) == 0 and len(again.nodes) == 8
    assert again.values == first.values
    assert float(there.get(again.values["total"]).value[0]) == 14.0


def test_processes_work_on_a_bucket_by_its_location(location, there):
    store = open_store(location)
    assert store.root.is_relative_to(os.environ["XDG_CACHE_HOME"])
    assert computed(run(store, executor="processes")) == 8
    assert computed(run(there)) == 0


def test_nothing_in_the_bucket_is_a_credential(here, bucket, monkeypatch):
    run(here)
    kept = [bucket.get(name)[0] for folder in ("actions", "parts", "claims") for name in names(bucket, folder)]
    kept += [path.read_bytes() for path in (here.root / "roots").rglob("*") if path.is_file()]
    assert kept
    assert not [content for content in kept if b"SECRET" in content or b'"test"' in content]


def test_the_command_line_takes_a_location_from_the_option_and_from_the_environment(location, monkeypatch):
    run(open_store(location))
    assert ss_flow("status", "--json", "--cache", location).document()["scene"] == "toy"
    monkeypatch.setenv("SS_FLOW_CACHE", location)
    rows = ss_flow("cache", "ls", "--json").document()
    assert len(rows) == 8 and all(row["bytes"] > 0 for row in rows)
    called = ss_flow("status", "--cache", "s3://bucket/elsewhere")
    assert called.code == 2
    assert "the store s3://bucket/elsewhere knows no run" in called.err


def test_a_scene_that_one_machine_ran_is_reused_and_searched_by_another(location, tmp_path, monkeypatch):
    monkeypatch.setenv("SS_FLOW_MODELS", "")
    scene = write_room(tmp_path / "room")
    first = run_tiny(scene, location, out=tmp_path / "first")
    assert first.code == 0, first.err
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "another"))
    again = run_tiny(scene, location, out=tmp_path / "again")
    assert again.code == 0, again.err
    assert not again.computed()
    assert again.results() == first.results()
    assert again.document()["store"] == location
    assert ss_flow("query", tmp_path / "again", "red", "--json").document()["instances"]
