"""The viewer's panel: what a person does in the browser becomes operations of a session."""

from __future__ import annotations

import html
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.flows.results import BACKGROUND
from ss_flow.flows.view.correcting import Correcting
from ss_flow.flows.view.corrections import Corrections
from ss_flow.flows.view.looking import move_to, view_of_object
from ss_flow.flows.view.nodes import SceneNodes
from ss_flow.flows.view.object_list import ObjectList
from ss_flow.flows.view.picking import Picker, pixel_met
from ss_flow.flows.view.search import Search
from ss_flow.flows.view.session import Operation, Piece, Session, write_script
from ss_flow.tasks.artifacts import Cameras, Float64
from ss_flow.tasks.edit.operations import Motion
from ss_flow.tasks.words import first_of

if TYPE_CHECKING:
    import viser

    Client = viser.ClientHandle | None

_BESIDE = 1.1
"""How many of its own widths a copy is put aside."""
_NOTE_SECONDS = 8.0
_FEWER = (
    '<div style="padding:0 0.8em"><small>Drawn: {drawn:,} of {count:,} Gaussians, enlarged to cover as much. '
    "Clicks and edits mean all of them.</small></div>"
)

Act = Callable[[], None]


class Panel:
    """What stands beside the scene, and what clicks and keys do.

    viser calls from many threads; one lock lets one of them change the session at a time.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        cameras: Cameras,
        session: Session,
        script: Path,
        search: Search | None,
        corrections: Callable[[], Corrections] | None = None,
        draw_at_most: int | None = None,
    ) -> None:
        """cameras: of the capture; objects are looked at from there. script: the file that the edit script is saved to.
        search: None where a run cannot be searched. corrections: opens those of the run; None where it cannot be run
        again. draw_at_most: so many Gaussians, for browsers that draw without a GPU; what is done means all of them.
        """
        self._server, self._cameras, self.session, self._script = server, cameras, session, script
        count = sum(len(piece.rows) for piece in session.state.pieces.values())
        self.nodes = SceneNodes(server, min(1.0, (draw_at_most or count) / max(count, 1)))
        self.lock = threading.RLock()
        self._picker: tuple[dict[int, Piece], Picker] | None = None
        self._saved = session.script()
        self._is_moving = False
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self.objects = ObjectList(gui, session, search, self._chosen)
        self._told = gui.add_html("")
        if self.nodes.share < 1:
            gui.add_html(_FEWER.format(drawn=draw_at_most, count=count))
        self.several = gui.add_checkbox("Select several", False, hint="Shift and a click in the scene does the same")
        self._build_actions(gui)
        self.correcting: Correcting | None = None
        if corrections is not None:
            self.correcting = correcting = Correcting(server, corrections)
            correcting.box.on_update(lambda event: self._attempt(event.client, correcting.checked))
            self._group(gui, "Points", self._corrections_actions(correcting))
        self._colors = gui.add_dropdown("Colours", ("photos", "objects"))
        self._colors.on_update(lambda event: self._attempt(event.client, lambda: None))
        server.scene.on_click()(lambda event: self._clicked(event, more=False))
        server.scene.on_click(modifier="shift")(lambda event: self._clicked(event, more=True))
        self.refresh()

    @property
    def unsaved(self) -> bool:
        """Whether the saved script is another."""
        return self.session.script() != self._saved

    def refresh(self) -> None:
        """Show the state of the session."""
        session = self.session
        with self.lock, self._server.atomic():
            pieces = session.state.pieces
            self.nodes.show(pieces, session.visible(), session.selected, self._colors.value)  # type: ignore[arg-type]
            self.objects.show()
            self._told.content = self._selection_html()
            if self.correcting is not None:
                self.correcting.show()
            if self._is_moving and (solid := self._solid()):
                self.nodes.hold(solid, session.center(solid), self._moved)

    def _build_actions(self, gui: viser.GuiApi) -> None:
        act = self._actions()
        for label, names in (
            ("Show", ("Look at", "Hide", "Isolate", "Show all")),
            ("Change", ("Move", "Duplicate", "Remove", "Merge", "Split")),
        ):
            self._group(gui, label, {name: act[name] for name in names})
        self._name = gui.add_text("Name", "")
        self._color = gui.add_rgb("Colour", (208, 32, 32))
        self.factor = gui.add_number("Scale factor", 1.0, min=0.01, max=100.0, step=0.05)
        self._fill = gui.add_checkbox(
            "Fill the holes", False, hint="What leaves its place has its surroundings continued; shown by ss-flow edit"
        )
        self._group(gui, "Set", {name: act[name] for name in ("Rename", "Recolour", "Scale")})
        self._group(gui, "Edits", {name: act[name] for name in ("Undo", "Redo", "Save")})
        for name, hotkey, modifier in _KEYS:
            command = gui.add_command(name, hotkey=hotkey, modifier=modifier)
            self._on_key(command, act[name])

    def _actions(self) -> dict[str, Callable[[Client], None]]:
        """What each button does; it is given the browser that asked."""
        session = self.session
        return {
            "Look at": self._look_at,
            "Hide": lambda _: session.hide(session.selected),
            "Isolate": lambda _: session.isolate(session.selected),
            "Show all": lambda _: session.show(),
            "Move": lambda _: self._toggle_gizmo(),
            "Duplicate": self._duplicate,
            "Remove": lambda _: self._do(self._several_of("remove", **self._filled())),
            "Merge": lambda _: self._do(self._several_of("merge")),
            "Split": lambda _: self._do(self._one_of("split")),
            "Rename": lambda _: self._do({**self._one_of("relabel"), "name": self._name.value}),
            "Recolour": lambda _: self._do(self._several_of("recolour", color=list(self._color.value))),
            "Scale": lambda _: self._do(self._several_of("transform", scale=self.factor.value, **self._filled())),
            "Undo": lambda _: session.undo(),
            "Redo": lambda _: session.redo(),
            "Save": self._save,
            "Select nothing": lambda _: session.select(None),
        }

    def _corrections_actions(self, correcting: Correcting) -> dict[str, Callable[[Client], None]]:
        return {
            "Next thing": lambda _: correcting.corrections.next_thing(),
            "Undo point": lambda _: correcting.corrections.undo(),
            "Save hints": lambda client: self._save_corrections(correcting.corrections, client),
        }

    def _on_key(self, command: viser.CommandHandle, act: Callable[[Client], None]) -> None:
        command.on_trigger(lambda event: self._attempt(event.client, lambda: act(event.client)))

    def _group(self, gui: viser.GuiApi, label: str, acts: dict[str, Callable[[Client], None]]) -> None:
        group = gui.add_button_group(label, tuple(acts))

        @group.on_click
        def _(event: Any) -> None:
            act = acts.get(event.target.value)
            if act is not None:  # a browser may say anything
                self._attempt(event.client, lambda: act(event.client))

    def _attempt(self, client: Client, act: Act) -> None:
        """Do something, and show what became of it; what is refused is told."""
        with self.lock:
            try:
                act()
            except InputError as error:
                self._tell(client, "Refused", str(error), color="red")
            self.refresh()

    def _do(self, *operations: Operation) -> None:
        if not self.session.selected:
            raise InputError("select an object first: click it in the scene or in the list.")
        self.session.do(*operations)

    def _several_of(self, op: str, **fields: Any) -> Operation:
        return {"op": op, "instances": list(self.session.selected), **fields}

    def _one_of(self, op: str) -> Operation:
        if len(self.session.selected) > 1:
            raise InputError(f"{op} takes one object, and {len(self.session.selected)} are selected.")
        return {"op": op, "instance": next(iter(self.session.selected), None)}

    def _filled(self) -> dict[str, bool]:
        return {"fill": True} if self._fill.value else {}

    def _solid(self) -> list[int]:
        """What is selected and can be moved."""
        shown = self.session.visible()
        return [i for i in self.session.selected if i != BACKGROUND and i in shown]

    def _look_at(self, client: Client) -> None:
        """Stand where what is selected is seen well; it may be anywhere, when it comes from the list."""
        pieces = [self.session.state.pieces[i] for i in self.session.selected if i in self.session.state.pieces]
        if not pieces:
            raise InputError("select an object that has Gaussians to look at it.")
        if client is not None:
            points = np.concatenate([piece.gaussians.means for piece in pieces])
            move_to(client, *view_of_object(self._cameras, points, client.camera.fov))

    def _toggle_gizmo(self) -> None:
        self._is_moving = not self._is_moving
        if self._is_moving and not self._solid():
            self._is_moving = False
            raise InputError("select an object that has Gaussians, and is shown, to move it.")

    def _moved(self, motion: Motion) -> None:
        """The gizmo was let go."""
        fields: dict[str, Any] = {"move": list(motion.move)} if any(motion.move) else {}
        if motion.degrees:
            fields["rotate"] = {"axis": list(motion.axis), "degrees": motion.degrees}
        with self.lock:
            solid = self._solid()
            operation = {"op": "transform", "instances": solid, **fields, **self._filled()}
            self._attempt(None, lambda: self.session.do(operation) if fields and solid else None)

    def _duplicate(self, client: Client) -> None:
        """A copy of each, to the right of who looks; the copies are selected then."""
        from scipy.spatial.transform import Rotation

        session = self.session
        right = np.array([1.0, 0.0, 0.0])
        if client is not None:
            right = Rotation.from_quat(client.camera.wxyz, scalar_first=True).as_matrix()[:, 0]
        first = session.state.objects.next_id
        copies = [
            {"op": "duplicate", "instance": instance, "move": _aside(session.state.pieces[instance], right)}
            for instance in self._solid()
        ]
        if session.selected and not copies:
            raise InputError("select an object that has Gaussians, and is shown, to copy it.")
        self._do(*copies)
        for number in range(len(copies)):
            session.select(first + number, more=number > 0)

    def _save(self, client: Client) -> None:
        script = self.session.script()
        try:
            write_script(self._script, script)
        except OSError as error:
            raise InputError(f"{self._script.name} cannot be written: {error.strerror}.") from None
        self._saved = script
        count = len(script["operations"])
        self._tell(client, "Saved", f"{count} operations in {self._script.name}", color="teal")

    def _correct(self, correcting: Correcting, met: tuple[int, Float64] | None) -> None:
        if self.session.state.done:  # what was edited no longer stands where the photos show it
            raise InputError("corrections are clicked on the run as it is; undo the edits first.")
        correcting.corrections.pick(*(met or (BACKGROUND, np.zeros(3))))

    def _save_corrections(self, corrections: Corrections, client: Client) -> None:
        corrections.save()
        body = f"{len(corrections.picks)} points in {corrections.file.name}; the command stands in the terminal"
        self._tell(client, "Saved", body, color="teal")

    def _chosen(self, instances: tuple[int, ...]) -> None:
        """Picked from the list."""
        with self.lock:
            if not self.several.value:
                self.session.select(None)
            for instance in instances:
                self.session.select(instance, more=True)
            self.refresh()

    def _clicked(self, event: viser.SceneClickEvent, *, more: bool) -> None:
        """A click in the scene. The ray is exact; what else is known of the camera may be a moment old."""
        camera, direction = event.client.camera, np.array(event.ray_direction)
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        if not (np.any(direction) and focal > 0):
            return
        size = camera.image_width, camera.image_height
        pixel = pixel_met(np.array(event.ray_origin), direction, camera.wxyz, float(focal), size)
        with self.lock:
            met = self.pick().met(pixel) if pixel is not None else None
            if self.correcting is not None and self.correcting.box.value:
                correcting = self.correcting
                self._attempt(event.client, lambda: self._correct(correcting, met))
                return
            self.session.select((met[0] or None) if met else None, more=more or self.several.value)
            self.refresh()

    def pick(self) -> Picker:
        """What answers clicks on the scene as it is shown now."""
        shown = self.session.visible()
        if self._picker is None or self._picker[0] != shown:
            self._picker = shown, Picker(shown)
        return self._picker[1]

    def _selection_html(self) -> str:
        """What is selected, and how much there is to save."""
        selected, objects = self.session.selected, self.session.state.objects
        names = ["the background" if i == BACKGROUND else objects.name(i) for i in selected]
        told = html.escape(first_of(names, 4))
        count = len(self.session.state.done)
        edits = f"{count} edit{'' if count == 1 else 's'}" + (", not all saved" if self.unsaved else "")
        return f'<div style="padding:0.3em 0.8em"><b>{told or "Nothing selected"}</b><br><small>{edits}</small></div>'

    def _tell(self, client: Client, title: str, body: str, *, color: Any) -> None:
        if client is not None:
            client.add_notification(title, body, auto_close_seconds=_NOTE_SECONDS, color=color)


_KEYS: tuple[tuple[str, Any, Any], ...] = (
    ("Look at", "F", None),
    ("Hide", "H", None),
    ("Isolate", "I", None),
    ("Show all", "U", None),
    ("Move", "G", None),
    ("Duplicate", "C", None),
    ("Remove", "delete", None),
    ("Undo", "Z", "cmd/ctrl"),
    ("Redo", "Z", "cmd/ctrl+shift"),
    ("Save", "S", "cmd/ctrl"),
    ("Select nothing", "escape", None),
)
"""An action, its key, and what is held with it."""


def _aside(piece: Piece, right: Float64) -> list[float]:
    """How far to move a copy to the right so that it stands free."""
    along = np.percentile(piece.gaussians.means @ right, (2, 98))
    return [float(f"{x:.6g}") for x in _BESIDE * float(along[1] - along[0]) * right]
