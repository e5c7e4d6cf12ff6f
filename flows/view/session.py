"""What a viewer holds of a scene that is being changed: operations done and undone, and what is selected and shown."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.cache.files import write_atomically
from ss_flow.cache.plain_json import read_json
from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.edit_objects import Objects
from ss_flow.flows.edit_script import Step, check
from ss_flow.flows.results import BACKGROUND
from ss_flow.tasks.artifacts import Cameras, EditedScene, Float64, Gaussians
from ss_flow.tasks.edit.operations import edited
from ss_flow.tasks.gaussians.initialise import concatenate, select
from ss_flow.tasks.geometry.clustering import rows_by_label

Operation = Mapping[str, Any]
"""As in an edit script."""


@dataclass(frozen=True, eq=False)
class Piece:
    """The Gaussians of one instance."""

    rows: NDArray[np.int64]
    """[N] ascending: where they stand in the whole scene among the Gaussians of all pieces."""
    gaussians: EditedScene

    @property
    def center(self) -> Float64:
        """[3] the mean of the centres: what it is turned about."""
        return self.gaussians.means.mean(axis=0, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class State:
    """The scene after some operations."""

    done: tuple[Operation, ...]
    objects: Objects
    pieces: Mapping[int, Piece]
    """By instance id, 0 = the background. What an operation does not name is the same object before and after it."""
    next_row: int


class Session:
    """A scene, the operations on it, and what of it is selected and shown.

    An operation is checked and done as `ss-flow edit` does it, on the instances that it names alone: those are all
    that it depends on. Not so `fill`, which looks at all photos: it stays in the script, and is not shown.
    """

    def __init__(
        self,
        scene: Gaussians,
        instances: Mapping[str, Any],
        folder: Path,
        operations: Sequence[Operation] = (),
        cameras: Cameras | None = None,
        store: Store | None = None,
    ) -> None:
        """instances: the document instances.json. folder: what relative paths in operations start from. operations:
        those of a script to go on with. cameras: they tell what is upright, for objects of other runs, whose results
        may be in this store.

        Raises InputError when an operation is refused.
        """
        whole = edited(scene, filled=0)
        pieces = {
            instance: Piece(rows.astype(np.int64), select(whole, rows))
            for instance, rows in rows_by_label(scene.instance_id).items()
        }
        self._begun = Objects.of(instances, scene, cameras)
        self._folder, self._store = folder, store
        self._states = [State((), self._begun, pieces, len(scene))]
        self._place = 0
        self.selected: tuple[int, ...] = ()
        self.hidden: frozenset[int] = frozenset()
        for operation in operations:
            self.do(operation)

    @property
    def state(self) -> State:
        """The scene as it is now."""
        return self._states[self._place]

    def do(self, *operations: Operation) -> None:
        """Do operations, which are undone as one. Raises InputError when one is refused; then none is done."""
        state = self.state
        for operation in operations:
            state = self._after(state, operation)
        self._states[self._place + 1 :] = [state]
        self._place += 1
        self._forget_what_is_gone()

    def undo(self) -> None:
        """Take back what was done last, if anything was."""
        self._place = max(0, self._place - 1)
        self._forget_what_is_gone()

    def redo(self) -> None:
        """Do again what was undone last, if anything was."""
        self._place = min(len(self._states) - 1, self._place + 1)
        self._forget_what_is_gone()

    def script(self) -> dict[str, Any]:
        """The edit script of what is done."""
        return {"version": 1, "operations": list(self.state.done)}

    def scene(self) -> EditedScene:
        """All Gaussians, in the order in which `ss-flow edit` writes them."""
        pieces = list(self.state.pieces.values())
        return select(concatenate([p.gaussians for p in pieces]), np.argsort(np.concatenate([p.rows for p in pieces])))

    def select(self, instance: int | None, *, more: bool = False) -> None:
        """Select an instance, or nothing. more: besides those that are; one that is selected already is let go."""
        known = instance is not None and (instance in self.state.objects.entries or instance in self.state.pieces)
        chosen: tuple[int, ...] = (instance,) if known and instance is not None else ()
        if more:
            kept = tuple(i for i in self.selected if i not in chosen)
            chosen = kept + tuple(i for i in chosen if i not in self.selected)
        self.selected = chosen

    def hide(self, instances: Iterable[int]) -> None:
        """Show these no more."""
        self.hidden |= set(instances)

    def isolate(self, instances: Iterable[int]) -> None:
        """Show nothing but these."""
        self.hidden = frozenset(self.state.pieces.keys() - set(instances))

    def show(self) -> None:
        """Show everything again."""
        self.hidden = frozenset()

    def visible(self) -> dict[int, Piece]:
        """What is shown."""
        return {i: piece for i, piece in self.state.pieces.items() if i not in self.hidden}

    def center(self, instances: Sequence[int]) -> Float64:
        """[3] what `transform` turns these instances about: the mean of the centres of their Gaussians."""
        return _gathered([self.state.pieces[i] for i in instances]).center

    def _after(self, state: State, operation: Operation) -> State:
        done = (*state.done, operation)
        steps, objects = check({"operations": list(done)}, self._begun, self._folder, self._store)
        step = steps[-1] if steps and steps[-1].number == len(done) else None
        if step is None:
            return State(done, objects, state.pieces, state.next_row)
        pieces, next_row = _applied(step, _named(operation, state.objects), state)
        return State(done, objects, pieces, next_row)

    def _forget_what_is_gone(self) -> None:
        there = self.state.objects.entries.keys() | self.state.pieces.keys()
        self.selected = tuple(i for i in self.selected if i in there)
        self.hidden &= there


def _applied(step: Step, ids: Sequence[int], state: State) -> tuple[dict[int, Piece], int]:
    """The pieces after an operation on some instances, and the next row that is free."""
    others = {i: piece for i, piece in state.pieces.items() if i not in ids}
    if step.op == "remove":
        return others, state.next_row
    if step.op == "keep":
        return {i: piece for i, piece in state.pieces.items() if i in ids}, state.next_row
    own_pieces = [state.pieces[i] for i in ids if i in state.pieces]
    if not own_pieces:  # objects that no Gaussian shows can be merged too
        return others, state.next_row
    before = _gathered(own_pieces)
    after = step.apply(before.gaussians)
    stay = before.rows[:0] if step.op == "replace" else before.rows
    next_row = state.next_row + len(after) - len(stay)
    rows = np.concatenate([stay, np.arange(state.next_row, next_row)])
    changed = {
        instance: Piece(rows[own], select(after, own)) for instance, own in rows_by_label(after.instance_id).items()
    }
    return others | changed, next_row


def _gathered(pieces: Sequence[Piece]) -> Piece:
    """Several pieces as one, in the order of the scene: sums over it come to the same bits."""
    rows = np.concatenate([piece.rows for piece in pieces])
    order = np.argsort(rows)
    return Piece(rows[order], select(concatenate([piece.gaussians for piece in pieces]), order))


def _named(operation: Operation, objects: Objects) -> list[int]:
    """The ids of the instances that a checked operation names."""
    named = operation.get("instances", operation.get("instance"))
    several = named if isinstance(named, list) else [named]
    background = (BACKGROUND, "background") if operation["op"] in ("remove", "keep") else ()
    found = (BACKGROUND if one in background else objects.find(one) for one in several)
    return list(dict.fromkeys(instance for instance in found if instance is not None))


def read_operations(file: Path) -> list[Operation]:
    """The operations of an edit script. Raises InputError when there is none that can be read."""
    try:
        document = read_json(file.read_text(encoding="utf-8-sig"), once=True)
        operations = document["operations"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file} is no edit script that can be read: {error}.") from None
    if not isinstance(operations, list):
        raise InputError(f"{file} is no edit script: its operations are no list.")
    return operations


def write_script(file: Path, script: Mapping[str, Any]) -> None:
    """Write an edit script, whole or not at all."""
    write_atomically(file, json.dumps(script, indent=1, ensure_ascii=False) + "\n")
