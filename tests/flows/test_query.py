"""Searching a result by words."""

from __future__ import annotations

import json
import shutil

import pytest
from tiny_runs import ss_flow

from ss_flow.tasks.gaussians.read_ply import read_gaussians


def colours(tiny) -> dict[str, int]:
    """The colour words of the small things, whose objects are in the table's order the last ones."""
    names = json.loads((tiny.scene / "instances.json").read_text())
    return {name.split()[0]: int(instance_id) for instance_id, name in names.items()}


def test_a_search_ranks_all_instances_and_the_best_has_the_colour(tiny):
    answer = ss_flow("query", tiny.out, "something white", "--json", "--cache", tiny.store)
    assert answer.code == 0, answer.err
    document = answer.document()
    rows = document["instances"]
    assert document["encoder"] == "colour words"
    ids = [e["id"] for e in json.loads((tiny.out / "instances.json").read_text())["instances"]]
    assert sorted(row["id"] for row in rows) == ids
    assert [row["score"] for row in rows] == sorted((row["score"] for row in rows), reverse=True)
    assert rows[0]["delta"] == 0


def test_the_background_is_ranked_only_on_request(tiny):
    asked = ss_flow("query", tiny.out, "white", "--background", "--json", "--cache", tiny.store).document()["instances"]
    usual = ss_flow("query", tiny.out, "white", "--json", "--cache", tiny.store).document()["instances"]
    assert [row["id"] for row in asked if row["id"]] == [row["id"] for row in usual]
    assert len(asked) == len(usual) + 1
    assert [row["name"] for row in asked if not row["id"]] == ["background"]


def test_the_object_of_a_colour_is_found(tiny):
    import cv2
    import numpy as np

    found = 0
    for colour, truth_id in colours(tiny).items():
        answer = ss_flow("query", tiny.out, colour, "--json", "--cache", tiny.store)
        if answer.code != 0:
            continue
        matched = {row["id"] for row in answer.document()["instances"] if row["matched"]}
        truth = np.stack([cv2.imread(str(p), -1) for p in sorted((tiny.scene / "instance").iterdir())])
        ours = np.stack([cv2.imread(str(p), -1) for p in sorted((tiny.out / "masks").iterdir())])
        own, count = np.unique(ours[(truth == truth_id) & (ours > 0)], return_counts=True)
        found += len(own) > 0 and int(own[count.argmax()]) in matched
    assert found >= 2


def test_a_text_that_is_an_instance_s_own_name_and_cannot_be_searched_for_is_said_to_be_one(warm):
    file = warm.out / "instances.json"
    document = json.loads(file.read_text())
    document["instances"][0] |= {"name": "Sofa", "named_by": "hints"}
    file.write_text(json.dumps(document))
    answer = ss_flow("query", warm.out, "sofa", "--cache", warm.store)
    assert answer.code == 2 and "names no colour" in answer.err
    assert "An instance has this name: export and render take --instance 'Sofa'." in answer.err
    assert "An instance" not in ss_flow("query", warm.out, "couch", "--cache", warm.store).err


def test_a_search_works_on_the_store_that_the_run_names(tiny):
    assert ss_flow("query", tiny.out, "red", "--json").code == 0


@pytest.mark.parametrize("tau", ["0.0001", "1.9"])
def test_words_for_people_name_the_instances(tiny, tau):
    answer = ss_flow("query", tiny.out, "white", "--tau-corr", tau, "--cache", tiny.store)
    assert answer.code == 0
    assert "score" in answer.out


def test_all_that_match_are_named_and_the_others_counted(tiny, monkeypatch):
    monkeypatch.setattr("ss_flow.flows.cli.query.ROWS", 1)
    options = ("query", tiny.out, "white", "--cache", tiny.store)
    many = ss_flow(*options, "--json").document()["instances"]
    matching = [row for row in many if row["matched"]]
    assert 1 <= len(matching) < len(many)
    told = ss_flow(*options).out
    assert told.count("match ") == len(matching)
    assert f"{len(many) - len(matching)} more are farther off; --json names all." in told


