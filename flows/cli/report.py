"""`ss-flow report`: the report of a finished run, written anew."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from ss_flow.errors import InputError
from ss_flow.flows.cli.context import StoreOptions, console
from ss_flow.flows.cli.query import read_json, read_run
from ss_flow.flows.deliver import Results, write_report


@dataclass(frozen=True)
class WriteReport:
    """Write the report of a result anew, from what the store holds of it; nothing is computed."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    store: tyro.conf.OmitArgPrefixes[StoreOptions] = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        document = read_run(self.result)
        instances = read_json(self.result / "instances.json")
        own = self.store if self.store.cache else StoreOptions(document["store"])
        results = Results(own.existing_store(), document["results"])
        if missing := results.missing():
            raise InputError(
                f"the store {results.store.location} no longer holds all of {self.result} ({', '.join(missing)}); "
                "run the scene again."
            )
        file = self.result / "report.html"
        write_report(file, results, document, instances)
        console(json=False).print(escape(str(file)))
        return 0
