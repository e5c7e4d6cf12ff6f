"""The command line: `ss-flow COMMAND ...`.

Exit codes: 0 done, 1 failed, 2 bad usage or bad input, 3 done but degraded, 130 interrupted.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import io
import os
import signal
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

# Tasks run side by side, one a core: a library that starts threads of its own only gets in their way. To be set
# before the first of them is imported.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
# Of a damaged video FFmpeg writes thousands of lines; -8 = none. Read by OpenCV when it opens its first video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

from ss_flow.cache.errors import Gone, StoreFailure  # noqa: E402
from ss_flow.errors import ExecutorLost, InputError, OutputFailure  # noqa: E402

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130


def main(arguments: list[str], interrupted: Callable[[], object] = lambda: None) -> int:
    """Run one command; return the exit code. interrupted: called first thing after an interrupt."""
    if arguments == ["--version"]:
        from importlib.metadata import version

        print(f"ss-flow {version('ss-flow')}")
        return 0
    try:
        if not arguments:
            from ss_flow.flows.cli.start import next_steps

            print(next_steps(Path.cwd()))
            return BAD_INPUT
        return int(_read(arguments).run())
    except InputError as error:
        _complain(str(error))
        return BAD_INPUT
    except KeyboardInterrupt:
        interrupted()
        _complain("interrupted; what was finished is kept, and the next run goes on from it.", style="yellow")
        return INTERRUPTED
    except Gone as error:
        _complain(f"{error}; run the scene again, which computes it anew.")
        return FAILED
    except (StoreFailure, OutputFailure, ExecutorLost) as error:
        _complain(str(error))
        return FAILED
    except BrokenPipeError:
        return 0
    except PermissionError as error:
        _complain(f"{error.filename or error}: permission denied; change who may read or write it, or name another.")
        return BAD_INPUT
    except Exception as error:
        if os.environ.get("SS_FLOW_DEBUG"):
            raise
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            _complain(
                f"the output cannot be written: {error.strerror}; what was computed is kept, run again with room."
            )
        else:
            _complain(f"failed: {type(error).__name__}: {error}", "Set SS_FLOW_DEBUG=1 to see where.")
        return FAILED


def _read(arguments: list[str]) -> Any:
    """The command that the arguments call. Raises InputError about a word that nobody knows."""
    # Not above: an interrupt while these load, which takes longest, ends as any other.
    import tyro

    from ss_flow.flows.cli.commands import chosen

    def read(arguments: list[str], **more: Any) -> Any:
        return tyro.cli(
            chosen(arguments),
            prog="ss-flow",
            description="From a capture to instance-labelled 3D Gaussians; nothing is computed twice. "
            "`ss-flow demo` shows it on a room of its own, `ss-flow run PATH` takes yours.",
            args=arguments,
            config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
            **more,
        )

    if {"-h", "--help"} & set(arguments) or arguments[0].startswith("--tyro"):
        return read(arguments)
    left: list[str] = []
    with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()):
        command, left = read(arguments, return_unknown_args=True)
        if not left:
            return command
    from ss_flow.flows.cli.unknown import refuse_unknown

    refuse_unknown(arguments, left, read)
    return read(arguments)  # says what else is wrong, and exits


def _complain(problem: str, *more: str, style: str = "red") -> None:
    from rich.markup import escape

    from ss_flow.flows.cli.context import console

    errors = console(json=True)
    for line in (f"[{style}]ss-flow:[/] {escape(problem)}", *more):
        errors.print(line)


def _written_out(stream: TextIO) -> None:
    """Write what is left for a stream; where its reader has gone, it is for nobody."""
    try:
        stream.flush()
    except BrokenPipeError:
        from ss_flow.flows.cli.context import silence

        silence(stream)


class _Screen(io.FileIO):
    """A terminal. When it is closed, what is written to it goes nowhere, also what native code writes."""

    def write(self, content: Any, /) -> int:
        try:
            return super().write(content)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            return super().write(content)


def _open_streams() -> None:
    """Have the three streams lead somewhere: a file that is opened later must not get the place of a closed one."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it gets the lowest free number, this one
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(number, "w", closefd=False))  # noqa: SIM115 - it stays open
            continue
        if stream.errors == "strict":  # a sign that the terminal lacks is no reason to end
            stream.reconfigure(errors="backslashreplace")
        if stat.S_ISCHR(os.fstat(number).st_mode):  # one that was closed just now says that it is none
            screen = io.BufferedWriter(_Screen(number, "w", closefd=False))
            setattr(sys, name, io.TextIOWrapper(screen, stream.encoding, stream.errors, line_buffering=True))


def _hung_up(*_: object) -> None:
    """The terminal was closed: as after Ctrl-C, and once, since both the shell and the system may tell."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    raise KeyboardInterrupt


def _end_undisturbed() -> None:
    """After Ctrl-C another one has nothing to stop, but would cut off the last words."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def entry() -> None:
    """The console script."""
    if os.name == "nt":
        raise SystemExit("ss-flow runs on Linux and macOS; on Windows use it inside WSL.")
    _open_streams()
    # A cluster's queue stops a job with SIGTERM: the run then keeps what it has, as after Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:  # not after `nohup`
        signal.signal(signal.SIGHUP, _hung_up)
    # Hardly anything here is in a cycle: search for cycles less often than after every 700 objects more.
    gc.set_threshold(20_000)
    try:
        code = main(sys.argv[1:], _end_undisturbed)
    finally:
        _written_out(sys.stdout)
        _written_out(sys.stderr)
    if code == INTERRUPTED:
        os._exit(code)  # a task in the middle of native code cannot be told to stop; the store is safe
    sys.exit(code)
