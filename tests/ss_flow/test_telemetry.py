from __future__ import annotations

import json

import ss_flow_toy as toy

from ss_flow.engine import run_flow
from ss_flow.graph import each, gather
from ss_flow.runs import latest_runs
from ss_flow.telemetry import trace


def halves(values):
    return {"all": each(toy.source(values=values), build=toy.half, on_error="skip")}


def spans_of(store):
    document = json.loads(json.dumps(trace(next(latest_runs(store.root / "roots" / "runs")))))
    [scope] = document["resourceSpans"][0]["scopeSpans"]
    return scope["spans"]


def attributes(span):
    return {a["key"]: next(iter(a["value"].values())) for a in span["attributes"]}


def test_a_run_is_one_trace_with_a_span_for_every_computed_step(store):
    run_flow(lambda: halves((2.0, -1.0)), store, scene="toy")
    whole, *rest = spans_of(store)
    assert {span["name"] for span in rest} == {"ss_flow_toy.source", "ss_flow_toy.half[0]", "ss_flow_toy.half[1]"}
    assert {span["parentSpanId"] for span in rest} == {whole["spanId"]}
    assert {span["traceId"] for span in rest} == {whole["traceId"]}
    assert len({span["spanId"] for span in [whole, *rest]}) == 4
    assert (len(whole["traceId"]), len(whole["spanId"])) == (32, 16)
    for span in rest:
        begin, end = int(span["startTimeUnixNano"]), int(span["endTimeUnixNano"])
        assert int(whole["startTimeUnixNano"]) - 10**9 <= begin <= end <= int(whole["endTimeUnixNano"])
    failed = next(span for span in rest if span["name"].endswith("half[1]"))
    assert failed["status"] == {"code": 2, "message": "ValueError: negative"}
    assert attributes(whole)["ss_flow.computed"] == "2"
    assert attributes(rest[0])["ss_flow.why"] == "computed for the first time for this scene"


def test_of_calls_that_share_a_label_each_span_begins_when_its_own_call_did(store):
    def build():
        values = toy.source(values=(1.0, 2.0))
        first = toy.square(values[0])
        return {"all": gather([first, toy.shifted_total(toy.Pair(values[1], [values[0]]), first, by=1.0)])}

    run_flow(build, store, scene="toy")
    run = next(latest_runs(store.runs))
    events = [{**event, "label": "one"} if "label" in event else event for event in run.events()]
    for place, event in enumerate(events):
        event["time"] = 1000.0 + place
    (run.folder / "events.jsonl").write_text("".join(f"{json.dumps(event)}\n" for event in events))
    took = [int(span["endTimeUnixNano"]) - int(span["startTimeUnixNano"]) for span in spans_of(store)[1:]]
    assert took == [10**9] * 3


def test_what_was_reused_is_counted_and_has_no_span(store):
    run_flow(lambda: halves((2.0, 1.0)), store, scene="toy")
    run_flow(lambda: halves((2.0, 1.0)), store, scene="toy")
    [whole] = spans_of(store)
    assert attributes(whole)["ss_flow.reused"] == "3"
    assert whole["status"] == {"code": 1}
