"""Final results that are damaged: nobody reads them in a run of hits but who writes the output folder."""

from __future__ import annotations

import shutil

import pytest
from tiny_runs import SHORT, bytes_of, run_tiny, ss_flow

from ss_flow.cache.store import Store
from ss_flow.flows import deliver as deliver_module


def damage(store, object_digest):
    """Cut the largest file of a stored object short."""
    files = [path for path in Store(store).object_path(object_digest).rglob("*") if path.is_file()]
    largest = max(files, key=lambda path: path.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:-1])


def differing(before, after):
    assert set(before) == set(after)
    return {name for name in before if before[name] != after[name]} - {"run.json", "report.html"}


def test_a_run_whose_final_results_are_damaged_makes_them_again_and_says_so(warm):
    before = bytes_of(warm.out)
    shutil.rmtree(warm.out)
    results = warm.called.results()
    for object_digest in (results["scene"], results["masks"][3], results["metrics_splat"], results["dense"]):
        damage(warm.store, object_digest)
    again = run_tiny(warm.scene, warm.store, out=warm.out)
    assert again.code == 0, again.err
    assert again.err.count("was damaged") == 4 and "again" in again.err
    assert set(again.computed()) == {
        "splat.global_pass",
        "splat.render_masks",
        "evaluate.instances.evaluate_masks",
        "split.dense",
    }
    assert again.results() == results
    assert differing(before, bytes_of(warm.out)) == set()
    assert "done" in ss_flow("status", "--cache", warm.store).out
    whole = run_tiny(warm.scene, warm.store, out=warm.out)
    assert (whole.code, whole.computed(), whole.err) == (0, {}, "")


def test_a_result_damaged_while_the_folder_is_half_written_leaves_no_half_of_it(warm, monkeypatch):
    before = bytes_of(warm.out)
    shutil.rmtree(warm.out)
    last = warm.called.results()["report_pictures"][0]  # read for the report, after all else is written
    real, written = deliver_module.write_cloud, []

    def write_cloud(folder, *cloud):
        real(folder, *cloud)
        written.append(folder)
        if len(written) == 1:
            damage(warm.store, last)

    monkeypatch.setattr(deliver_module, "write_cloud", write_cloud)
    again = run_tiny(warm.scene, warm.store, out=warm.out)
    assert again.code == 0, again.err
    assert len(written) == 2 and not written[0].exists()
    assert again.computed() == {"deliver.report_pictures": 1}
    assert differing(before, bytes_of(warm.out)) == set()
    assert not list(warm.out.parent.glob(".out.*"))


def test_a_disk_that_damages_a_result_again_and_again_ends_the_run_with_one_sentence(warm, monkeypatch):
    shutil.rmtree(warm.out)
    scene = warm.called.results()["scene"]
    real, written = deliver_module.write_all, []

    def write_all(folder, *rest, **options):
        written.append(folder)
        damage(warm.store, scene)
        real(folder, *rest, **options)

    monkeypatch.setattr(deliver_module, "write_all", write_all)
    failed = run_tiny(warm.scene, warm.store, out=warm.out)
    assert failed.code == 1 and failed.out == ""
    assert "is the disk failing?" in failed.err and "Traceback" not in failed.err
    assert len(written) == 2
    assert not warm.out.exists() and not list(warm.out.parent.glob(".out.*"))
    monkeypatch.setattr(deliver_module, "write_all", real)
    assert run_tiny(warm.scene, warm.store, out=warm.out).code == 0


def test_a_batch_makes_damaged_results_again_and_gives_up_only_the_scene_whose_disk_fails(warm, tmp_path, monkeypatch):
    damage(warm.store, warm.called.results()["scene"])
    called = ss_flow(
        "batch", warm.scene, "--out", tmp_path / "b", "--cache", warm.store, "--preset", "fast", "--json", *SHORT
    )
    assert called.code == 0, called.err
    assert [row["status"] for row in called.document()] == ["ok"]
    scene = tmp_path / "b/room/scene.ply"
    assert scene.read_bytes() == (warm.out / "scene.ply").read_bytes()

    real = deliver_module.write_all

    def write_all(folder, store, document, *rest, **options):
        if document["scene"] == str(warm.scene):
            damage(warm.store, document["results"]["scene"])
        real(folder, store, document, *rest, **options)

    monkeypatch.setattr(deliver_module, "write_all", write_all)
    other = tmp_path / "other"
    shutil.copytree(warm.scene, other)
    both = ["--out", tmp_path / "c", "--cache", warm.store, "--preset", "fast", "--json", *SHORT]
    called = ss_flow("batch", warm.scene, other, *both)
    assert called.code == 3, called.err
    rows = {row["scene"]: row for row in called.document()}
    assert "is the disk failing?" in rows[str(warm.scene)]["error"]
    assert rows[str(other)]["status"] == "ok"


@pytest.mark.parametrize("swept", ["semantics.tau_corr=0.1,0.2"])
def test_a_sweep_makes_the_damaged_results_again_of_which_it_tells(warm, tmp_path, swept):
    results = warm.called.results()
    damage(warm.store, results["scene"])
    damage(warm.store, results["metrics_split"])
    options = ["--out", tmp_path / "sweep", "--cache", warm.store, "--preset", "fast", "--json", *SHORT]
    called = ss_flow("sweep", warm.scene, "--set", swept, *options)
    assert called.code == 0, called.err
    assert [(row["status"], row["misses"]) for row in called.document()] == [("ok", 2), ("ok", 0)]


def test_an_answer_to_a_search_that_is_damaged_is_found_anew(warm):
    def ask():
        return ss_flow("query", warm.out, "the purple shelf", "--json", "--cache", warm.store)

    held = {entry.name for entry in Store(warm.store).objects()}
    first = ask()
    assert first.code == 0, first.err
    found = {entry.name for entry in Store(warm.store).objects()} - held
    assert len(found) == 2  # the similarities, and the answer that is made of them
    for result in found:
        damage(warm.store, result)
    again = ask()
    assert (again.code, again.out) == (0, first.out), again.err
