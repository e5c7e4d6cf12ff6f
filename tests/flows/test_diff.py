"""Two results side by side."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
from tiny_runs import run_tiny, ss_flow


def test_a_result_agrees_with_itself(tiny):
    answer = ss_flow("diff", tiny.out, tiny.out, "--json")
    assert answer.code == 0, answer.err
    document = answer.document()
    assert document["params"] == {} and document["models"] == {}
    assert document["instances"]["agreement"] == 1.0
    nodes = json.loads((tiny.out / "run.json").read_text())["nodes"]
    assert sum(step["same"] for step in document["steps"].values()) == len(nodes)
    assert all(a == b for a, b in document["metrics"].values())


def test_a_changed_parameter_and_what_it_changed_are_told(warm, tmp_path):
    other = tmp_path / "other"
    assert run_tiny(warm.scene, warm.store, "--set", "masks.share=0", out=other).code == 0
    document = ss_flow("diff", warm.out, other, "--json").document()
    assert list(document["params"]) == ["splat.masks.share"]
    assert document["params"]["splat.masks.share"][1] == 0
    changed = [step for step, row in document["steps"].items() if row["different"]]
    assert "splat.render_masks" in changed and "split.propagate" not in changed
    told = ss_flow("diff", warm.out, other)
    assert told.code == 0 and "splat.masks.share" in told.out and "agreement" in told.out


def test_files_that_were_given_to_one_run_are_told(warm, tmp_path, monkeypatch):
    other = tmp_path / "other"
    shutil.copytree(warm.scene / "instance_masks", tmp_path / "masks")
    monkeypatch.chdir(tmp_path)
    made = run_tiny(warm.scene, warm.store, "--masks", "masks", "--calibrate", "none", out=other)
    assert made.document()["given"] == {"masks": str(tmp_path / "masks"), "hints": None, "correct": None}
    assert made.document()["preset"] == "fast" and made.document()["set"][0] == "capture.calibrate=none"
    found = ss_flow("diff", warm.out, other, "--json").document()
    assert found["given"] == {"--masks": [None, str(tmp_path / "masks")]}
    assert f"--masks: None -> {tmp_path / 'masks'}" in ss_flow("diff", warm.out, other).out


def test_results_that_only_have_other_numbers_are_the_same(tiny, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(tiny.out, other)
    document = json.loads((other / "run.json").read_text())
    trained = [node for node in document["nodes"] if node["step"] == "splat.reconstruct"]
    document["nodes"].remove(trained.pop(0))  # an object that the other run joined to another one
    for number, node in enumerate(trained, 1):
        node["item"] = str(number)
    trained[-1]["outputs"] = ["ab" * 32]
    (other / "run.json").write_text(json.dumps(document))
    row = ss_flow("diff", tiny.out, other, "--json").document()["steps"]["splat.reconstruct"]
    counts = [row[name] for name in ("same", "different", "only_first", "only_second")]
    assert counts == [len(trained) - 1, 1, 1, 0]


def test_objects_are_matched_whatever_their_ids(tiny, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(tiny.out, other)
    ids: set[int] = set()
    for file in (other / "masks").iterdir():
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        ids |= set(np.unique(image).tolist())
        cv2.imwrite(str(file), np.where(image > 0, image + 100, 0).astype(np.uint16))
    found = ss_flow("diff", tiny.out, other, "--json").document()["instances"]
    assert [(pair["first"], pair["second"]) for pair in found["pairs"]] == [(i, i + 100) for i in sorted(ids - {0})]
    assert found["agreement"] == 1.0


def test_results_without_a_view_in_common_are_compared_without_objects(tiny, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(tiny.out, other)
    for file in (other / "masks").iterdir():
        file.rename(file.with_stem(f"other-{file.stem}"))
    answer = ss_flow("diff", tiny.out, other, "--json")
    assert answer.code == 0 and answer.document()["instances"] is None
    assert answer.document()["not_compared"] == "the two results have no view of the same name"
    assert "no view of the same name" in ss_flow("diff", tiny.out, other).out


def test_objects_of_two_captures_are_not_compared_though_their_views_go_by_the_same_names(tiny, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(tiny.out, other)
    document = json.loads((other / "run.json").read_text())
    (other / "run.json").write_text(json.dumps(document | {"scene": "/moved/room"}))
    assert ss_flow("diff", tiny.out, other, "--json").document()["instances"]["agreement"] == 1.0
    document["results"]["ingest"] = ["ab" * 32]
    (other / "run.json").write_text(json.dumps(document | {"scene": "/other"}))
    answer = ss_flow("diff", tiny.out, other, "--json")
    assert answer.code == 0 and answer.document()["instances"] is None
    assert "objects: not compared; the two are of other photos." in ss_flow("diff", tiny.out, other).out


def test_a_result_without_masks_as_an_edited_one_is_said_to_have_none(tiny, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(tiny.out, other)
    shutil.rmtree(other / "masks")
    told = ss_flow("diff", tiny.out, other)
    assert told.code == 0 and f"objects: not compared; {other} has no masks." in told.out.replace("\n", " ")


def test_bad_input_gets_one_sentence(tiny, tmp_path):
    answer = ss_flow("diff", tiny.out, tmp_path)
    assert answer.code == 2 and "not the output folder of a run" in answer.err
    other = tmp_path / "other"
    shutil.copytree(tiny.out, other)
    file = sorted((other / "masks").iterdir())[0]
    file.write_bytes(b"no image")
    answer = ss_flow("diff", tiny.out, other)
    assert answer.code == 2 and file.name in answer.err and answer.err.count("\n") == 1
    cv2.imwrite(str(file), np.zeros((3, 3), np.uint16))
    answer = ss_flow("diff", tiny.out, other)
    assert answer.code == 2 and "differ in size" in answer.err
