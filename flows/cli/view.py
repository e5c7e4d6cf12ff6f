"""`ss-flow view`: a finished run in the browser."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape

from ss_flow.errors import InputError
from ss_flow.flows.cli.context import (
    InStore,
    OptionalCount,
    OptionalPath,
    StoreOptions,
    console,
    open_run,
)
from ss_flow.flows.cli.query import encoder_of, query_params
from ss_flow.flows.results import FinishedRun, read_run, run_command, source_of
from ss_flow.tasks.deliver.output import RUN_FILE, check_named
from ss_flow.tasks.words import size_in_words

if TYPE_CHECKING:
    from ss_flow.flows.view.search import Search


_MANY, _FEW = 50_000, 30_000
"""Gaussians that a browser without a GPU takes long to draw, and so many that it does not."""


@dataclass(frozen=True)
class View:
    """Look at a finished run, or at any cached result of one, in the browser; a run can be changed there."""

    what: Annotated[str, tyro.conf.Positional]
    """The output folder of a run, or of an edit; or a step (propagate, segment[0003]) of the latest run that got to it,
    or the first characters of a digest."""
    script: OptionalPath = None
    """The edit script to go on with and to save; by default NAME.edit.json beside the output folder."""
    correct: OptionalPath = None
    """The file that points picked on joined or broken things are saved to, for `ss-flow run --correct`; by default
    NAME.hints.json beside the output folder. What it holds is gone on with."""
    beside: OptionalPath = None
    """The output folder of another run of the same capture, to stand to the right of this one in the time line."""
    html: OptionalPath = None
    """Write a page to this file instead, which needs neither this program nor a network."""
    rerun: OptionalPath = None
    """Write a recording for Rerun (.rrd) to this file instead."""
    draw_at_most: OptionalCount = None
    """Draw about so many Gaussians, chosen by lot and enlarged to cover as much, for a browser that has no GPU to draw
    with; clicks and edits mean all of them."""
    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 lets other machines in who know the token."""
    port: int = 8080
    """The port to listen on; the next free one where it is taken."""
    store: InStore = StoreOptions()
    """Where results are kept; by default, of an output folder, the store that its run names."""

    def run(self) -> int:
        if not 0 <= self.port < 65536:
            raise InputError(f"--port {self.port} is out of range; it must be from 0 to 65535.")
        if self.draw_at_most is not None and (self.draw_at_most < 1 or self.html or self.rerun):
            raise InputError("--draw-at-most takes a number above 0, and is for the viewer, not for --html or --rerun.")
        for option, file in (("--html", self.html), ("--rerun", self.rerun)):
            if file and not file.absolute().parent.is_dir():
                raise InputError(f"{file} cannot be written; {option} must name a file in a folder that exists.")
            if file:
                check_named(file, option)
        folder = Path(self.what)
        if not folder.exists() and "/" not in self.what:
            return self._artifact()
        if self.html or self.rerun:
            if self.beside or self.script or self.correct:
                raise InputError("--beside, --script and --correct are for the viewer, not for --html or --rerun.")
            return self._files(folder)
        return self._viewer(folder)

    def _artifact(self) -> int:
        """One cached result, the way that suits it."""
        if self.rerun or self.beside or self.script or self.correct:
            raise InputError(
                f"--rerun, --beside, --script and --correct take the output folder of a run, and {self.what} is none."
            )
        from ss_flow.flows.cli.inspect import latest_run, not_latest, results_named
        from ss_flow.flows.describe import maker, told
        from ss_flow.flows.view.artifact import Around, around_of, placed, show, write_artifact_page
        from ss_flow.tasks.artifacts import Gaussians

        out, store = console(json=False), self.store.existing_store()
        run, digests, asked = results_named(store, None, self.what)
        if run and (other := not_latest(run, latest_run(store, None))):
            out.print(escape(other))
        values = [store.get(digest) for digest in digests]
        made = maker(store, digests[0], run, asked)
        around = around_of(store, made[0]) if made else Around()
        if self.draw_at_most:
            count = sum(len(value) for value in values if isinstance(value, Gaussians))
            around = replace(around, share=min(1.0, self.draw_at_most / max(count, 1)))
        if self.html:
            write_artifact_page(self.html, self.what, digests, store, around, run, asked)
            out.print(escape(str(self.html)))
        elif placed(values, around) and find_spec("viser"):
            from ss_flow.flows.view.server import start

            server, address = start(self.host, self.port, self.what)
            show(server, values, around)
            with _ctrl_c_put_off() as wait:
                out.print(f"{address}\nCtrl-C ends it.")
                wait()
            server.stop()
        else:
            for line in told(values, digests, store, run, asked):
                out.print(escape(line))
        return 0

    def _files(self, folder: Path) -> int:
        """Files that show a run without this program."""
        out = console(json=False)
        if self.rerun:  # first, since it may lack its package
            from ss_flow.flows.view import rerun_file

            rerun_file.write_recording(self.rerun, open_run(folder, self.store, rerun_file.SHOWN))
            out.print(escape(f"{self.rerun} ({size_in_words(self.rerun.stat().st_size)})"))
        if self.html:
            from ss_flow.flows.view import page

            page.write_page(self.html, open_run(folder, self.store, page.SHOWN))
            out.print(escape(f"{self.html} ({size_in_words(self.html.stat().st_size)})"))
        return 0

    def _viewer(self, folder: Path) -> int:
        if find_spec("viser") is None:
            raise InputError("the viewer needs a package that is not installed; run `pip install 'ss-flow[view]'`.")
        from ss_flow.flows.view.session import read_operations
        from ss_flow.flows.view.viewer import Viewer

        document = read_run(folder)
        edit = document.get("edit")
        source, remark = source_of(folder, document) if edit else (folder, "")
        if not (source / RUN_FILE).is_file() and edit:
            raise InputError(f"{folder} is an edited run, and its source, {source}, is not there; put it back.")
        run = open_run(source, self.store, ("scene", "cameras"))
        script = self.script or folder.resolve().with_name(f"{folder.resolve().name}.edit.json")
        hints = self.correct or run.folder.resolve().with_name(f"{run.name}.hints.json")
        operations = edit["script"]["operations"] if edit else []
        if script.is_file():
            operations = read_operations(script)
        out = console(json=False)
        if remark:
            out.print(f"[yellow]warning[/] {escape(f'{folder} is an edit of {source}, {remark}.')}")
        try:
            search = search_of(run)
        except InputError as error:  # one sees a scene without it
            search = None
            out.print(f"The search box stays empty: {escape(str(error))}")
        beside = open_run(self.beside, self.store, ("scene",)) if self.beside else None
        viewer = Viewer(
            run, script, operations, search, hints, host=self.host, port=self.port, draw_at_most=self.draw_at_most
        )
        viewer.add_timeline(beside)
        count = len(run.results.one("scene"))
        if self.draw_at_most is None and count > _MANY:
            out.print(
                f"The scene has {count:,} Gaussians. If the browser has no GPU: --draw-at-most {_FEW} draws fewer."
            )
        again = run_command(run.folder, run.document, correct=str(hints.absolute()))
        rest = "." if "set" in run.document else ", and the run's other options."
        saved = f"Edits are saved in {escape(str(script))} ({len(operations)} so far)."
        try:
            with _ctrl_c_put_off() as wait:
                out.print(f"{viewer.address}\nCtrl-C ends it. {saved}")
                out.print(f"Corrections are made by: {escape(again + rest)}")
                viewer.load_pictures()
                wait()
            if viewer.panel.unsaved:
                out.print("The last edits were not saved.")
        finally:
            viewer.close()
        return 0


@contextlib.contextmanager
def _ctrl_c_put_off() -> Iterator[Callable[[], object]]:
    """Yields what waits for Ctrl-C or SIGTERM. One that comes earlier counts there; a second one ends what is done.

    An exception out of nowhere could end a lock or a callback of the server halfway, or be lost in one.
    """
    asked = SimpleQueue[int]()  # whose `put`, unlike that of an event, may come in the middle of `get`

    def ask(number: int, _: object) -> None:
        if not asked.empty():
            raise KeyboardInterrupt
        asked.put(number)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with contextlib.suppress(KeyboardInterrupt):
            yield asked.get
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def search_of(run: FinishedRun) -> Search | None:
    """What answers the search box; None where the run has no descriptors.

    Raises InputError when the network that described the instances is not on this machine.
    """
    from ss_flow.flows.view.search import Search

    if run.results.missing(("describe",)):
        return None
    return Search(tuple(run.results.all("describe")), query_params(run.document), encoder_of(run))
