"""The viewer's controls for corrections: points picked in the scene, listed, taken back and saved."""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import TYPE_CHECKING

from ss_flow.flows.view.corrections import Corrections, Pick
from ss_flow.tasks.deliver.palette import instance_color

if TYPE_CHECKING:
    import viser

_OF_SPACING = 2.0
"""Radius of the ball that marks a point, in spacings of the dense points."""


class Correcting:
    """While its box is checked, a click in the scene picks a point on a thing, instead of selecting.

    The panel calls it with its lock held, and tells what is refused (InputError).
    """

    def __init__(self, server: viser.ViserServer, begin: Callable[[], Corrections]) -> None:
        """begin: opens the corrections, when they are first asked for. Raises InputError."""
        self._server, self._begin = server, begin
        self._corrections: Corrections | None = None
        self._marks: dict[Pick, viser.IcosphereHandle] = {}
        self.box = server.gui.add_checkbox(
            "Correct by clicks", False, hint="Points of one thing make it one; points of two things part them"
        )
        self._told = server.gui.add_html("")

    @property
    def corrections(self) -> Corrections:
        """Those that are picked. Raises InputError as `Corrections` does."""
        if self._corrections is None:
            self._corrections = self._begin()
        return self._corrections

    def checked(self) -> None:
        """Open the corrections with the box, since their file may hold points. Raises InputError as these do."""
        if self.box.value:
            _ = self.corrections

    def show(self) -> None:
        """Show the points, and what they will do."""
        known = self._corrections
        picks = known.picks if known is not None and self.box.value else []
        for pick in self._marks.keys() - set(picks):
            self._marks.pop(pick).remove()
        for pick in picks:
            if known is not None and pick not in self._marks:
                self._marks[pick] = self._server.scene.add_icosphere(
                    f"/corrections/{pick.thing}/{pick.row}",
                    _OF_SPACING * known.spacing,
                    instance_color(pick.thing),
                    position=known.place_of(pick),
                    cast_shadow=False,
                    receive_shadow=False,
                )
        if known is not None:
            count = f"{len(known.picks)} point{'' if len(known.picks) == 1 else 's'}"
            lines = [f"{count}{', not all saved' if known.unsaved else ''}; now on thing {known.thing}", *known.told()]
            text = "<br>".join(map(html.escape, lines))
            self._told.content = f'<div style="padding:0.3em 0.8em"><small>{text}</small></div>'
