"""`ss-flow report`: the report of a finished run, written anew."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from ss_flow.flows.cli.context import StoreOptions, console, open_run
from ss_flow.flows.deliver import write_report

_SHOWN = ("ingest", "dense", "propagate", "hierarchy", "refine", "report_pictures", "thumbnails")


@dataclass(frozen=True)
class WriteReport:
    """Write the report of a result anew, from what the store holds of it; nothing is computed."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    store: tyro.conf.OmitArgPrefixes[StoreOptions] = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        run = open_run(self.result, self.store, _SHOWN)
        file = self.result / "report.html"
        write_report(file, run.results, run.document, run.instances)
        console(json=False).print(escape(str(file)))
        return 0
