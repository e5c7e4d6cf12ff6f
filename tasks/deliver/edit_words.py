"""What an edit did, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any


@dataclass(frozen=True)
class EditWords:
    """An edit as a report tells it."""

    source: str
    """The name of the run that was edited."""
    operations: Sequence[str]
    """One line each, in their order."""
    num_filled: int
    """Gaussians that fill holes."""

    @classmethod
    def of(cls, edit: Mapping[str, Any]) -> EditWords:
        """edit: that field of an edited run's run.json."""
        holes = {hole["operation"]: hole for hole in edit["holes"]}
        lines = [
            _line(operation) + (_hole(holes[number]) if number in holes else "")
            for number, operation in enumerate(edit["script"]["operations"], 1)
        ]
        return cls(PurePath(edit["source"]).name, lines, edit["num_filled"])


def _line(operation: Mapping[str, Any]) -> str:
    """One operation of a script, as `flows/edit_script.py` takes them; places without their folders."""
    op = operation["op"]
    which = _names(operation["instances"] if "instances" in operation else operation["instance"])
    named = f" as {operation['name']}" if "name" in operation else ""
    changes = _changes(operation)
    does = {
        "remove": lambda: f"Removed {which}",
        "keep": lambda: f"Kept nothing but {which}",
        "duplicate": lambda: f"Copied {which}{named}{changes}",
        "transform": lambda: f"Changed {which}{changes}",
        "recolour": lambda: f"Recoloured {which} to {_color(operation['color'])}",
        "replace": lambda: (
            f"Replaced {which} by {_names(operation['by'])} of {PurePath(operation['run']).name}{named}{changes}"
        ),
        "relabel": lambda: f"Relabelled {which}{named}{changes}",
        "merge": lambda: f"Merged {which}{named}",
        "split": lambda: f"Split {which} into its parts",
    }
    comment = f" ({operation['comment']})" if operation.get("comment") else ""
    return f"{does[op]()}{', filled the hole' if operation.get('fill') else ''}{comment}."


def _names(asked: Any) -> str:
    """Instances by their names; those that were asked for by id by that."""
    words = [
        "the background" if one in (0, "background") else f"instance {one}" if isinstance(one, int) else one
        for one in (asked if isinstance(asked, list) else [asked])
    ]
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]


def _changes(operation: Mapping[str, Any]) -> str:
    found = []
    if "move" in operation:
        found.append(f"moved by {_vector(operation['move'])}")
    if "rotate" in operation:
        turn = operation["rotate"]
        found.append(f"turned by {turn['degrees']:g}° about {_vector(turn['axis'])}")
    if operation.get("scale", "fit") != "fit":
        found.append(f"scaled by {operation['scale']:g}")
    if "kind" in operation:
        found.append(f"{operation['kind']} from now on")
    return "".join(f", {one}" for one in found)


def _vector(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"


def _color(value: Any) -> str:
    return value if isinstance(value, str) else "#" + bytes(value).hex()


def _hole(hole: Mapping[str, Any]) -> str:
    text = ""
    if hole["unmeasured"]:
        text = f" Behind {hole['unmeasured']:,} of the {hole['pixels']:,} pixels that showed it nothing was measured"
        text += f"; after filling, behind {hole['open_after_filling']:,}." if "open_after_filling" in hole else "."
    if cleared := hole.get("cleared"):
        text += f" {cleared:,} Gaussians that no view had shaped came to light, and went too."
    return text
