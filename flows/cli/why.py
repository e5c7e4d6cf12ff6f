"""Why a step ran in the latest run, or has another result than before though it was found: back to the first cause."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any

import tyro
from rich.markup import escape

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.explain import part_of, since_last
from ss_flow.flows.cli.context import InStore, PositionalPath, StoreOptions, console
from ss_flow.flows.cli.inspect import named, not_latest, runs_to_ask
from ss_flow.runs import DONE, PreviousKeys, Run, latest_runs
from ss_flow.sweep import scene_of
from ss_flow.tasks.capture.names import natural_key
from ss_flow.tasks.words import first_of

_ITEMS = 8
"""Items of a step that a message names."""
_REASONS = 5
"""Reasons that the terminal shows; --json has them all."""


@dataclass(frozen=True)
class Why:
    """Tell why a step ran in the latest run that got to it: what of its key had changed, back to the first cause."""

    step: Annotated[str, tyro.conf.Positional]
    """Name of a step, such as propagate or split.propagate; one item of it as segment[0003]."""
    scene: PositionalPath = None
    """The scene; the one that ran last, when left out."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        store = self.store.existing_store()
        runs = runs_to_ask(store, self.scene)
        for run in runs:
            nodes = _tried(run)
            if asked := named(run, nodes, self.step):
                break
        else:
            raise _unknown(self.step, runs[0])
        reason_of = Reasons(store, run)
        computed = [n for n in asked if "why" in n and n["event"] != "started"] or [n for n in asked if "why" in n]
        reasons: dict[str, list[dict[str, Any]]] = {}
        for node in computed or asked:
            moved = not computed and reason_of.only_moved(node)
            reasons.setdefault("" if moved else reason_of(node), []).append(node)
        reasons.pop("", None)
        rows = [
            {
                "step": these[0]["step"],
                "labels": [node["label"] for node in these],
                "why": reason,
                "because": _causes(these[0], nodes, reason_of),
            }
            for reason, these in list(reasons.items())[: None if self.json else _REASONS]
        ]
        if self.json:
            about = {"scene": run.scene, "started": run.header["started"], "reused": not computed}
            print(json.dumps(about | {"reasons": rows}, indent=1))
            return 0
        out = console(json=False)
        if other := not_latest(run, runs[0]):
            out.print(escape(other))
        if not rows:
            out.print(f"{asked[0]['step']}: reused; nothing that it depends on changed")
        for row in rows:
            labels = row["labels"]
            what = labels[0] if len(labels) == 1 else row["step"]
            found = "" if computed else "reused from an earlier run; since the last one, "
            count = f" ({len(labels)} of them)" if len(labels) > 1 else ""
            out.print(escape(f"{what}: {found}{row['why']}{count}"))
            for cause in row["because"]:
                out.print(escape(f"  because {cause['step']}: {cause['why']}"))
        return 0


def _unknown(name: str, run: Run) -> InputError:
    """What to say of a step, or an item of one, that no run has. run: the latest."""
    nodes, step = _tried(run), name.partition("[")[0]
    if step != name and (items := [n["item"] for n in named(run, nodes, step) if n["item"]]):
        known = first_of(sorted(dict.fromkeys(items), key=natural_key), _ITEMS)
        return InputError(f"the latest run of {run.scene} has no {name!r}; {step} has the items {known}.")
    known = ", ".join(sorted({n["step"] for n in nodes}))
    return InputError(f"the latest run of {run.scene} has no step {name!r}; it has {known}.")


def _tried(run: Run) -> list[dict[str, Any]]:
    """What was begun or found, failures too."""
    return [event for event in run.events() if event["event"] in ("hit", "finished", "failed", "started")]


class Reasons:
    """Why a node has another key than in the run before: as recorded where it was computed; where it was found, by
    comparing keys. "" where nothing changed, or there was no run before."""

    def __init__(self, store: Store, run: Run) -> None:
        self._store = store
        of_scene = latest_runs(store.runs, scene_of(run.header))
        self._known = PreviousKeys(one for one in of_scene if one.place < run.place)

    def __call__(self, node: dict[str, Any]) -> str:
        if "why" in node or node["event"] not in DONE:
            return str(node.get("why", ""))
        known = self._known(node["label"])
        if not known or node["key"] in known:
            return ""
        record = self._store.action(node["key"], whole=False)
        if record is None:
            return "what changed is not known: its record is no longer in the store"
        now = record.components
        return since_last(known, now, part_of(self._store, now["code"]), self._store)

    def only_moved(self, node: dict[str, Any]) -> bool:
        """Whether the run before had the same result as another item of the step: items without names of their own are
        called by number, which a photo more or less before them changes."""
        return bool(self._known(node["label"])) and self._known.have(node["key"])


def _causes(node: dict[str, Any], nodes: list[dict[str, Any]], reason_of: Reasons) -> list[dict[str, str]]:
    """From a changed input back, step by step, to the change that began it; of a step's nodes that of the same item."""
    found: list[dict[str, str]] = []
    seen = {node["step"]}
    while (why := reason_of(node)).startswith("input "):
        producer = node.get("inputs", {}).get(why.split()[1])
        made = [n for n in nodes if n["step"] == producer and n["event"] in DONE]
        made.sort(key=lambda n: n["item"] != node["item"])
        cause = next((n for n in made if reason_of(n)), None)
        if cause is None or producer in seen:
            break
        node = cause
        seen.add(node["step"])
        found.append({"step": node["step"], "why": reason_of(node)})
    return found
