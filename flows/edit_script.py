"""Edit scripts: a list of operations as data, checked whole against the objects of a scene before anything runs."""

from __future__ import annotations

import copy
import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast

from ss_flow.cache.canonical import digest_file
from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows import edit_fields
from ss_flow.flows.edit_fields import Field, Unfit
from ss_flow.flows.edit_objects import Objects, object_of_run, up_of_run
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import EditedScene
from ss_flow.tasks.edit import operations
from ss_flow.tasks.edit.operations import Motion, Vector, smallest_turn

T = TypeVar("T")
_REQUIRED = cast(Any, object())
_VERSION = 1
_NO_TURN: tuple[Vector, float] = ((0.0, 0.0, 1.0), 0.0)
_BACKGROUND = "background"
"""What `remove` and `keep` call what has the id 0, so no object is given this name."""
_OF_GAUSSIANS = ("duplicate", "transform", "recolour", "replace", "split")
"""Operations that need Gaussians to work on."""


@dataclass(frozen=True)
class Step:
    """An operation that changes Gaussians, ready to run."""

    number: int
    """Its place in the script, from 1 on."""
    op: str
    apply: Callable[[EditedScene], EditedScene]
    """In a flow: adds the operation's nodes."""
    leaving: tuple[int, ...] = ()
    """Ids of the instances that leave their place, where a hole may stay behind."""
    gone: tuple[int, ...] = ()
    """Ids whose dense points are no longer there after it."""
    fill: bool = False
    warning: str | None = None


def check(script: object, objects: Objects, folder: Path, store: Store | None = None) -> tuple[list[Step], Objects]:
    """What a script comes to: the steps to run, and the objects afterwards.

    script: the document, {"version": 1, "operations": [...]}. objects: those of the scene; they stay as they are.
    folder: what relative paths in the script start from. store: where results of other runs may be, besides where they
    say.
    Raises InputError for the first fault, naming the operation, the field and what would be right.
    """
    if not isinstance(script, Mapping) or not isinstance(script.get("operations"), list):
        raise InputError('an edit script is a JSON object such as {"version": 1, "operations": [...]}.')
    if script.get("version", _VERSION) != _VERSION or isinstance(script.get("version"), bool):
        raise InputError(f"the edit script has the version {script['version']!r}; this program reads version 1.")
    if odd := sorted(script.keys() - {"version", "operations", "comment"}):
        raise InputError(f"the edit script has the field {odd[0]!r}; it takes version, operations and comment.")
    objects = copy.deepcopy(objects)
    steps = []
    for number, raw in enumerate(script["operations"], 1):
        step = _step(number, raw, objects, folder, store)
        steps += [step] if step is not None else []
    return steps, objects


