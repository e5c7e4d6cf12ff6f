"""Digests of input files, remembered by size, modification time and inode, so that a file is read once.

Notes
-----
*Concurrent writers.* Each saves the whole table by rename; what the loser had learnt is learnt again.

*A file changed within the clock's resolution, at equal size*, is missed; `verify=True` reads every file again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from ss_flow.cache.canonical import digest_file
from ss_flow.cache.store import write_atomically

T = TypeVar("T")


class FileDigests:
    """The remembered digests of one store. Call `save` when done."""

    def __init__(self, table: Path, *, verify: bool = False) -> None:
        self._table = table
        self._verify = verify
        self._changed = False
        try:
            self._known: dict[str, list[object]] = json.loads(table.read_text())
        except (FileNotFoundError, ValueError):
            self._known = {}

    def __call__(self, path: Path) -> str:
        """The blake3 digest of a file. Raises OSError when it cannot be read."""
        path = path.resolve()
        status = path.stat()
        stamp: list[object] = [status.st_size, status.st_mtime_ns, status.st_ino]
        known = self._known.get(str(path))
        if known is not None and known[:3] == stamp and not self._verify:
            return str(known[3])
        content = digest_file(path)
        self._known[str(path)] = [*stamp, content]
        self._changed = True
        return content

    def once(self, check: Callable[[T], None], subject: T, contents: Sequence[str]) -> None:
        """Check files' contents, unless that passed for the same ones before. What `check` raises passes through."""
        name = f"checked {' '.join(contents)}"
        if name not in self._known or self._verify:
            check(subject)
            self._known[name] = []
            self._changed = True

    def save(self) -> None:
        if self._changed:
            write_atomically(self._table, json.dumps(self._known, separators=(",", ":")))
            self._changed = False
