"""A prefix of a bucket in an object store (S3, Google Cloud Storage, Azure), through `obstore`.

Credentials and the endpoint are the environment's (`AWS_ACCESS_KEY_ID`, `AWS_ENDPOINT_URL`, ...).

Notes
-----
*Concurrent readers.* A file appears whole or not at all.

*Network.* A request that fails for a passing reason is tried again for about half a minute; after that, and for want of
permission, StoreFailure says so.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

from ss_flow.cache.errors import StoreFailure

T = TypeVar("T")

AT_ONCE = 8
"""How many files of one object travel at the same time."""
FIRST_PAUSE = timedelta(seconds=0.1)
"""Before a request is tried again; each further pause is twice as long."""
RETRIES: Any = {"max_retries": 8, "retry_timeout": timedelta(minutes=1), "backoff": {"init_backoff": FIRST_PAUSE}}
_CUT = re.compile("response body|list response")
"""In what the library says of an answer that was cut."""
_LOCATION = re.compile(r"(s3|gs|az)://[^/\s]+(/\S*)?")


@dataclass(frozen=True)
class Meta:
    """What a bucket says of a file."""

    name: str
    bytes: int
    written: float
    """In seconds since 1970, by the bucket's clock (S3 gives whole seconds)."""
    version: dict[str, str]
    """Changes whenever the file is written with another content."""


class Bucket:
    """The files whose names begin with a prefix. Names are relative to it; all methods raise StoreFailure.

    Raises ValueError, with a sentence for the user, for a location that is none, or when `obstore` is not installed.
    """

    def __init__(self, location: str) -> None:
        if re.search("[@?#]", location):
            raise ValueError(
                "the location of a store is scheme, bucket and prefix alone; "
                "credentials belong into the environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, ...)."
            )
        if not _LOCATION.fullmatch(location):
            raise ValueError(
                f"{location} is no place for a store; name a folder, or s3://BUCKET/PREFIX (gs://, az://)."
            )
        self.location = location.rstrip("/")
        try:
            from obstore.store import from_url
        except ImportError:
            raise ValueError(f"the store {location} needs obstore; run `pip install 'ss-flow[s3]'`.") from None
        with self._reaching():
            self._store: Any = from_url(self.location, retry_config=RETRIES)

    def get(self, name: str) -> tuple[bytes, Meta] | None:
        """A file's content; None when it is not there."""
        with self._reaching(), contextlib.suppress(FileNotFoundError):
            found = _insist(self._store.get, name)
            return bytes(found.bytes()), _meta(name, found.meta)
        return None

    def blocks(self, name: str) -> Iterator[bytes]:
        """A file's content, piece by piece; nothing when it is not there."""
        with self._reaching(), contextlib.suppress(FileNotFoundError):
            yield from _insist(self._store.get, name).stream()

    def head(self, name: str) -> Meta | None:
        """What is said of a file; None when it is not there."""
        with self._reaching(), contextlib.suppress(FileNotFoundError):
            return _meta(name, _insist(self._store.head, name))
        return None

    def files(self, folder: str) -> list[Meta]:
        """All files below a folder."""
        with self._reaching():
            pages = _insist(lambda: list(self._store.list(folder, chunk_size=1000)))
        return [_meta(said["path"], said) for some in pages for said in some]

    def folders(self, folder: str) -> list[str]:
        """The names of the folders in a folder."""
        with self._reaching():
            found = _insist(self._store.list_with_delimiter, folder)
        return [path.rpartition("/")[2] for path in found["common_prefixes"]]

    def put(self, name: str, content: bytes | Path) -> None:
        """Write a file; one of that name is replaced."""
        with self._reaching():
            _insist(self._store.put, name, content)

    def create(self, name: str, content: bytes | Path) -> bool:
        """Write a file; False when one of that name is there already."""
        from obstore.exceptions import AlreadyExistsError

        with self._reaching():
            try:
                _insist(self._store.put, name, content, mode="create")
            except AlreadyExistsError:
                return False
        return True

    def replace(self, seen: Meta, content: bytes) -> bool:
        """Replace a file that is still the version that was seen; False when it is not."""
        from obstore.exceptions import PreconditionError

        with self._reaching():
            try:
                _insist(self._store.put, seen.name, content, mode=seen.version)
            except (PreconditionError, FileNotFoundError):
                return False
        return True

    def delete(self, names: Iterable[str]) -> None:
        """Delete files, where they are there."""
        with self._reaching(), contextlib.suppress(FileNotFoundError):
            _insist(self._store.delete, [*names])

    def each(self, action: Callable[[T], object], items: Iterable[T]) -> None:
        """Do something for several files at once. Raises what the first of them raised, when all have ended."""
        items = list(items)
        if not items:
            return
        with ThreadPoolExecutor(AT_ONCE, thread_name_prefix="bucket") as pool:
            list(pool.map(action, items))

    @contextlib.contextmanager
    def _reaching(self) -> Iterator[None]:
        from obstore.exceptions import BaseError

        try:
            yield
        except (BaseError, OSError) as error:
            raise StoreFailure(
                f"the store {self.location} cannot be used: {_reason(error)}. What was finished is kept: when network "
                "and permissions allow, run again to go on."
            ) from error


def _insist(request: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Make a request; again where its answer was cut, which the library does not do for listings and refusals."""
    from obstore.exceptions import GenericError

    last = time.monotonic() + RETRIES["retry_timeout"].total_seconds()
    pause = FIRST_PAUSE.total_seconds()
    for _ in range(RETRIES["max_retries"]):
        try:
            return request(*arguments, **options)
        except GenericError as error:
            if not _CUT.search(str(error)) or time.monotonic() > last:
                raise
        time.sleep(pause)
        pause *= 2
    return request(*arguments, **options)


def _meta(name: str, said: Any) -> Meta:
    version = {part: said[part] for part in ("e_tag", "version") if said[part]}
    return Meta(name, said["size"], said["last_modified"].timestamp(), version)


def _reason(error: Exception) -> str:
    """The part of an error that a user can do something about."""
    text = str(error).partition("\n\nDebug source")[0]
    if "/latest/api/token" in text or "/latest/meta-data" in text:  # the last place where credentials are looked for
        return "there are no credentials (AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY)"
    said = re.search("<Message>(.*?)</Message>", text, re.DOTALL)
    return (said[1] if said else text.rpartition(" - ")[2].partition("\n")[0]).strip().rstrip(".")
