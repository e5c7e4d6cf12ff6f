"""The capture's cameras in the scene: frusta that hold what each view shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ss_flow.flows.results import Results
from ss_flow.flows.view.drawing import Around, add_views, view_picture
from ss_flow.tasks.artifacts import Cameras, UInt8
from ss_flow.tasks.deliver.palette import depth_colors
from ss_flow.tasks.geometry.cameras import camera_of

if TYPE_CHECKING:
    import viser

_RESULTS = {"photos": "ingest", "masks": "masks", "depth": "depth"}
"""Which result of a run each kind of picture is made from."""


class CameraViews:
    """Frusta at the cameras of a run; a click on one takes its place."""

    def __init__(self, server: viser.ViserServer, cameras: Cameras, results: Results) -> None:
        self._server, self._cameras, self._results = server, cameras, results
        self.frusta: list[viser.CameraFrustumHandle] = []
        held = [kind for kind, name in _RESULTS.items() if not results.missing([name, "ingest"])]
        self._kind = server.gui.add_dropdown("Cameras", ("none", "outlines", *held))
        self._kind.on_update(lambda _: self._show())

    def _show(self) -> None:
        kind = self._kind.value
        pictures = self._pictures(kind) if kind in _RESULTS else {}
        with self._server.atomic():
            for frustum in self.frusta:
                frustum.remove()
            self.frusta = []
            if kind == "outlines" or pictures:
                self.frusta = add_views(self._server.scene, "/cameras", self._cameras, pictures)
        for view, frustum in enumerate(self.frusta):
            self._on_click(frustum, view)

    def _on_click(self, frustum: viser.CameraFrustumHandle, view: int) -> None:
        frustum.on_click(lambda event: self._stand_at(event.client, view))

    def _pictures(self, kind: str) -> dict[str, UInt8]:
        """Of each view, by its name."""
        if kind == "depth":
            return {one.name: depth_colors(one.depth)[0] for one in self._results.all("depth")}
        around = Around(self._results.all("ingest"))
        shown: list[Any] = list(around.frames) if kind == "photos" else self._results.all(_RESULTS[kind])
        return {one.name: view_picture(one, around) for one in shown}

    def _stand_at(self, client: viser.ClientHandle, view: int) -> None:
        from scipy.spatial.transform import Rotation

        camera = camera_of(self._cameras, view)
        with client.atomic():
            client.camera.wxyz = Rotation.from_matrix(camera.world_to_camera[:3, :3].T).as_quat(scalar_first=True)
            client.camera.position = camera.center
