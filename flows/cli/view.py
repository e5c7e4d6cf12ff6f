"""`ss-flow view`: a finished run in the browser."""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape

from ss_flow.errors import InputError
from ss_flow.flows.cli.context import OptionalPath, StoreOptions, choose_model, console, file_digests, open_run
from ss_flow.flows.cli.query import encoder_name, query_params
from ss_flow.flows.results import FinishedRun, read_run

if TYPE_CHECKING:
    from ss_flow.flows.view.search import Search


@dataclass(frozen=True)
class View:
    """Look at a finished run in the browser, and change it."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run, or of an edit."""
    script: OptionalPath = None
    """The edit script to go on with and to save; by default NAME.edit.json beside the output folder."""
    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 lets other machines in who know the token."""
    port: int = 8080
    """The port to listen on; the next free one where it is taken."""
    store: tyro.conf.OmitArgPrefixes[StoreOptions] = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        if find_spec("viser") is None:
            raise InputError("the viewer needs a package that is not installed; run `pip install 'ss-flow[view]'`.")
        if not 0 <= self.port < 65536:
            raise InputError(f"--port {self.port} is out of range; it must be from 0 to 65535.")
        from ss_flow.flows.view.session import read_operations
        from ss_flow.flows.view.viewer import Viewer

        document = read_run(self.result)
        edit = document.get("edit")
        run = open_run(Path(edit["source"]) if edit else self.result, self.store, ("scene", "cameras"))
        script = self.script or self.result.resolve().with_name(f"{self.result.resolve().name}.edit.json")
        operations = edit["script"]["operations"] if edit else []
        if script.is_file():
            operations = read_operations(script)
        out = console(json=False)
        try:
            search = search_of(run)
        except InputError as error:  # one sees a scene without it
            search = None
            out.print(f"The search box stays empty: {escape(str(error))}")
        viewer = Viewer(run, script, operations, search, host=self.host, port=self.port)
        out.print(
            f"{viewer.address}\nCtrl-C ends it. Edits are saved in {escape(str(script))} ({len(operations)} so far)."
        )
        try:
            viewer.load_pictures()
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            if viewer.panel.unsaved:
                out.print("The last edits were not saved.")
        finally:
            viewer.close()
        return 0


def search_of(run: FinishedRun) -> Search | None:
    """What answers the search box; None where the run has no descriptors.

    Raises InputError when the network that described the instances is not on this machine.
    """
    from ss_flow.flows.view.search import Search

    if run.results.missing(("describe",)):
        return None
    digests = file_digests(run.store)
    encoder = choose_model("text-image", encoder_name(run.store, run.results.digests["describe"]), digests)
    digests.save()
    return Search(tuple(run.results.all("describe")), query_params(run.document), encoder)