def rooted(script: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A checked script with absolute paths in the place of those that start from `folder`."""
    operations = [
        {**operation, "run": str((folder / operation["run"]).resolve())} if "run" in operation else operation
        for operation in script["operations"]
    ]
    return {**script, "operations": operations}


def _step(number: int, raw: object, objects: Objects, folder: Path, store: Store | None) -> Step | None:
    if not isinstance(raw, Mapping):
        raise InputError(f'operation {number} must be an object such as {{"op": "remove", "instances": [3]}}.')
    op = raw.get("op")
    if not isinstance(op, str) or op not in _OPERATIONS:
        raise InputError(
            f"operation {number}: op is {op!r}; it must be one of {', '.join(_OPERATIONS)}"
            f"{_hint(op, _OPERATIONS) or '.'}"
        )
    call = _Call(number, op, dict(raw), objects, folder, store)
    call.take("op", edit_fields.TEXT)
    call.take("comment", edit_fields.TEXT, "")
    step = _OPERATIONS[op](call)
    call.finish()
    return step


def _hint(word: object, known: Sequence[str] | Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(str(word), list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _ended(sentence: str) -> str:
    return sentence if sentence.endswith((".", "?")) else f"{sentence}."


class _Call:
    """One operation while its fields are read; what is wrong is said with its number and the field's name."""

    def __init__(
        self, number: int, op: str, raw: dict[str, Any], objects: Objects, folder: Path, store: Store | None
    ) -> None:
        self.number, self.op, self.objects, self.folder, self.store = number, op, objects, folder, store
        self._raw, self._known = raw, list[str]()

    def take(self, name: str, field: Field[T], default: T = _REQUIRED) -> T:
        """The value of one field."""
        self._known.append(name)
        if name not in self._raw:
            if default is _REQUIRED:
                raise InputError(f"operation {self.number} ({self.op}): {name} is missing; {field.wanted}.")
            return default
        value = self._raw.pop(name)
        try:
            return field.read(value)
        except Unfit as error:
            raise self.fault(name, value, error) from None

    def fault(self, name: str, value: object, error: Exception) -> InputError:
        """What is wrong with a field."""
        return InputError(f"operation {self.number} ({self.op}): {name} is {value!r}; {_ended(str(error))}")

    def step(
        self, apply: Callable[[EditedScene], EditedScene], leaving: tuple[int, ...] = (), *, fill: bool = False
    ) -> Step:
        """The operation, ready to run."""
        return Step(self.number, self.op, apply, leaving, tuple(sorted(self.objects.gone)), fill)

    def finish(self) -> None:
        """Refuse what is left over."""
        for name in self._raw:
            raise InputError(
                f"operation {self.number} ({self.op}): the field {name!r} is unknown; it takes "
                f"{', '.join(self._known)}{_hint(name, self._known) or '.'}"
            )

    def instance(self) -> int:
        """The one instance that the field `instance` names."""
        return self.take("instance", Field("it must name an instance by id or by name", self._one))

    def instances(self, *, background: bool = False, least: int = 1) -> tuple[int, ...]:
        """The instances that the field `instances` names, each once, in its order."""

        def read(value: Any) -> tuple[int, ...]:
            named = value if isinstance(value, list) else [value]
            ids = tuple(dict.fromkeys(self._one(item, background=background) for item in named))
            if len(ids) < least:
                raise Unfit(f"it must name at least {'one instance' if least == 1 else f'{least} instances'}")
            return ids

        return self.take("instances", Field('it must name instances by id or by name, as in [3, "red mug"]', read))

    def new_name(self, like: str) -> str:
        """A name that no object has yet; by default one like this."""
        return self.take("name", Field(edit_fields.TEXT.wanted, self._free_name), self.objects.unique(like))

    def name_of(self, instance: int) -> str:
        """Its new name; by default it keeps its own."""
        own = self.objects.name(instance)
        return self.take(
            "name", Field(edit_fields.TEXT.wanted, lambda value: own if value == own else self._free_name(value)), own
        )

    def _free_name(self, value: Any) -> str:
        if edit_fields.TEXT.read(value) in self.objects.names():
            raise Unfit("there is an object of this name; give it another one")
        if value == _BACKGROUND:
            raise Unfit("the background goes by this name; give it another one")
        return str(value)

    def motion(self) -> Motion:
        """move, rotate, scale and pivot."""
        turn = self.take("rotate", edit_fields.TURN, _NO_TURN)
        return Motion(
            move=self.take("move", edit_fields.VECTOR, (0.0, 0.0, 0.0)),
            axis=turn[0],
            degrees=turn[1],
            scale=self.take("scale", edit_fields.POSITIVE, 1.0),
            pivot=self.take("pivot", edit_fields.PIVOT, None),
        )

    def _one(self, value: Any, *, background: bool = False) -> int:
        if background and value in (0, _BACKGROUND) and not isinstance(value, bool):
            return 0
        found = self.objects.find(value) if isinstance(value, int | str) and not isinstance(value, bool) else None
        if found is None:
            names = self.objects.names()
            close = _hint(value, names) if isinstance(value, str) else ""
            raise Unfit(f"no instance goes by {value!r} at this point; instances.json lists ids and names{close}")
        if self.op in _OF_GAUSSIANS and not self.objects.solid(found):
            raise Unfit(f"{found} has no Gaussians (too few views show it); name one that has")
        return found


def _remove(call: _Call) -> Step:
    ids, fill = call.instances(background=True), call.take("fill", edit_fields.FLAG, False)
    call.objects.remove(ids)
    leaving = tuple(i for i in ids if i)
    return call.step(lambda scene: operations.remove(scene, instances=ids), leaving, fill=fill)


def _keep(call: _Call) -> Step:
    ids = call.instances(background=True)
    call.objects.keep(ids)
    return call.step(lambda scene: operations.keep(scene, instances=ids))


def _duplicate(call: _Call) -> Step:
    instance, motion = call.instance(), call.motion()
    new_id = call.objects.copy(instance, call.new_name(call.objects.name(instance)))
    return call.step(lambda scene: operations.duplicate(scene, instance=instance, new_id=new_id, motion=motion))


def _transform(call: _Call) -> Step:
    ids, motion, fill = call.instances(), call.motion(), call.take("fill", edit_fields.FLAG, False)
    call.objects.move(ids)
    return call.step(lambda scene: operations.transform(scene, instances=ids, motion=motion), ids, fill=fill)


def _recolour(call: _Call) -> Step:
    ids, color = call.instances(), call.take("color", edit_fields.COLOR)
    return call.step(lambda scene: operations.recolour(scene, instances=ids, color=color))


def _replace(call: _Call) -> Step:
    instance, fill = call.instance(), call.take("fill", edit_fields.FLAG, False)
    run, wanted = call.take("run", edit_fields.TEXT), call.take("by", edit_fields.ID_OR_NAME)
    scale = call.take("scale", edit_fields.SCALE_OR_FIT, None)
    try:
        entry, parts, file = object_of_run(call.folder / run, wanted)
    except ValueError as error:
        raise call.fault("by", wanted, error) from None
    except InputError as error:
        raise call.fault("run", run, error) from None
    call.objects.remove((instance,))
    new_id = call.objects.put_in(entry, parts, call.new_name(entry["name"]))
    ref = FileRef.of(file.absolute(), digest_file)
    own, theirs = call.objects.up, up_of_run(call.folder / run, call.store)
    turn = smallest_turn(theirs, own) if own and theirs else _NO_TURN
    unturned = f"the cameras of {run} are in no store at hand, so the object is not turned and may not stand upright."

    def apply(scene: EditedScene) -> EditedScene:
        other = operations.read_object(file=ref)
        return operations.put_in_place(scene, other, instance=instance, new_id=new_id, scale=scale, turn=turn)

    return replace(call.step(apply, (instance,), fill=fill), warning=unturned if own and not theirs else None)


def _relabel(call: _Call) -> None:
    """Names and kinds are no matter of the Gaussians: nothing is to be computed."""
    instance = call.instance()
    call.objects.rename(
        instance, call.name_of(instance), call.take("kind", edit_fields.KIND, call.objects.kind(instance))
    )


def _merge(call: _Call) -> Step:
    ids = call.instances(least=2)
    rows = call.objects.merge(ids)
    call.objects.rename(ids[0], call.name_of(ids[0]), call.objects.kind(ids[0]))
    return call.step(lambda scene: operations.relabel(scene, rows=rows))


def _split(call: _Call) -> Step:
    instance = call.instance()
    try:
        rows = call.objects.split(instance)
    except ValueError as error:
        raise call.fault("instance", instance, error) from None
    return call.step(lambda scene: operations.relabel(scene, rows=rows))


_OPERATIONS: dict[str, Callable[[_Call], Step | None]] = {
    "remove": _remove,
    "keep": _keep,
    "duplicate": _duplicate,
    "transform": _transform,
    "recolour": _recolour,
    "replace": _replace,
    "relabel": _relabel,
    "merge": _merge,
    "split": _split,
}
