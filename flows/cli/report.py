"""`ss-flow report`: the report of a finished run, written anew."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from ss_flow.flows.cli.context import InStore, OptionalPath, StoreOptions, console, open_run
from ss_flow.flows.cli.diff import changes, difference
from ss_flow.flows.deliver import renew_size, write_report
from ss_flow.tasks.deliver.output import check_file
from ss_flow.tasks.deliver.report import Comparison

_SHOWN = ("ingest", "dense", "propagate", "hierarchy", "refine", "report_pictures", "thumbnails")


@dataclass(frozen=True)
class WriteReport:
    """Write the report of a result anew, from what the store holds of it; nothing is computed."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    beside: OptionalPath = None
    """That of another run, to compare with, as `ss-flow diff` does."""
    store: InStore = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        run = open_run(self.result, self.store, _SHOWN)
        file = self.result / "report.html"
        check_file(file, "change who may write there")
        comparison = None if self.beside is None else _comparison(self.beside, self.result)
        write_report(file, run.results, run.document, run.instances, comparison)
        renew_size(self.result, file.name)
        console(json=False).print(escape(str(file)))
        return 0


def _comparison(other: Path, result: Path) -> Comparison:
    found = difference(other, result)
    objects = found["instances"]
    return Comparison(
        other.resolve().name,
        found["params"] | found["models"],
        found["metrics"],
        None if objects is None else objects["agreement"],
        () if objects is None else changes(objects),
    )
