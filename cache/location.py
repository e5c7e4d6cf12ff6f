"""Where a store is, as text: a folder, or the URL of a bucket and a prefix."""

from __future__ import annotations

import re
from pathlib import Path

from ss_flow.cache.store import Store


def is_url(location: str | Path) -> bool:
    """Whether a location has a scheme, such as s3://."""
    return re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", str(location)) is not None


def open_store(location: str | Path) -> Store:
    """The store in a folder, created when absent, or in a bucket.

    Raises OSError when the folder cannot be created; ValueError, with a sentence for the user, for a URL that is not
    that of a store, or when the package `obstore` is not installed.
    """
    if is_url(location):
        from ss_flow.cache.remote import RemoteStore

        return RemoteStore(str(location))
    return Store(Path(location))
