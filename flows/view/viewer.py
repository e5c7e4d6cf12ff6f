"""The interactive viewer of a finished run, put together."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from ss_flow.flows.results import FinishedRun
from ss_flow.flows.view.camera_views import CameraViews
from ss_flow.flows.view.corrections import Corrections
from ss_flow.flows.view.looking import look_from, start_view
from ss_flow.flows.view.panel import Panel
from ss_flow.flows.view.search import Search
from ss_flow.flows.view.server import start
from ss_flow.flows.view.session import Operation, Session
from ss_flow.flows.view.timeline import add_timeline


class Viewer:
    """A server that shows a run; it runs until it is closed."""

    def __init__(
        self,
        run: FinishedRun,
        script: Path,
        operations: Sequence[Operation] = (),
        search: Search | None = None,
        hints: Path | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        draw_at_most: int | None = None,
    ) -> None:
        """run: with the results "scene" and "cameras". script: the file to save to. operations: those to begin with.
        search: None where the run cannot be searched. hints: the file that corrections are saved to; None = none are
        picked. host, port: where to listen. draw_at_most: as for `Panel`.

        Raises InputError for an operation that is refused, and when it cannot listen there.
        """
        scene, cameras = run.results.one("scene"), run.results.one("cameras")
        session = Session(scene, run.instances, script.parent, operations, cameras, run.store)
        self._run = run
        self.server, self.address = start(host, port, run.name)
        look_from(self.server, start_view(cameras, scene.means))
        corrections = None if hints is None else partial(Corrections, run, hints)
        self.panel = Panel(self.server, cameras, session, script, search, corrections, draw_at_most)
        self.cameras = CameraViews(self.server, cameras, run.results)

    def add_timeline(self, beside: FinishedRun | None = None) -> None:
        """Add the slider over the stages of the run; while one is looked at, the objects are hidden.

        beside: another run of the same capture, to show to the right of this one.
        Raises InputError when nothing of the run is left in the store.
        """

        def shown(is_now: bool) -> None:
            for name in ("/objects", "/selected"):
                if (node := self.server.scene.get_handle_by_name(name)) is not None:
                    node.visible = is_now

        self.timeline = add_timeline(self.server, self._run, shown, beside, self.panel.nodes.share)

    def load_pictures(self) -> None:
        """Give the objects in the list their pictures; this may take a while, where the run kept none."""
        self.panel.objects.set_pictures({one.instance_id: one.content for one in self._run.results.thumbnails()})

    def close(self) -> None:
        """Stop serving."""
        self.server.stop()
