"""How a command refuses: exit code 2, one sentence on stderr and nothing on stdout."""

from __future__ import annotations

import re
from pathlib import Path

from tiny_runs import Called


def assert_refused(called: Called, names: str) -> None:
    assert called.code == 2, called
    # On a busy machine a step before may have taken so long that it is told of.
    assert not re.sub(r"^done .*\n", "", called.out, flags=re.MULTILINE), called.out
    assert "Traceback" not in called.err, called.err
    assert re.fullmatch(r"ss-flow: [^\n]+[.?]\n", called.err), called.err
    assert re.search(names, called.err), called.err


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def file(path: Path, answer: Path | None = None) -> Path:
    path.write_text("hello")
    return answer or path
