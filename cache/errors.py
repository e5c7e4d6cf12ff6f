"""What can go wrong with a store."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path


class StoreFailure(OSError):
    """The store cannot be used any more; says why, and what to do."""


class Gone(LookupError):
    """An object that the store was said to hold is not there, or was damaged and has been taken out."""

    def __init__(self, object_digest: str, reason: str) -> None:
        super().__init__(object_digest, reason)
        self.digest, self.reason = object_digest, reason

    def __str__(self) -> str:
        return f"object {self.digest[:12]} {self.reason}"


class OtherVersion(Gone):
    """An object that is whole, but whose type has other fields here, or is not to be found. It stays in the store."""

    def __str__(self) -> str:
        return f"object {self.digest[:12]} was stored by other code than is here: {self.reason}"


@contextlib.contextmanager
def writing(root: Path) -> Iterator[None]:
    """Within this, an OSError becomes the StoreFailure of the store in this folder."""
    try:
        yield
    except StoreFailure:
        raise
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):
            reason, want = error.strerror, "more files may be open (`ulimit -n` tells how many may)"
        else:
            reason = _reason(error) if (root / "tmp").is_dir() else "it has vanished"
            want = "there is room (`ss-flow cache gc` makes some) and permission"
        raise StoreFailure(
            f"the store {root} cannot be written: {reason}. What was finished is kept: when {want}, run again to go on."
        ) from error


@contextlib.contextmanager
def reading(root: Path) -> Iterator[None]:
    """The same for what only reads: what cannot be read now may be whole, and stays."""
    try:
        yield
    except StoreFailure:
        raise
    except OSError as error:
        raise StoreFailure(f"the store {root} cannot be read: {_reason(error)}; nothing was lost.") from error


def _reason(error: OSError) -> str:
    """Why, in words; of what another user keeps from this one, which file, and what to do."""
    words, file = error.strerror or str(error), error.filename2 or error.filename
    if isinstance(error, PermissionError) and file is not None:
        return f"{words} for {file}, whose owner can allow it with `chmod -R g+rwX` (docs/clusters.md)"
    return words