def test_an_instance_without_gaussians_is_said_to_be_in_masks_only(warm):
    file = warm.out / "instances.json"
    document = json.loads(file.read_text())
    document["instances"][0] |= {"num_gaussians": 0, "file": None}
    file.write_text(json.dumps(document))
    sizes = {entry["id"]: entry["num_gaussians"] for entry in document["instances"]}
    asked = ("query", warm.out, "white", "--background", "--cache", warm.store)
    rows = ss_flow(*asked, "--json").document()["instances"]
    assert {row["id"]: row["num_gaussians"] for row in rows} == {0: None, **sizes}
    lines = [line for line in ss_flow(*asked).out.splitlines() if "in masks only" in line]
    assert len(lines) == list(sizes.values()).count(0) and document["instances"][0]["name"] in "".join(lines)


def test_words_that_colour_words_do_not_understand_are_named(tiny):
    asked = ("query", tiny.out, "white mug, not the red one", "--cache", tiny.store)
    told = ss_flow(*asked)
    assert 'Only colour words were understood, not "mug"; `ss-flow models list`' in told.out
    assert json.loads(ss_flow(*asked, "--json").out)  # nothing beside the document
    assert "Only colour words" not in ss_flow("query", tiny.out, "something white", "--cache", tiny.store).out


def test_what_nothing_matches_is_said(tiny):
    present = colours(tiny)
    absent = next(c for c in ("purple", "pink", "orange", "green", "blue", "yellow", "red") if c not in present)
    answer = ss_flow("query", tiny.out, absent, "--cache", tiny.store)
    assert answer.code == 0
    assert f"nothing in the scene matches '{absent}' (colour words); the nearest are:" in answer.out


def test_the_folder_of_an_answer_shows_what_matches_in_every_photo_and_in_space(tiny, tmp_path):
    import cv2
    import numpy as np

    out = tmp_path / "answer"
    answer = ss_flow("query", tiny.out, "not purple", "--out", out, "--json", "--cache", tiny.store)
    assert answer.code == 0, answer.err
    document = json.loads((out / "answer.json").read_text())
    written = document.pop("files")
    assert written["answer.ply"] == (out / "answer.ply").stat().st_size
    assert document == answer.document()
    matched = [row["id"] for row in document["instances"] if row["matched"]]
    scene, own = (read_gaussians(f) for f in (tiny.out / "scene_labeled.ply", out / "answer.ply"))
    assert matched and np.array_equal(own.means, scene.means[np.isin(scene.instance_id, matched)])
    photos = sorted((tiny.out / "masks").iterdir())
    assert [p.name for p in photos] == [p.name for p in sorted((out / "masks").iterdir())]
    for photo in photos:
        mask = cv2.imread(str(out / "masks" / photo.name), -1)
        assert mask.dtype == np.uint8
        assert np.array_equal(mask, 255 * np.isin(cv2.imread(str(photo), -1), matched))
    again = ss_flow("query", tiny.out, "purple", "--out", out, "--json", "--cache", tiny.store)
    assert again.code == 0 and json.loads((out / "answer.json").read_text())["text"] == "purple"


def test_a_run_without_parts_says_so(tiny):
    answer = ss_flow("query", tiny.out, "white", "--parts", "--cache", tiny.store)
    assert answer.code == 2 and "no photo shows a part of any instance" in answer.err


def test_a_result_that_is_gone_is_told_in_one_sentence_with_what_to_do(warm):
    described = json.loads((warm.out / "run.json").read_text())["results"]["describe"]
    shutil.rmtree(next((warm.store / "objects").rglob(described[0])) / "embedding")
    answer = ss_flow("query", warm.out, "white", "--cache", warm.store)
    assert answer.code == 1
    assert "was damaged" in answer.err and "run the scene again, which computes it anew" in answer.err


def test_an_answer_never_takes_the_place_of_anything_else(tiny, tmp_path):
    answer = ss_flow("query", tiny.out, "red", "--out", tiny.out, "--cache", tiny.store)
    assert answer.code == 2 and "holds something else" in answer.err
    assert (tiny.out / "run.json").is_file()


def test_the_best_few_take_the_place_of_those_near_the_best(tiny):
    answer = ss_flow("query", tiny.out, "not purple", "--top-k", "1", "--json", "--cache", tiny.store)
    assert sum(row["matched"] for row in answer.document()["instances"]) == 1
    for wrong in (("--top-k", "0"), ("--top-k", "2", "--tau-corr", "0.1")):
        refused = ss_flow("query", tiny.out, "red", *wrong, "--cache", tiny.store)
        assert refused.code == 2 and "--top-k takes a whole number" in refused.err
