"""The command line: `ss-flow COMMAND ...`.

Exit codes: 0 done, 1 failed, 2 bad usage or bad input, 3 done but degraded, 130 interrupted.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from dataclasses import dataclass
from importlib.metadata import version
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape

# Tasks run side by side, one a core: a library that starts threads of its own only gets in their way. To be set
# before the first of them is imported.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

from ss_flow.cache.errors import StoreFailure  # noqa: E402
from ss_flow.errors import InputError  # noqa: E402
from ss_flow.executors import ExecutorLost  # noqa: E402
from ss_flow.flows.cli.batch import Batch  # noqa: E402
from ss_flow.flows.cli.care import CacheCollect, CacheUsage, CacheVerify  # noqa: E402
from ss_flow.flows.cli.diff import Diff  # noqa: E402
from ss_flow.flows.cli.edit import EditRun  # noqa: E402
from ss_flow.flows.cli.evaluate import Evaluate  # noqa: E402
from ss_flow.flows.cli.export import Export  # noqa: E402
from ss_flow.flows.cli.inspect import CacheList, CacheShow, Graph, Status, Why  # noqa: E402
from ss_flow.flows.cli.pins import CachePin, CacheUnpin  # noqa: E402
from ss_flow.flows.cli.query import Query  # noqa: E402
from ss_flow.flows.cli.render import Render  # noqa: E402
from ss_flow.flows.cli.report import WriteReport  # noqa: E402
from ss_flow.flows.cli.reproduce import Reproduce  # noqa: E402
from ss_flow.flows.cli.run import Demo, Run  # noqa: E402
from ss_flow.flows.cli.setup import Doctor, ModelsFetch, ModelsList, ModelsVerify  # noqa: E402
from ss_flow.flows.cli.sweep import Sweep  # noqa: E402

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130

_sub = tyro.conf.subcommand


@dataclass(frozen=True)
class Cache:
    """Look into the store, and take care of it."""

    command: (
        Annotated[CacheList, _sub("ls")]
        | Annotated[CacheShow, _sub("show")]
        | Annotated[CacheUsage, _sub("du")]
        | Annotated[CachePin, _sub("pin")]
        | Annotated[CacheUnpin, _sub("unpin")]
        | Annotated[CacheCollect, _sub("gc")]
        | Annotated[CacheVerify, _sub("verify")]
    )

    def run(self) -> int:
        return self.command.run()


@dataclass(frozen=True)
class Models:
    """The networks that can be used."""

    command: (
        Annotated[ModelsList, _sub("list")]
        | Annotated[ModelsFetch, _sub("fetch")]
        | Annotated[ModelsVerify, _sub("verify")]
    )

    def run(self) -> int:
        return self.command.run()


Command = tyro.conf.OmitSubcommandPrefixes[
    tyro.conf.FlagCreatePairsOff[
        Annotated[Demo, _sub("demo")]
        | Annotated[Run, _sub("run")]
        | Annotated[Sweep, _sub("sweep")]
        | Annotated[Batch, _sub("batch")]
        | Annotated[Status, _sub("status")]
        | Annotated[Why, _sub("why")]
        | Annotated[Graph, _sub("graph")]
        | Annotated[Diff, _sub("diff")]
        | Annotated[WriteReport, _sub("report")]
        | Annotated[Evaluate, _sub("eval")]
        | Annotated[Reproduce, _sub("reproduce")]
        | Annotated[Query, _sub("query")]
        | Annotated[Export, _sub("export")]
        | Annotated[Render, _sub("render")]
        | Annotated[EditRun, _sub("edit")]
        | Annotated[Cache, _sub("cache")]
        | Annotated[Models, _sub("models")]
        | Annotated[Doctor, _sub("doctor")]
    ]
]


def main(arguments: list[str]) -> int:
    """Run one command; return the exit code."""
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    if not arguments:
        with contextlib.suppress(SystemExit):
            main(["--help"])
        return BAD_INPUT
    if arguments == ["--version"]:
        print(f"ss-flow {version('ss-flow')}")
        return 0
    try:
        command: Any = tyro.cli(
            Command,
            prog="ss-flow",
            description="From a capture to instance-labelled 3D Gaussians; nothing is computed twice. "
            "`ss-flow demo` shows it on a room of its own, `ss-flow run PATH` takes yours.",
            args=arguments,
        )
        return int(command.run())
    except InputError as error:
        errors.print(f"[red]ss-flow:[/] {escape(str(error))}")
        return BAD_INPUT
    except KeyboardInterrupt:
        errors.print("[yellow]ss-flow: interrupted; what was finished is kept, and the next run goes on from it.[/]")
        return INTERRUPTED
    except (StoreFailure, ExecutorLost) as error:
        errors.print(f"[red]ss-flow:[/] {escape(str(error))}")
        return FAILED
    except BrokenPipeError:
        return 0
    except Exception as error:
        if os.environ.get("SS_FLOW_DEBUG"):
            raise
        errors.print(f"[red]ss-flow:[/] failed: {escape(f'{type(error).__name__}: {error}')}")
        errors.print("Set SS_FLOW_DEBUG=1 to see where.")
        return FAILED


def entry() -> None:
    """The console script."""
    # A cluster's queue stops a job with SIGTERM: the run then keeps what it has, as after Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    code = main(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    if code == INTERRUPTED:
        os._exit(code)  # a task in the middle of native code cannot be told to stop; the store is safe
    sys.exit(code)
