"""Looking at a run: status, why, graph, the store's content, pictures of results."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil

import cv2
import numpy as np
import pytest
import ss_flow_toy as toy
from tiny_runs import run_tiny, ss_flow

from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.graph import each, labelled
from ss_flow.runs import latest_runs
from ss_flow.tasks import artifacts


def test_status_counts_what_each_step_did(tiny):
    words = ss_flow("status", "--cache", tiny.store)
    assert words.code == 0
    assert words.out.startswith(f"{tiny.scene}: done, started ")
    document = json.loads(ss_flow("status", tiny.scene, "--json", "--cache", tiny.store).out)
    assert document["scene"] == str(tiny.scene) and document["state"] == "done"
    visible = document["steps"]["split.visibility"]
    assert (visible["finished"], visible["hit"], visible["running"], visible["failed"]) == (5, 0, 0, 0)
    nodes = len(tiny.called.document()["nodes"])
    assert document["done"] == document["expected"] == nodes
    assert f", {nodes} of {nodes} results are there\n" in words.out
    assert all(row["expected"] == row["finished"] + row["hit"] for row in document["steps"].values())


def test_what_was_tried_again_runs_no_more_when_it_has_ended(store, tmp_path):
    def flow():
        return {"end": toy.killed_once(toy.source(values=(1.0,))[0], marker=str(tmp_path / "marker"))}

    run_flow(flow, store, scene="toy")
    row = json.loads(ss_flow("status", "--json", "--cache", store.root).out)["steps"]["ss_flow_toy.killed_once"]
    assert (row["finished"], row["running"]) == (1, 0)


def test_status_of_a_run_that_ended_lacks_nothing_though_more_was_expected_at_times(warm):
    run = next(latest_runs(warm.store / "roots/runs"))
    lines = [json.loads(line) for line in (run.folder / "events.jsonl").read_text().splitlines()]
    middle = next(event for event in lines if event.get("label") == "split.propagate")
    middle["known"] = 1000
    (run.folder / "events.jsonl").write_text("\n".join(map(json.dumps, lines)))
    document = json.loads(ss_flow("status", "--json", "--cache", warm.store).out)
    assert document["state"] == "done" and document["done"] == document["expected"] < 1000


def test_status_of_a_run_that_was_cut_short_says_how_much_there_is_to_do(warm):
    """Cut the record in the middle of the views, as a kill would."""
    run = next(latest_runs(warm.store / "roots/runs"))
    lines = (run.folder / "events.jsonl").read_text().splitlines()
    # Views end in any order.
    last = max(i for i, line in enumerate(lines) if json.loads(line).get("label", "").startswith("split.visibility["))
    (run.folder / "events.jsonl").write_text("\n".join(lines[:last]))
    document = json.loads(ss_flow("status", "--json", "--cache", warm.store).out)
    visible = document["steps"]["split.visibility"]
    assert visible["finished"] < visible["expected"] == 5 and document["done"] < document["expected"]
    words = ss_flow("status", "--cache", warm.store).out
    assert f", {document['done']} of {document['expected']} or more results are there\n" in words


def test_why_says_that_nothing_was_known_on_the_first_run(tiny):
    assert (
        ss_flow("why", "propagate", "--cache", tiny.store).out
        == "split.propagate: computed for the first time for this scene\n"
    )
    told = ss_flow("why", "split.visibility", "--cache", tiny.store).out
    assert told == "split.visibility: computed for the first time for this scene (5 of them)\n"
    one = ss_flow("why", "visibility[0002]", "--cache", tiny.store).out
    assert one == "split.visibility[0002]: computed for the first time for this scene\n"
    document = ss_flow("why", "visibility", "--json", "--cache", tiny.store).document()
    (reason,) = document["reasons"]
    assert (document["scene"], document["reused"]) == (str(tiny.scene), False)
    assert sorted(reason.pop("labels")) == [f"split.visibility[000{view}]" for view in range(5)]
    assert reason == {"step": "split.visibility", "why": "computed for the first time for this scene", "because": []}


def test_the_run_that_made_an_output_is_asked_about_by_its_folder(warm):
    started = json.loads(ss_flow("status", warm.out, "--json", "--cache", warm.store).out)["started"]
    other = warm.out.with_name("other")
    assert run_tiny(warm.scene, warm.store, "--set", "masks.share=0", out=other).code == 0
    latest = ss_flow("status", warm.scene, "--json", "--cache", warm.store).out
    assert ss_flow("status", other, "--json", "--cache", warm.store).out == latest
    assert json.loads(ss_flow("status", warm.out, "--json", "--cache", warm.store).out)["started"] == started
    told = ss_flow("why", "render_masks", other, "--cache", warm.store).out
    assert "parameter share" in told
    assert "for the first time" in ss_flow("why", "render_masks", warm.out, "--cache", warm.store).out
    for run in latest_runs(warm.store / "roots/runs"):
        if run.header["started"] == started:
            shutil.rmtree(run.folder)
    refused = ss_flow("graph", warm.out, "--cache", warm.store)
    assert refused.code == 2 and f"no record of the run that made {warm.out}; {warm.scene} is its" in refused.err


def test_why_names_the_items_of_a_step_that_has_no_such_one(tiny):
    refused = ss_flow("why", "reconstruct[7]", "--cache", tiny.store)
    assert refused.code == 2
    assert "has no 'reconstruct[7]'; reconstruct has the items 0, 1, 2, 3, 4, 5." in refused.err


def test_why_looks_further_back_where_the_latest_run_is_of_something_else(warm):
    """An edit has other steps than the run that it changed."""
    run = next(latest_runs(warm.store / "roots/runs"))
    later = run.folder.with_name("edit")
    later.mkdir()
    header = run.header | {"scene": "/edited", "started": run.header["started"] + 60}
    (later / "run.json").write_text(json.dumps(header))
    event = {"event": "finished", "label": "edit.begin", "step": "edit.begin", "key": "k", "outputs": [], "inputs": {}}
    event |= {"time": 0.0, "item": "", "why": "for a reason", "seconds": 0}
    (later / "events.jsonl").write_text(json.dumps(event))
    assert ss_flow("why", "edit.begin", "--cache", warm.store).out == "edit.begin: for a reason\n"
    told = ss_flow("why", "propagate", "--cache", warm.store).out.splitlines()
    assert told[0].startswith(f"the latest run has no such step; in that of {warm.scene}, started ")
    assert told[1].startswith("split.propagate: ")
    assert ss_flow("why", "propagate", "/edited", "--cache", warm.store).code == 2
    assert ss_flow("cache", "show", "propagate", "--cache", warm.store).code == 0


def test_why_goes_back_by_the_nodes_of_the_same_item(tmp_path):
    def flow(limits, values):
        results = {}
        for item, limit, value in zip("ab", limits, values, strict=True):
            with labelled(item):
                results[item] = toy.square(toy.clip(toy.source(values=(value,))[0], limit=limit))
        return results

    store = Store(tmp_path / "store")
    run_flow(lambda: flow((2.0, 9.0), (5.0, 1.0)), store, scene="/toy", jobs=1)
    run_flow(lambda: flow((3.0, 9.0), (5.0, 4.0)), store, scene="/toy", jobs=1)
    told = {item: ss_flow("why", f"square[{item}]", "--cache", store.root).out.splitlines() for item in "ab"}
    assert told["a"][1:] == ["  because ss_flow_toy.clip: parameter limit 2.0 -> 3.0"]
    assert told["b"][1:] == [
        "  because ss_flow_toy.clip: input x changed",
        "  because ss_flow_toy.source: parameter values [1.0] -> [4.0]",
    ]


def test_why_says_what_changed_of_results_that_an_earlier_run_had(tmp_path):
    store = Store(tmp_path / "store")

    def run(limit, last=toy.half):
        run_flow(
            lambda: {"end": last(toy.square(toy.clip(toy.source(values=(5.0,))[0], limit=limit)))}, store, scene="/t"
        )

    def told(step):
        return ss_flow("why", step, "--cache", store.root).out.splitlines()

    def document(step):
        return ss_flow("why", step, "--json", "--cache", store.root).document()

    because = ["  because ss_flow_toy.clip: parameter limit 3.0 -> 2.0"]
    run(2.0, last=toy.uncertain)
    run(3.0)
    run(2.0)
    assert told("square") == [
        "ss_flow_toy.square: reused from an earlier run; since the last one, input x changed",
        *because,
    ]
    found = document("square")
    cause = {"step": "ss_flow_toy.clip", "why": "parameter limit 3.0 -> 2.0"}
    row = {"step": "ss_flow_toy.square", "labels": ["ss_flow_toy.square"], "why": "input x changed", "because": [cause]}
    assert found["reused"] and found["reasons"] == [row]
    changed = ["  because ss_flow_toy.square: input x changed", *because]
    assert told("half") == ["ss_flow_toy.half: input x changed", *changed]
    run(2.0)
    assert told("square") == ["ss_flow_toy.square: reused; nothing that it depends on changed"]
    assert document("square")["reused"] and document("square")["reasons"] == []


def test_why_says_that_nothing_changed_of_items_that_only_have_another_number(tmp_path):
    store = Store(tmp_path / "store")

    def run(*values):
        run_flow(lambda: {"all": toy.total(each(toy.source(values=values), build=toy.square))}, store, scene="/t")

    run(1.0, 2.0, 3.0)
    run(1.0, 3.0)
    assert ss_flow("why", "square", "--cache", store.root).out == (
        "ss_flow_toy.square: reused; nothing that it depends on changed\n"
    )
    assert ss_flow("why", "total", "--cache", store.root).out.splitlines() == [
        "ss_flow_toy.total: input xs changed (3 -> 2 items)",
        "  because ss_flow_toy.square: input x changed",
        "  because ss_flow_toy.source: parameter values [1.0, 2.0, 3.0] -> [1.0, 3.0]",
    ]


def test_the_graph_is_mermaid_with_a_box_a_step_and_what_feeds_it(tiny):
    lines = ss_flow("graph", "--cache", tiny.store).out.splitlines()
    assert lines[0] == "flowchart TD"
    boxes = dict(match.groups() for line in lines if (match := re.fullmatch(r'  ([\w.]+)\["(.+)"\]', line)))
    arrows = {match.groups() for line in lines if (match := re.fullmatch(r"  ([\w.]+) -->\|([\w.]+)\| ([\w.]+)", line))}
    assert len(boxes) + len(arrows) + 1 == len(lines)
    assert boxes["split.visibility"] == "split.visibility x 5"
    assert {a for a, _, _ in arrows} | {b for _, _, b in arrows} <= set(boxes)
    assert ("capture.ready_masks", "masks", "split.observe") in arrows
    assert {("split.propagate", "labels", "split.cut"), ("split.cut", "labels", "split.reproject")} <= arrows


def test_cache_ls_has_a_line_a_result_and_says_how_large_each_is(tiny):
    rows = json.loads(ss_flow("cache", "ls", "--json", "--cache", tiny.store).out)
    by_label = {row["label"]: row for row in rows}
    assert len(by_label) == len(rows), "two nodes of one label: `why` would compare one with the other"
    assert len(by_label["capture.ingest"]["outputs"]) == 5
    assert by_label["split.visibility[0003]"]["bytes"] > 1000
    words = ss_flow("cache", "ls", "--cache", tiny.store).out
    assert "split.visibility[0003]" in words
    assert by_label["split.propagate"]["outputs"][0][:12] in words


def test_cache_show_describes_a_result_by_step_or_by_digest(tiny):
    shown = ss_flow("cache", "show", "propagate", "--cache", tiny.store).out
    assert shown.startswith("PointLabels\n  label: int32 [")
    assert "num_labels: 5" in shown
    digest = tiny.called.results()["propagate"]
    assert ss_flow("cache", "show", digest[:10], "--cache", tiny.store).out == shown


@pytest.mark.parametrize("name", ["masks", "masks_refined", "scene", "merge", "depth", "cameras"])
def test_a_result_is_found_by_the_name_that_until_takes(tiny, name):
    wanted = tiny.called.results()[name]
    shown = ss_flow("cache", "show", name, "--cache", tiny.store)
    assert shown.code == 0, shown.err
    kind = type(Store(tiny.store).get(wanted if isinstance(wanted, str) else wanted[0])).__name__
    assert shown.out.startswith(kind)
    assert ss_flow("why", name, "--cache", tiny.store).code == 0


def test_results_of_a_finished_run_are_found_after_one_that_stopped_before_them(warm):
    before = ss_flow("cache", "show", "scene", "--cache", warm.store)
    run_tiny(warm.scene, warm.store, "--until", "dense", out=warm.out)
    lines = ss_flow("cache", "show", "scene", "--cache", warm.store).out.splitlines(keepends=True)
    assert lines[0].startswith(f"the latest run has no such step; in that of {warm.scene}, started ")
    assert "".join(lines[1:]) == before.out
    page = warm.out.parent / "page.html"
    viewed = ss_flow("view", "scene", "--html", page, "--cache", warm.store)
    assert viewed.out.splitlines(keepends=True) == [lines[0], f"{page}\n"]
    assert ss_flow("cache", "pin", "scene", "--cache", warm.store).code == 0
    picture = warm.out.parent / "scene.png"
    assert ss_flow("cache", "show", "scene", "--view", "1", "--png", picture, "--cache", warm.store).code == 0
    assert cv2.imread(str(picture)).shape == (72, 96, 3)


def test_cache_show_describes_the_items_of_a_list(tiny):
    shown = ss_flow("cache", "show", "ingest", "--cache", tiny.store).out
    assert shown.count("Frame\n") == 5
    assert all(f"name: {k:04d}" in shown for k in range(5))
    shown = ss_flow("cache", "show", "retrain", "--cache", tiny.store).out
    assert re.findall(r"made by splat.retrain\[(\d)\]", shown) == [*"012345"]


def test_what_gave_what_it_was_given_is_told_of_as_itself(tiny):
    results = tiny.called.results()
    assert results["cut"] == results["propagate"]
    assert "made by split.cut (" in ss_flow("cache", "show", "cut", "--cache", tiny.store).out
    assert "made by split.propagate (" in ss_flow("cache", "show", "propagate", "--cache", tiny.store).out


@pytest.mark.parametrize(
    "what",
    [
        "ingest",
        "cameras",
        "sensor_depth",
        "registration",
        "ready_masks",
        "dense",
        "visibility[0001]",
        "propagate",
        "tally[0001]",
        "hierarchy",
        "cut",
        "parts",
        "reproject",
        "reconstruct[1]",
        "global_pass",
        "describe[1]",
        "ground_truth",
        "evaluate_masks",
        "plan",
        "name",
    ],
)
def test_cache_show_draws_every_kind_of_result(what, tiny, tmp_path):
    picture = tmp_path / "pictures/it.png"
    shown = ss_flow("cache", "show", what, "--png", picture, "--view", "1", "--cache", tiny.store)
    assert shown.code == 0, shown.err
    image = cv2.imread(str(picture))
    assert min(image.shape[:2]) >= 50
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 1


def test_a_result_whose_type_has_a_new_field_is_told_as_one_of_another_version(tiny, monkeypatch):
    newer = dataclasses.make_dataclass("PointLabels", ["weight"], bases=(artifacts.PointLabels,), frozen=True)
    newer.__module__ = artifacts.__name__
    with monkeypatch.context() as patch:
        patch.setattr(artifacts, "PointLabels", newer)
        told = ss_flow("cache", "show", "propagate", "--cache", tiny.store)
        assert told.code == 1 and told.err.count("\n") == 1 and "damaged" not in told.err
        assert "PointLabels has the new field weight (a result of split." in told.err
        assert "run the scene again" in told.err
    assert ss_flow("cache", "show", "propagate", "--cache", tiny.store).out.startswith("PointLabels"), (
        "it is still there"
    )
