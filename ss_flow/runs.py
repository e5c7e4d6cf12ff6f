"""Runs: what a flow was run on, and what happened, kept in the store so that a later run can say what changed.

A run is a folder `roots/runs/<id>` with `run.json` (what was asked) and `events.jsonl` (what happened, line by line, so
that a killed run is known up to its last step).
"""

from __future__ import annotations

import contextlib
import json
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ss_flow.cache.files import write_atomically
from ss_flow.cache.plain_json import read_json

if TYPE_CHECKING:
    import networkx as nx

DONE = ("hit", "finished")
NAME_BYTES = 100
"""How much of a scene's name the name of a run's folder takes: file systems allow 255 bytes in all."""
ENDS = (*DONE, "failed", "skipped", "would run")
"""Kinds of events that say what a node came to."""
NEEDED: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("started", *ENDS), ("label", "step", "item")),
    **dict.fromkeys(DONE, ("label", "step", "item", "key", "outputs", "inputs", "seconds")),
    "failed": ("label", "step", "item", "key", "error"),
    "taken": ("outputs",),
}
"""What an event of a kind always has."""
ABSENT = (FileNotFoundError, IsADirectoryError)
"""What reading a file raises that is not there, or is none."""


@dataclass(frozen=True)
class Run:
    """One run in the store."""

    folder: Path
    header: dict[str, Any]
    """What was asked: at least "scene" and "started"; "until", the output at which to stop, or None."""

    @property
    def scene(self) -> str:
        return str(self.header["scene"])

    @property
    def place(self) -> tuple[int, float]:
        """In the order of all runs, later ones greater. Clocks are wrong at times, and differ, so a number comes first;
        a run of an older version has none."""
        return int(self.header.get("number", 0)), float(self.header["started"])

    def events(self) -> Iterator[dict[str, Any]]:
        """What happened, in order; a line that is cut (the last one of a killed run) or damaged is left out."""
        try:
            with (self.folder / "events.jsonl").open("rb") as stream:
                for line in stream:
                    with contextlib.suppress(ValueError):
                        if _is_whole(event := read_json(line)):
                            yield event
        except ABSENT:
            return

    def results(self) -> dict[str, list[str]]:
        """The digests of the flow's outputs by name; none for a run that has not ended."""
        ended = [event for event in self.events() if event["event"] == "run ended"]
        return dict(ended[-1].get("results", {})) if ended else {}

    def is_whole(self) -> bool:
        """Whether it came to results, and was asked for all of them."""
        return self.header.get("until") is None and bool(self.results())

    def nodes(self) -> list[dict[str, Any]]:
        """The events of the nodes that have a result."""
        return [event for event in settled(self.events()) if event["event"] in DONE]

    def taken(self) -> set[str]:
        """The digests of the results of other runs that it uses."""
        return {digest for event in self.events() if event["event"] == "taken" for digest in event["outputs"]}

    def graph(self) -> nx.MultiDiGraph[str]:
        """The steps that have results: `count` of each, and an edge for each input, by its name, from what makes it.

        Merging goes round by round, so steps can feed each other though their nodes form a DAG.
        """
        import networkx as nx

        graph: nx.MultiDiGraph[str] = nx.MultiDiGraph()
        nodes = self.nodes()
        for node in nodes:
            graph.add_node(node["step"], count=graph.nodes.get(node["step"], {}).get("count", 0) + 1)
        for node in nodes:
            for name, producer in node["inputs"].items():
                if producer in graph and producer != node["step"]:
                    graph.add_edge(producer, node["step"], key=name)
        return graph


def _is_whole(event: Any) -> bool:
    """Whether a line of a log is an event with all that its readers ask for."""
    kind = event.get("event") if isinstance(event, dict) else None
    return isinstance(kind, str) and {"time", *NEEDED.get(kind, ())} <= event.keys()


def settled(events: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """What each node came to, in order: its last event, unless that only found again what the same run computed.

    A run that found a damaged result starts anew, and then finds again what it had computed before.
    """
    last: dict[tuple[str, str], dict[str, Any]] = {}
    for event in events:
        if event["event"] in ENDS:
            node = (event["label"], event.get("key", ""))
            if node not in last:
                last[node] = event
            elif last[node]["event"] != "finished" or event["event"] == "finished":
                del last[node]
                last[node] = event
    return list(last.values())


def start_run(runs: Path, header: dict[str, Any]) -> Run:
    """Open a run: its folder, with what was asked. header: with its "number", one more than the latest run's."""
    name = "".join(c if c.isalnum() else "-" for c in Path(header["scene"]).name)
    name = name.encode()[:NAME_BYTES].decode(errors="ignore")  # never in the middle of a character
    folder = runs / f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{name}-{uuid.uuid4().hex[:6]}"
    folder.mkdir(parents=True)
    header = header | {"started": time.time()}
    write_atomically(folder / "run.json", json.dumps(header, indent=1), synced=False)  # a sweep has thousands
    return Run(folder, header)


def latest_runs(runs: Path, scene: str | None = None) -> Iterator[Run]:
    """Runs, the latest first; of one scene (a resolved path), or of all. A record that says no scene is passed over."""
    found = []
    for file in runs.glob("*/run.json"):
        try:
            run = Run(file.parent, read_json(file.read_text()))
            if scene in (None, run.header["scene"]):
                found.append((run.place, run))
        except (*ABSENT, ValueError, KeyError, TypeError, OverflowError):  # collected just now, or damaged
            continue
    yield from (run for _, run in sorted(found, key=lambda one: one[0], reverse=True))


class PreviousKeys:
    """The keys under which the latest of the runs so far of a scene found the results of each label, in their order.

    Several calls may share a label. A label that the latest run never reached counts with the run before, so that `why`
    survives runs that stopped early. A run is read when its turn comes: most runs find everything.
    """

    def __init__(self, runs: Iterable[Run]) -> None:
        """runs: of the scene, the latest first."""
        self._unread = iter(runs)
        self._keys: dict[str, list[str]] = {}

    def __call__(self, label: str) -> Sequence[str]:
        while label not in self._keys and (run := next(self._unread, None)) is not None:
            found: dict[str, list[str]] = {}
            for event in run.nodes():
                found.setdefault(event["label"], []).append(event["key"])
            self._keys = found | self._keys
        return self._keys.get(label, ())

    def have(self, key: str) -> bool:
        """Whether a key is among those of any label, in the runs that were read so far."""
        return any(key in keys for keys in self._keys.values())
