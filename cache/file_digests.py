"""Digests of input files, remembered by what `stamp` says of them, so that a file is read once.

Notes
-----
*Concurrent writers.* Each saves the whole table by rename; what the table that was replaced knew besides is read again.

*A damaged table* is noticed by its own digest, and the files are read again; as they are when the table cannot be read
or written: no command ends because of it.

*A file changed within the clock's resolution, at equal size*, is missed; `verify=True` reads every file again.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from ss_flow.cache.canonical import digest_file
from ss_flow.cache.files import read_checked, stamp, write_checked

T = TypeVar("T")


class FileDigests:
    """The remembered digests of one store. What was learnt in a `with` block is saved at its end, as by `save`."""

    def __init__(self, table: Path, *, verify: bool = False) -> None:
        self._table = table
        self._verify = verify
        self._changed = False
        self._known: dict[str, list[object]] = json.loads(read_checked(table) or "{}")

    def __enter__(self) -> FileDigests:
        return self

    def __exit__(self, *_: object) -> None:
        self.save()

    def __call__(self, path: Path) -> str:
        """The blake3 digest of a file. Raises OSError when it cannot be read."""
        place = os.path.abspath(path)
        now: list[object] = [*stamp(place)]
        known = self._known.get(place)
        if known is not None and known[0] == now and not self._verify:
            return str(known[1])
        content = digest_file(place)
        if [*stamp(place)] == now:  # else it is what a file held that was being written
            self._known[place] = [now, content]
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
        """Write the table, if anything was learnt, without the files of folders that are gone."""
        if self._changed:
            # Folders, not files: on a network's disk it would take long to ask for hundreds of thousands.
            there = functools.cache(os.path.isdir)
            known = {name: of for name, of in self._known.items() if not of or there(os.path.dirname(name))}
            write_checked(self._table, json.dumps(known))
            self._changed = False
