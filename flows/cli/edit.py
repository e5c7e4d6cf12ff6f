"""`ss-flow edit`: change a finished scene by a script."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape

from ss_flow.cache.plain_json import read_json
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import InStore, StoreOptions, console, open_run
from ss_flow.flows.cli.prepare import display


@dataclass(frozen=True)
class EditRun:
    """Change a finished scene by a script: remove, move, recolour, replace its objects."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    script: Annotated[Path, tyro.conf.Positional]
    """The operations (.json), see docs/editing.md."""
    out: Path
    """The folder to write."""
    jobs: int = 0
    """How many tasks may run at once; 0 = one a core."""
    json: bool = False
    """Print one JSON document on stdout, and nothing else there."""
    store: InStore = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        from ss_flow.flows.edit import open_edit, run_edit

        if self.jobs < 0:
            raise InputError(f"--jobs {self.jobs} is out of range; it must be 0 (one a core) or more.")
        store = open_run(self.result, self.store, ()).store
        edit = open_edit(self.result, _read_script(self.script), store, self.script.parent)
        out = console(json=self.json)
        with display(out) as screen:
            document = run_edit(edit, store, self.out, reporter=screen, jobs=self.jobs)
        if self.json:
            print(json.dumps(document))
        else:
            _tell(document, self.out, out)
        return 0


def _read_script(file: Path) -> Any:
    try:
        return read_json(file.read_text(encoding="utf-8-sig"), once=True)
    except OSError as error:
        raise InputError(f"the edit script {file} cannot be read: {error.strerror}.") from None
    except ValueError as error:
        raise InputError(f"the edit script {file} is not JSON: {error}.") from None


def _tell(document: dict[str, Any], folder: Path, out: Console) -> None:
    for warning in document["warnings"]:
        out.print(f"[yellow]warning[/] {escape(warning['label'])}: {escape(warning['text'])}")
    for hole in document["edit"]["holes"]:
        out.print(
            f"operation {hole['operation']}: of {hole['pixels']} pixels in {hole['views']} views, "
            f"{hole['unmeasured']} have nothing measured behind them, {hole['empty']} are empty"
            + (f"; after filling {hole['open_after_filling']} are still open" if "open_after_filling" in hole else "")
            + (f"; {hole['cleared']} Gaussians that no view had shaped went too" if hole.get("cleared") else "")
        )
    hits = sum(node["hit"] for node in document["nodes"])
    out.print(escape(f"ok: {len(document['nodes']) - hits} results computed, {hits} reused; see {folder}"))
