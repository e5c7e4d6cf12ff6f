"""A run as an OpenTelemetry trace: one span for the run, one for every computed step (OTLP 1.x, JSON encoding)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from blake3 import blake3

from ss_flow.runs import Run, settled

OK, ERROR = 1, 2
INTERNAL = 1


def trace(run: Run) -> dict[str, Any]:
    """The trace of a run: a `TracesData` message, as collectors read it from a file.

    Steps that were reused have no span; the run's span says how many they were. A run that was killed ends with its
    last event.
    """
    events = list(run.events())
    begun = {event.get("key"): event["time"] for event in events if event["event"] == "started"}
    nodes = settled(events)
    computed = [node for node in nodes if node["event"] in ("finished", "failed")]
    failed = sum(node["event"] == "failed" for node in computed)
    trace_id = blake3(run.folder.name.encode()).hexdigest(length=16)
    root_id = _span_id(trace_id, "")
    whole = {
        "traceId": trace_id,
        "spanId": root_id,
        "name": f"run {run.scene}",
        "kind": INTERNAL,
        "startTimeUnixNano": _nanoseconds(run.header["started"]),
        "endTimeUnixNano": _nanoseconds(events[-1]["time"] if events else run.header["started"]),
        "attributes": _attributes(
            {
                "ss_flow.scene": run.scene,
                "ss_flow.reused": sum(node["event"] == "hit" for node in nodes),
                "ss_flow.computed": len(computed) - failed,
                "ss_flow.failed": failed,
            }
        ),
        "status": {"code": ERROR if failed else OK},
    }
    spans = [whole, *(_span(node, trace_id, root_id, begun) for node in computed)]
    return {
        "resourceSpans": [
            {
                "resource": {"attributes": _attributes({"service.name": "ss-flow"})},
                "scopeSpans": [{"scope": {"name": "ss_flow"}, "spans": spans}],
            }
        ]
    }


def _span(node: Mapping[str, Any], trace_id: str, parent: str, begun: Mapping[str | None, float]) -> dict[str, Any]:
    failed = node["event"] == "failed"
    known = {
        "ss_flow.step": node["step"],
        "ss_flow.item": node["item"],
        "ss_flow.key": node["key"],
        "ss_flow.why": node.get("why"),
        "ss_flow.seconds": node.get("seconds"),
        "ss_flow.peak_rss_mb": node.get("peak_rss_mb"),
    }
    return {
        "traceId": trace_id,
        "spanId": _span_id(trace_id, f"{node['label']} {node['key']}"),
        "parentSpanId": parent,
        "name": node["label"],
        "kind": INTERNAL,
        "startTimeUnixNano": _nanoseconds(begun.get(node["key"], node["time"])),
        "endTimeUnixNano": _nanoseconds(node["time"]),
        "attributes": _attributes({name: value for name, value in known.items() if value is not None}),
        "status": {"code": ERROR, "message": node["error"]} if failed else {"code": OK},
    }


def _span_id(trace_id: str, name: str) -> str:
    return blake3(f"{trace_id} {name}".encode()).hexdigest(length=8)


def _nanoseconds(seconds: float) -> str:
    return str(round(seconds * 1e9))


def _attributes(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    kinds = {str: "stringValue", int: "intValue", float: "doubleValue"}
    # 64-bit integers travel as text in protobuf's JSON.
    return [
        {"key": name, "value": {kinds[type(value)]: str(value) if isinstance(value, int) else value}}
        for name, value in values.items()
    ]
