"""The scene in viser: a node of Gaussians for each instance, what marks the selected ones, and the gizmo."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from ss_flow.flows.view.drawing import add_gaussians, change_gaussians
from ss_flow.flows.view.session import Piece
from ss_flow.flows.view.thinning import thinned
from ss_flow.tasks.artifacts import Float64, Gaussians, UInt8
from ss_flow.tasks.deliver.export.content import base_colors
from ss_flow.tasks.deliver.palette import instance_color
from ss_flow.tasks.edit.operations import Motion

if TYPE_CHECKING:
    import viser

Colors = Literal["photos", "objects"]
_MARK = (255, 140, 0)
_TINT = 0.8
"""How far the colours of what is selected go towards the mark's, which takes their light and shade. With less, what is
blue would become as grey as a wall."""
_LUMA = (0.299, 0.587, 0.114)
_WITHIN = (2, 98)
"""Percentiles of the centres that a box goes round, since a few Gaussians lie far off."""
_GIZMO = 0.6
"""Length of the gizmo's arrows, in diagonals of the largest box: they must stick out of what is moved."""
_DIGITS = 6
"""Significant digits of a motion that the gizmo has led."""


class SceneNodes:
    """What stands in viser's scene. A piece that has not changed is not sent again."""

    def __init__(self, server: viser.ViserServer, share: float = 1.0) -> None:
        """share: of each piece's Gaussians, how many are drawn (`thinned`)."""
        self._server, self.share = server, share
        self._nodes: dict[int, viser.GaussianSplatHandle] = {}
        self._drawn: dict[int, tuple[Piece, Colors, bool]] = {}
        """Of each node: what it shows, in which colours, and whether as selected."""
        self._boxes: dict[int, viser.BoxHandle] = {}
        self.gizmo: viser.TransformControlsHandle | None = None

    def show(
        self, pieces: Mapping[int, Piece], visible: Iterable[int], selected: Sequence[int], colors: Colors
    ) -> None:
        """Bring the scene to this state; the gizmo goes."""
        shown = set(visible)
        with self._server.atomic():
            self.release()
            for instance in self._nodes.keys() - pieces.keys():
                self._nodes.pop(instance).remove()
                del self._drawn[instance]
            for instance, piece in pieces.items():
                self._draw(instance, piece, colors, is_selected=instance in selected)
                if self._nodes[instance].visible != (instance in shown):
                    self._nodes[instance].visible = instance in shown
            for box in self._boxes.values():
                box.remove()
            self._boxes = {i: self._boxed(i, pieces[i]) for i in selected if i in pieces and i in shown}

    def hold(self, instances: Sequence[int], center: Float64, moved: Callable[[Motion], None]) -> None:
        """Put a gizmo at the point that some of the selected instances are to be turned about.

        moved: told the motion each time the gizmo was let go.
        """
        from scipy.spatial.transform import Rotation

        self.release()
        held = [self._nodes[instance] for instance in instances]
        boxes = {i: (self._boxes[i], np.array(self._boxes[i].position)) for i in instances if i in self._boxes}
        sizes = [float(np.linalg.norm(box.dimensions)) for box, _ in boxes.values()]
        # With depth: splats are drawn last, and paint over what has left none, even where they lie behind it.
        gizmo = self._server.scene.add_transform_controls(
            "/gizmo", scale=_GIZMO * max(sizes, default=1.0), depth_test=True, position=center
        )

        @gizmo.on_update
        async def _(_: object) -> None:
            turn = Rotation.from_quat(gizmo.wxyz, scalar_first=True)
            with self._server.atomic():
                for node in held:
                    node.wxyz, node.position = gizmo.wxyz, gizmo.position - turn.apply(center)
                for box, middle in boxes.values():
                    box.wxyz, box.position = gizmo.wxyz, gizmo.position + turn.apply(middle - center)

        @gizmo.on_update
        def _(event: viser.TransformControlsEvent) -> None:
            if event.phase == "end":
                moved(motion_of(gizmo.position - center, gizmo.wxyz))

        self.gizmo = gizmo

    def release(self) -> None:
        """Take the gizmo away; what it has moved goes back, unless it was drawn anew since."""
        if self.gizmo is None:
            return
        self.gizmo.remove()
        self.gizmo = None
        for node in self._nodes.values():
            if np.any(node.position) or node.wxyz[0] != 1:
                node.wxyz, node.position = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)

    def _draw(self, instance: int, piece: Piece, colors: Colors, *, is_selected: bool) -> None:
        before, look = self._drawn.get(instance), (colors, is_selected)
        if before is not None and before[0] is piece and before[1:] == look:
            return
        drawn = thinned(piece.gaussians, self.share)
        own = _colors(instance, drawn, colors, is_selected=is_selected)
        if instance in self._nodes:
            change_gaussians(self._nodes[instance], drawn, own)
        else:
            self._nodes[instance] = add_gaussians(self._server.scene, f"/objects/{instance}", drawn, own)
        self._drawn[instance] = (piece, *look)

    def _boxed(self, instance: int, piece: Piece) -> viser.BoxHandle:
        low, high = np.percentile(piece.gaussians.means.astype(np.float64), _WITHIN, axis=0)
        return self._server.scene.add_box(
            f"/selected/{instance}", _MARK, high - low, wireframe=True, position=(low + high) / 2
        )


def motion_of(move: Float64, wxyz: Float64) -> Motion:
    """The motion about a centre that moves it by `move` and turns it by a unit quaternion, in a few digits."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(wxyz, scalar_first=True).as_rotvec(degrees=True)
    degrees = float(np.linalg.norm(turn))
    axis = _short(turn / degrees) if degrees > 1e-3 else (0.0, 0.0, 1.0)
    return Motion(move=_short(move), axis=axis, degrees=float(f"{degrees:.{_DIGITS}g}") if degrees > 1e-3 else 0.0)


def _short(vector: Float64) -> tuple[float, float, float]:
    x, y, z = (float(f"{value:.{_DIGITS}g}") for value in vector)
    return x, y, z


def _colors(instance: int, gaussians: Gaussians, colors: Colors, *, is_selected: bool) -> UInt8 | None:
    """[N, 3] RGB; None for those of the Gaussians themselves."""
    if colors == "photos" and not is_selected:
        return None
    own = 255 * base_colors(gaussians).clip(0, 1)
    if colors == "objects":
        own = 0.25 * own + 0.75 * np.array(instance_color(instance))
    if is_selected:
        light = own @ np.array(_LUMA)[:, None] / 255
        own = (1 - _TINT) * own + _TINT * (0.65 + 0.6 * light) * np.array(_MARK)
    return np.rint(own.clip(0, 255)).astype(np.uint8)
