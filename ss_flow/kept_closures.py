"""Code closures kept in a folder, so that not every process walks through the same sources.

A closure is worked out anew as soon as anything that it was read from has another content: a source of ours, a native
one, a module that was looked for and is there now, the analysis itself, Python's version; and when a module whose
version counted is held by no distribution any more, or by an editable one, so that its code is to count. The sources
are read each time, which takes milliseconds; it is their syntax trees that take a second. No time of change is trusted.

Notes
-----
*Concurrent writers.* Each writes whole files by rename, the same bytes from the same sources.

*Damage* is noticed by the digest in the first line. *A full disk, a store that was moved away*: what cannot be kept is
worked out again.
"""

from __future__ import annotations

import contextlib
import json
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

from blake3 import blake3

from ss_flow import at_load, closure, code_text, sources
from ss_flow.cache.files import read_checked, write_checked
from ss_flow.closure import ENGINE, Closure, closure_of, reading
from ss_flow.sources import is_loose, source_digest

_READERS = (at_load.__file__, closure.__file__, code_text.__file__, sources.__file__)
_ANALYSIS = b"".join(Path(file).read_bytes() for file in _READERS)
_SIGNS = {"python": platform.python_version(), "analysis": blake3(_ANALYSIS).hexdigest()}
"""What a closure depends on besides what it is read from."""


def kept_closure(function: Callable[..., Any], folder: Path) -> Closure:
    """What `closure_of` says, from the folder where it holds that; it is kept there otherwise."""
    file = folder / f"{function.__module__}-{function.__qualname__}.txt"
    with reading:
        known = _read(file)
        if known is not None and (function.__module__.startswith(f"{ENGINE}.") or not _is_loose_by_now(known)):
            return known
        found = closure_of(function)
    content = {**_SIGNS, **vars(found), "modules": sorted(found.modules)}
    text = json.dumps(content, separators=(",", ":"))
    with contextlib.suppress(OSError):
        folder.mkdir(exist_ok=True)
        write_checked(file, text)
    return found


def _read(file: Path) -> Closure | None:
    """The closure in a file, if it still holds."""
    if (text := read_checked(file)) is None:
        return None
    content = json.loads(text)
    if any(content[name] != value for name, value in _SIGNS.items()):
        return None
    if any(source_digest(name) != known for name, known in content["sources"].items()):
        return None
    return Closure(content["definitions"], frozenset(content["modules"]), content["sources"])


def _is_loose_by_now(known: Closure) -> bool:
    """Whether a module is to be followed of which only the version counted."""
    return any(is_loose(name) and name not in known.sources for name in known.modules)
