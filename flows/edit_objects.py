"""The objects of a scene as an edit script knows them: instances.json, kept true while a script is gone through."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.results import open_finished, read_instances
from ss_flow.tasks.artifacts import Cameras, Gaussians
from ss_flow.tasks.deliver.instances_json import gaussians_placed, instance_file
from ss_flow.tasks.deliver.palette import instance_color
from ss_flow.tasks.edit.operations import Vector, vector
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.geometry.cameras import up_of
from ss_flow.tasks.geometry.clustering import rows_by_label

Entry = dict[str, Any]
Relabelling = tuple[int, int, int, int]
"""Instance and part, and what they become."""
NAMED_BY = "script"
"""In instances.json: whose name it is."""


@dataclass
class Objects:
    """The instances of a scene, by id."""

    entries: dict[int, Entry]
    """As in instances.json."""
    parts: dict[int, dict[int, int]]
    """Of each instance, the parts that have Gaussians, and their numbers of dense points."""
    dense: dict[int, set[int]]
    """Of each instance and of the background (0), the labels of the dense points that lie where it lies."""
    groups: list[Entry]
    next_id: int
    """Ids are never used twice."""
    up: Vector | None = None
    """The direction, of length 1, that is up in the photos; None where that is not known."""
    gone: set[int] = field(default_factory=set)
    """Labels of dense points that show what is no longer there."""
    changed: set[int] = field(default_factory=set)
    """Ids whose parts are to be looked up anew."""

    @classmethod
    def of(cls, document: Mapping[str, Any], scene: Gaussians, cameras: Cameras | None = None) -> Objects:
        """Those of an instances.json and its Gaussians; the background is not among them."""
        entries = {entry["id"]: entry for entry in document["instances"]}
        points = {i: {p["part_id"]: p["num_points"] for p in e["parts"]} for i, e in entries.items()}
        parts: dict[int, dict[int, int]] = {}
        for instance, part in np.unique(np.stack([scene.instance_id, scene.part_id]), axis=1).T.tolist():
            parts.setdefault(instance, {})[part] = points.get(instance, {}).get(part, 0)
        used = [0, *entries, *parts, *(group["id"] for group in document["groups"])]
        dense = {i: {i} for i in (0, *entries)}
        return cls(entries, parts, dense, list(document["groups"]), max(used) + 1, _up(cameras))

    def names(self) -> list[str]:
        return [entry["name"] for entry in self.entries.values()]

    def name(self, instance: int) -> str:
        return str(self.entries[instance]["name"])

    def kind(self, instance: int) -> str:
        return str(self.entries[instance]["kind"])

    def find(self, called: int | str) -> int | None:
        """The instance of this id or name, if it is there."""
        if isinstance(called, int):
            return called if called in self.entries else None
        return next((i for i, entry in self.entries.items() if entry["name"] == called), None)

    def unique(self, name: str) -> str:
        """This name, or with a number that makes it the only one."""
        return unused_name(name, self.names())

    def solid(self, instance: int) -> bool:
        """Whether it has Gaussians."""
        return bool(self.parts.get(instance))

    def remove(self, ids: Iterable[int]) -> None:
        for instance in ids:
            self._leaves(instance)
            self.entries.pop(instance, None)

    def keep(self, ids: Iterable[int]) -> None:
        """Remove all others."""
        self.remove({0, *self.entries} - set(ids))

    def move(self, ids: Iterable[int]) -> None:
        """The capture no longer shows these where they are."""
        for instance in ids:
            self._leaves(instance)
            self.entries[instance] = _unseen(self.entries[instance])
            self.parts[instance] = dict.fromkeys(self.parts[instance], 0)

    def copy(self, instance: int, name: str) -> int:
        """One more like this; returns its id."""
        return self._new(_unseen(self.entries[instance]), dict.fromkeys(self.parts[instance], 0), name)

    def put_in(self, entry: Entry, parts: Iterable[int], name: str) -> int:
        """An object of another run; returns its id."""
        return self._new(_unseen(entry), dict.fromkeys(parts, 0), name)

    def rename(self, instance: int, name: str, kind: str) -> None:
        """Give it a name, and say whether it is a thing or stuff."""
        entry = self.entries[instance]
        named_by = entry["named_by"] if name == entry["name"] else NAMED_BY
        self.entries[instance] = entry | {"name": name, "named_by": named_by, "kind": kind}

    def merge(self, ids: Sequence[int]) -> tuple[Relabelling, ...]:
        """Make several instances one, under the id of the first. Returns what becomes of their rows.

        The parts of each become parts of the whole, and what has none becomes one.
        """
        into, rows, parts = ids[0], [], dict[int, int]()
        for instance in ids:
            own = self.parts.get(instance, {})
            whole = set(own) <= {0}
            base = max(parts, default=0)
            for rank, part in enumerate(sorted(own), 0 if 0 in own and not whole else 1):
                new = base + rank if part or whole else 0
                points = self.entries[instance]["num_points"] if whole else own[part]
                parts[new] = parts.get(new, 0) + points
                rows.append((instance, part, into, new))
        entries = [self.entries[i] for i in ids]
        points = [entry["num_points"] for entry in entries]
        mean = sum(n * e["confidence"] for n, e in zip(points, entries, strict=True)) / max(1, sum(points))
        whole_entry = entries[0] | {
            **_placed_together(entries),
            "views": sorted({view for entry in entries for view in entry["views"]}),
            "confidence": round(mean, 4) if sum(points) else entries[0]["confidence"],
            "num_points": sum(points),
            "weak": all(entry["weak"] for entry in entries),
            "crumb": all(entry["crumb"] for entry in entries),
        }
        dense = set().union(*(self.dense[i] for i in ids))
        for instance in ids[1:]:
            del self.entries[instance]
        for instance in ids:
            self.parts.pop(instance, None)
        self.entries[into], self.parts[into], self.dense[into] = whole_entry, parts, dense
        self.changed.add(into)
        return tuple(rows)

    def split(self, instance: int) -> tuple[Relabelling, ...]:
        """Make every part an instance; what belongs to none keeps the id. Returns what becomes of their rows.

        Raises ValueError where that changes nothing.
        """
        own = self.parts[instance]
        named = [part for part in sorted(own) if part]
        if len(own) < 2 or not named:
            raise ValueError("it has no parts to split it by; instances.json says how many an instance has (num_parts)")
        entry, rows = self.entries[instance], []
        for part in named:
            piece = entry | {"num_points": own[part]} if own[part] else _unseen(entry)
            new_id = self._new(piece, {0: own[part]}, self.unique(f"{entry['name']} part {part}"))
            self.entries[new_id]["parent"] = piece["parent"]
            self.dense[new_id] = set(self.dense[instance]) if own[part] else set()
            rows.append((instance, part, new_id, 0))
        pieces = [new_id for _, _, new_id, _ in rows]
        self.groups = [
            group | {"instances": [*group["instances"], *pieces]} if instance in group["instances"] else group
            for group in self.groups
        ]
        if 0 in own:
            rest = max(0, entry["num_points"] - sum(own[part] for part in named))
            self.entries[instance], self.parts[instance] = entry | {"num_points": rest}, {0: rest}
            self.changed.add(instance)
        else:
            del self.entries[instance], self.parts[instance]
        return tuple(rows)

    def document(self, source: Mapping[str, Any], scene: Gaussians) -> dict[str, Any]:
        """instances.json of the edited scene; source: that of the scene before."""
        rows_of = rows_by_label(scene.instance_id)
        entries = [self._entry(i, scene, rows_of.get(i)) for i in sorted(self.entries)]
        groups = [g | {"instances": [i for i in g["instances"] if self._is_in(i, g["id"])]} for g in self.groups]
        return dict(source) | {
            "num_crumbs": sum(entry["crumb"] for entry in entries),
            "instances": entries,
            "groups": [group for group in groups if group["instances"]],
        }

    def _entry(self, instance: int, scene: Gaussians, rows: NDArray[np.intp] | None) -> Entry:
        entry = dict(self.entries[instance])
        if rows is None:
            return entry | {"num_gaussians": 0, "file": None}
        if instance in self.changed:
            part_of, known = scene.part_id[rows], self.parts[instance]
            entry["parts"] = [
                {
                    "part_id": part,
                    "num_points": known.get(part, 0),
                    **gaussians_placed(select(scene, rows[part_of == part])),
                }
                for part in np.unique(part_of[part_of > 0]).tolist()
            ]
            entry["num_parts"] = len(entry["parts"])
        file = None if entry["crumb"] else instance_file(instance)
        return entry | {**gaussians_placed(select(scene, rows)), "num_gaussians": len(rows), "file": file}

    def _is_in(self, instance: int, group: int) -> bool:
        """Whether an instance is still part of a group; what has moved is not."""
        above = {g["id"]: g["parent"] for g in self.groups}
        parent = self.entries[instance]["parent"] if instance in self.entries else None
        while parent is not None and parent != group:
            parent = above.get(parent)
        return parent is not None

    def _new(self, entry: Entry, parts: Mapping[int, int], name: str) -> int:
        new_id = self.next_id
        self.next_id += 1
        self.entries[new_id] = entry | {
            "id": new_id, "name": name, "named_by": NAMED_BY, "color": list(instance_color(new_id)), "parent": None,
        }  # fmt: skip
        self.parts[new_id], self.dense[new_id] = dict(parts), set()
        self.changed.add(new_id)
        return new_id

    def _leaves(self, instance: int) -> None:
        self.gone |= self.dense.pop(instance, set())
        self.dense[instance] = set()
        if instance in self.entries:
            self.changed.add(instance)


def unused_name(name: str, used: Collection[str]) -> str:
    """A name as it is, or with the first number from 2 on that makes it another than those that are used."""
    numbered = (f"{name} {number}" for number in itertools.count(2))
    return next(one for one in itertools.chain([name], numbered) if one not in used)


def _placed_together(entries: Sequence[Entry]) -> Entry:
    """The box and the mean of instances as one, for where none of them has Gaussians, which tell both anew."""
    known = [entry for entry in entries if entry["bbox"]]
    if not known:
        return {"bbox": None, "centroid": None}
    points = [max(1, entry["num_points"]) for entry in known]
    middle = np.average([entry["centroid"] for entry in known], axis=0, weights=points)
    corners = {
        "min": np.min([entry["bbox"]["min"] for entry in known], axis=0).tolist(),
        "max": np.max([entry["bbox"]["max"] for entry in known], axis=0).tolist(),
    }
    return {"bbox": corners, "centroid": np.round(middle, 6).tolist()}


def _unseen(entry: Entry) -> Entry:
    """What is known of an object that no photo shows where it is."""
    parts = [part | {"num_points": 0} for part in entry["parts"]]
    return entry | {"parts": parts, "views": [], "num_points": 0, "parent": None}


def _up(cameras: Cameras | None) -> Vector | None:
    return None if cameras is None else vector(up_of(cameras.world_to_camera))


def up_of_run(folder: Path, store: Store | None) -> Vector | None:
    """The direction that is up in the photos of a run; None where its results are neither in the store that it names
    nor in this one, as in a folder that was handed on."""
    for place in (None, store) if store else (None,):
        with contextlib.suppress(InputError):
            run = open_finished(folder, place)
            run.require(("cameras",))
            return _up(run.results.one("cameras"))
    return None


def object_of_run(folder: Path, called: int | str) -> tuple[Entry, list[int], Path]:
    """An object of the output folder of a run: its entry, its parts that have Gaussians, its PLY file.

    Raises ValueError when there is no such object, InputError when the folder is not one of a run.
    """
    from ss_flow.tasks.gaussians.read_ply import read_columns

    if not (folder / "instances.json").is_file():
        raise InputError(f"{folder} is not the output folder of a run: it has no instances.json.")
    entries = read_instances(folder)["instances"]
    entry = next((e for e in entries if called in (e["id"], e["name"])), None)
    if entry is None:
        raise ValueError(f"{folder / 'instances.json'} has no object of this id or name")
    if entry["file"] is None or not (folder / entry["file"]).is_file():
        raise ValueError(f"{folder} has no PLY file of it; name an object that has a file in instances.json")
    rows = read_columns(folder / entry["file"])
    parts = np.unique(rows["part_id"]).astype(int).tolist() if "part_id" in (rows.dtype.names or ()) else [0]
    return entry, parts, folder / entry["file"]
