"""The list of objects and the search box above it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.flows.query import words_left_out
from ss_flow.flows.results import BACKGROUND
from ss_flow.flows.view.search import Search
from ss_flow.flows.view.session import Session
from ss_flow.tasks.artifacts import UInt8
from ss_flow.tasks.deliver.compressed import compressed, data_uri
from ss_flow.tasks.deliver.instances_json import is_doubtful
from ss_flow.tasks.deliver.palette import instance_color
from ss_flow.tasks.semantics.query import QueryResult

if TYPE_CHECKING:
    import viser

_ROWS = 8
_SELECTED, _MATCHED, _OTHER, _HIDDEN = "orange", "teal", "blue", "gray"
"""Colours of a row's button."""


@dataclass
class _Row:
    """The button of an object.

    It stands for no other one: a click tells which button was pressed, and may come when the list has changed since.
    """

    instance: int
    button: viser.GuiButtonHandle
    look: tuple[str, str, str] | None = None
    """What it shows: label, colour, picture."""


class ObjectList:
    """Objects page by page, the largest first, or those first that a text means: by name, then by what they look like.

    Its parts are viser's: `text`, `tau`, `answer`, the buttons of the `rows` that are shown, and `turn`, those below
    them.
    """

    def __init__(
        self, gui: viser.GuiApi, session: Session, search: Search | None, choose: Callable[[tuple[int, ...]], None]
    ) -> None:
        """choose: called with the objects that were picked from the list."""
        self._gui, self._session, self._search, self._choose = gui, session, search, choose
        self._pictures: dict[int, str] = {}
        self._found: QueryResult | None = None
        self._named: tuple[int, ...] = ()
        """Objects that are meant by their name."""
        self._page = 0
        self._lock = threading.RLock()
        self.text = gui.add_text("Search", "", hint="What to look for, such as: red mug, not the lamp")
        tau = search.params.tau_corr if search is not None else 0.02
        self.tau = gui.add_slider(
            "Tolerance",
            min=0.001,
            max=max(0.3, tau),
            step=0.001,
            initial_value=tau,
            hint="How much further than the best an object may be and still match: --tau-corr",
        )
        self.answer = gui.add_markdown("" if search is not None else "This run has no descriptors to search.")
        self.text.disabled = self.tau.disabled = search is None
        self._known: dict[int, _Row] = {}
        self.rows: list[_Row] = []
        self.turn = gui.add_button_group("Page", ("Before", "Next", "Select matches"))
        self.text.on_update(lambda _: self._ask())
        self.tau.on_update(lambda _: self._ask())
        self.turn.on_click(self._turned)

    def picture(self, instance: int) -> str:
        """A small picture of an object as HTML: a cut-out of a photo, or its colour."""
        swatch = np.full((1, 1, 3), instance_color(instance), np.uint8)
        return self._pictures.get(instance) or _as_html(compressed(swatch))

    def set_pictures(self, pictures: Mapping[int, UInt8]) -> None:
        """pictures: the bytes of a PNG or JPEG file by instance."""
        self._pictures = {instance: _as_html(picture) for instance, picture in pictures.items()}
        self.show()

    def show(self) -> None:
        """Bring the rows to the state of the session."""
        with self._lock:
            order = self._order()
            self._page = min(self._page, max(0, (len(order) - 1) // _ROWS))
            listed = order[self._page * _ROWS : (self._page + 1) * _ROWS]
            for row in self.rows:
                if row.instance not in listed:
                    row.button.visible = False
            self.rows = [self._row(instance, place) for place, instance in enumerate(listed)]
            first = self._page * _ROWS
            self.turn.label = f"{first + 1}-{first + len(listed)} of {len(order)}" if order else "none"

    def _order(self) -> list[int]:
        """The ids to list, those that are asked for first, what is doubtful last."""
        objects, pieces = self._session.state.objects, self._session.state.pieces
        size = {i: len(pieces[i].rows) if i in pieces else 0 for i in objects.entries}
        by_size = sorted(size, key=lambda i: (is_doubtful(objects.entries[i]), -size[i]))
        if self._found is None:
            by_size += [BACKGROUND] if BACKGROUND in pieces else []
        ranked = [] if self._found is None else [i for i in self._found.instance_id.tolist() if i in objects.entries]
        return list(dict.fromkeys([*self._named, *ranked, *by_size]))

    def _row(self, instance: int, place: int) -> _Row:
        """The row of an object, shown at a place of the list: 0 is the first."""
        order = self.answer.order + (place + 1) / (_ROWS + 1)
        row = self._known.get(instance)
        if row is None:
            row = self._known[instance] = _Row(instance, self._gui.add_button(" ", order=order))
            row.button.on_click(lambda _: self._choose((instance,)))
        if row.button.order != order:
            row.button.order = order
        look = (self._label(instance), self._color(instance), self.picture(instance))
        if look != row.look:
            row.button.label, row.button.color = look[0], look[1]  # type: ignore[assignment]
            row.button._icon_html = look[2]  # viser's own icons are set through it
            row.look = look
        if not row.button.visible:
            row.button.visible = True
        return row

    def _label(self, instance: int) -> str:
        if instance == BACKGROUND:
            return "background"
        entry = self._session.state.objects.entries[instance]
        score = "" if self._found is None else f" · {self._score(instance):.3f}"
        return f"{entry['name']} · {entry['confidence']:.2f}{score}"

    def _score(self, instance: int) -> float:
        assert self._found is not None
        own = self._found.score[self._found.instance_id == instance]
        return float(own[0]) if len(own) else -1.0

    def _color(self, instance: int) -> str:
        if instance in self._session.selected:
            return _SELECTED
        if instance in self._session.hidden:
            return _HIDDEN
        return _MATCHED if instance in self._matches() else _OTHER

    def _matches(self) -> tuple[int, ...]:
        """The objects that the text means, those that bear it as their name first."""
        return tuple(dict.fromkeys([*self._named, *(self._found.matches() if self._found is not None else ())]))

    def _ask(self) -> None:
        """Search anew. Letters that came meanwhile are answered at once, by who comes last."""
        with self._lock:
            text, tau = self.text.value.strip(), float(self.tau.value)
            self._page, self._found, self._named = 0, None, ()
            answer = ""
            if text and self._search is not None and tau > 0:
                try:
                    self._found = self._search(text, tau)
                    self._named = self._called(text, whole=True)
                    matches = len(self._matches())
                    answer = f"{matches} match" if matches else "Nothing in the scene matches."
                    answer = "\n\n".join(filter(None, [answer, words_left_out(self._found)]))
                except InputError as error:
                    self._named = self._called(text, whole=False)
                    answer = f"{len(self._named)} by name" if self._named else str(error)
            self.answer.content = answer
            self.show()

    def _called(self, text: str, *, whole: bool) -> tuple[int, ...]:
        """The objects whose name is a text, or has it in it; upper and lower case are one."""
        objects, asked = self._session.state.objects, text.casefold()
        called = {i: objects.name(i).casefold() for i in objects.entries}
        return tuple(i for i, name in called.items() if (name == asked if whole else asked in name))

    def _turned(self, event: Any) -> None:
        if event.target.value == "Select matches":
            self._choose(self._matches())
            return
        self._page = max(0, self._page + (1 if event.target.value == "Next" else -1))
        self.show()


def _as_html(picture: UInt8) -> str:
    """A picture (the bytes of a file), as large as a button of viser allows."""
    style = "height:1.9em;width:1.9em;position:absolute;left:-0.6em;top:-0.45em"
    return f'<img style="{style}" src="{data_uri(picture)}">'
