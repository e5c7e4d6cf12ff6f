"""A store in a bucket, with a folder of this machine before it.

The bucket holds objects, actions, parts and claims, under the names that they have in a folder. The folder is a
store of its own: everything is written there first, and what was read once is there the next time. Runs, pins,
checkpoints and the digests of input files are in the folder alone.

Notes
-----
*Crash.* An object is there when its `zarr.json` is, which is written after its other files; what a cut upload left is
never read, and is written over or collected. The action comes after all of its objects.

*Concurrent writers.* Two that write the same object write the same content; a reader checks what it gets.

*Damage.* What is downloaded is checked before it gets its name here. A damaged copy here is downloaded again; what
arrives damaged twice is taken out of the bucket, and its maker runs again.

*Ages.* An object store cannot tell when something was used: in the bucket, the time of use is that of writing. What
this machine uses, it remembers in its folder.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ss_flow.cache.bucket import Bucket
from ss_flow.cache.canonical import DIGEST, digest
from ss_flow.cache.claims import Claims, Seen
from ss_flow.cache.errors import Gone, writing
from ss_flow.cache.files import remove, rename_folder, user_cache
from ss_flow.cache.store import GRACE_SECONDS, Action, Entry, Store

MANIFEST = "zarr.json"
"""The file of an object that is written last, and deleted first."""
CLOCK = "clock"
"""An empty file that is written to learn the time by the bucket's clock."""
_OF_OBJECT = re.compile(rf"objects/../(?P<digest>{DIGEST.pattern})/(?P<file>.+)")
_FILE = re.compile(r"\w[\w.]*(/\w[\w.]*)*")


class RemoteStore(Store):
    """A store in a bucket.

    location: such as s3://bucket/prefix. folder: where this machine keeps its copies; by default one in the user's
    cache folder. Both are created when absent, the bucket itself is not.

    Raises ValueError, with a sentence for the user, for a location that is none, or when `obstore` is not installed;
    OSError when the folder cannot be created. All methods raise StoreFailure when the bucket cannot be used.
    """

    def __init__(self, location: str, folder: Path | None = None) -> None:
        self._bucket = Bucket(location)
        self._known: set[str] = set()
        super().__init__(folder or default_folder(self.location))

    @property
    def location(self) -> str:
        return self._bucket.location

    def open_claims(self) -> Claims:
        return Claims(_BucketClaims(self._bucket))

    def __contains__(self, object_digest: str) -> bool:
        return super().__contains__(object_digest) or self._is_remote(object_digest)

    def _is_remote(self, object_digest: str) -> bool:
        if object_digest not in self._known and self._bucket.head(f"{self._folder(object_digest)}/{MANIFEST}"):
            self._known.add(object_digest)
        return object_digest in self._known

    def _holds(self, digests: Sequence[str]) -> bool:
        self._bucket.each(self._is_remote, [d for d in digests if not super(RemoteStore, self).__contains__(d)])
        return super()._holds(digests)

    def put(self, value: Any) -> str:
        object_digest = super().put(value)
        if not self._is_remote(object_digest):
            self._upload(object_digest)
        return object_digest

    def _upload(self, object_digest: str) -> None:
        files = [self._name(f) for f in self.object_path(object_digest).rglob("*") if f.is_file()]
        manifest = f"{self._folder(object_digest)}/{MANIFEST}"
        files.remove(manifest)
        self._bucket.each(lambda name: self._bucket.put(name, self.root / name), files)
        self._bucket.create(manifest, self.root / manifest)
        self._known.add(object_digest)

    def _load(self, object_digest: str) -> Any:
        if (copy := self._copy(object_digest)) is not None:
            return copy
        with self.temporary() as place:
            value, written = self._download(object_digest, place)
            target = self.object_path(object_digest)
            with writing(self.root):
                target.parent.mkdir(exist_ok=True)
                rename_folder(place, target)
        _stamp(target, written)
        return value

    def _copy(self, object_digest: str) -> Any:
        """The copy here, if there is one and it is whole; a damaged one is taken out."""
        if super().__contains__(object_digest):
            with contextlib.suppress(ValueError):
                return self._verified(self.object_path(object_digest), object_digest)
            super()._take_out(self.object_path(object_digest), math.inf)
        return None

    def read(self, object_digest: str) -> Any:
        """The same, from the bucket, where it is there: the copy here may be whole when that one is damaged."""
        if self._bucket.head(f"{self._folder(object_digest)}/{MANIFEST}") is None:
            return super().read(object_digest)
        with self.temporary() as place:
            return self._download(object_digest, place)[0]

    def _download(self, object_digest: str, place: Path) -> tuple[Any, float]:
        """Copy an object to a place here, and check it; also returns when it was written there."""
        folder = self._folder(object_digest)
        files = {meta.name.removeprefix(f"{folder}/"): meta for meta in self._bucket.files(folder)}
        if MANIFEST not in files:
            self._known.discard(object_digest)
            raise Gone(object_digest, "is not in the store")

        def fetch(name: str) -> None:
            target = place / name
            with writing(self.root):
                place.mkdir(exist_ok=True)  # not those above: a folder that was moved away would be there again
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("wb") as stream:
                    stream.writelines(self._bucket.blocks(f"{folder}/{name}"))

        def fetch_all() -> Any:
            self._bucket.each(fetch, filter(_FILE.fullmatch, files))
            return self._verified(place, object_digest)

        try:
            value = fetch_all()
        except ValueError:  # in the bucket, or only on the way
            remove(place)
            try:
                value = fetch_all()
            except ValueError as error:
                self.discard(object_digest)
                raise Gone(object_digest, f"was damaged ({error})") from None
        return value, max(meta.written for meta in files.values())

    def restore(self, object_digest: str) -> None:
        self._known.discard(object_digest)
        if self._copy(object_digest) is not None:
            self._upload(object_digest)

    def size(self, object_digest: str) -> int:
        return super().size(object_digest) or sum(m.bytes for m in self._bucket.files(self._folder(object_digest)))

    def _take_out(self, path: Path, unused_since: float) -> bool:
        here = super()._take_out(path, unused_since)
        if not here and path.exists():
            return False
        self._known.discard(path.name)
        name = self._name(path)
        found = filter(None, [self._bucket.head(name)]) if path.suffix else self._bucket.files(name)
        written = {meta.name: meta.written for meta in found}
        if any(when >= unused_since for when in written.values()):
            return False
        first = [file for file in written if file in (name, f"{name}/{MANIFEST}")]
        self._bucket.delete(first)
        self._bucket.delete(written.keys() - first)
        return here or bool(written)

    def objects(self) -> Iterator[Entry]:
        """Every object; also what uploads left that were cut more than `GRACE_SECONDS` ago."""
        used = {entry.name: entry.used for entry in super().objects()}
        sizes = {name: 0 for name in used}
        whole = set(used)
        for meta in self._bucket.files("objects"):
            if part := _OF_OBJECT.fullmatch(meta.name):
                name = part["digest"]
                used[name] = max(used.get(name, 0.0), meta.written)
                sizes[name] = sizes.get(name, 0) + meta.bytes
                if part["file"] == MANIFEST:
                    whole.add(name)
        before = self.now() - GRACE_SECONDS
        for name in sorted(used):
            if name in whole or used[name] < before:
                yield Entry(name, used[name], sizes[name] or super().size(name))

    def actions(self) -> Iterator[Entry]:
        """Every action. Their records are then here, since who lists them reads them."""
        here = {entry.name: entry for entry in super().actions()}
        found = self._merged(here, "actions")
        self._bucket.each(lambda key: self._fetch(self.action_path(key)), found.keys() - here.keys())
        yield from found.values()

    def parts(self) -> Iterator[Entry]:
        yield from self._merged({entry.name: entry for entry in super().parts()}, "parts").values()

    def _merged(self, here: dict[str, Entry], folder: str) -> dict[str, Entry]:
        found = dict(here)
        for meta in self._bucket.files(folder):
            name = Path(meta.name).stem
            if DIGEST.fullmatch(name):
                used = here[name].used if name in here else 0.0
                found[name] = Entry(name, max(used, meta.written), meta.bytes)
        return found

    def action(self, key: str, *, whole: bool = True) -> Action | None:
        found = super().action(key, whole=whole)
        if found is None and self._fetch(self.action_path(key)):
            found = super().action(key, whole=whole)
        return found

    def part(self, name: str) -> Any:
        found = super().part(name)
        if found is None and self._fetch(self._part_path(name)):
            found = super().part(name)
        return found

    def _fetch(self, path: Path) -> bool:
        """Copy a record from the bucket; False when it is not there."""
        found = self._bucket.get(self._name(path))
        if found is None:
            return False
        content, meta = found
        with writing(self.root), self.temporary() as place:
            place.write_bytes(content)
            path.parent.mkdir(exist_ok=True)
            place.replace(path)
        _stamp(path, meta.written)
        return True

    def _write(self, path: Path, text: str) -> None:
        self._bucket.put(self._name(path), text.encode())  # first, since what is here is never looked for in the bucket
        super()._write(path, text)

    def _beginning(self, two: str) -> set[str]:
        return {*super()._beginning(two), *self._bucket.folders(f"objects/{two}")}

    def now(self) -> float:
        self._bucket.put(CLOCK, b"")
        written = self._bucket.head(CLOCK)
        return written.written if written else super().now()

    def _folder(self, object_digest: str) -> str:
        return self._name(self.object_path(object_digest))

    def _name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()


class _BucketClaims:
    """Claims as files of a bucket. A file says who holds the claim, and has a line that changes with every touch."""

    poll_seconds = 2.0

    def __init__(self, bucket: Bucket) -> None:
        self._bucket = bucket

    def create(self, key: str, content: bytes) -> bool:
        return self._bucket.create(f"claims/{key}", content)

    def look(self, key: str) -> Seen | None:
        found = self._bucket.get(f"claims/{key}")
        if found is None:
            return None
        content, meta = found
        return Seen(content.partition(b"\n")[0], meta.written, meta)

    def touch(self, key: str, seen: Seen) -> None:
        self._bucket.replace(seen.version, seen.content + b"\n" + uuid.uuid4().bytes)

    def remove(self, key: str, seen: Seen) -> bool:
        # A delete has no conditions: of several who find it stale, one writes over it, and then deletes what nobody
        # else can have written. Where the answer to that was lost, asking again is refused: what is there then tells.
        mark = b"\n" + uuid.uuid4().bytes
        if not self._bucket.replace(seen.version, mark):
            found = self._bucket.get(f"claims/{key}")
            if found is None or found[0] != mark:
                return found is None
        self._bucket.delete([f"claims/{key}"])
        return True

    def claimed(self) -> list[str]:
        return [meta.name.removeprefix("claims/") for meta in self._bucket.files("claims")]


def default_folder(location: str) -> Path:
    """Where this machine keeps its copies of what a bucket holds: one folder for every location and endpoint."""
    endpoint = os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_ENDPOINT") or ""
    readable = re.sub(r"\W+", "-", location)
    return user_cache() / "buckets" / f"{readable}-{digest([location, endpoint])[:8]}"


def _stamp(path: Path, used: float) -> None:
    """Making a copy does not count as using it. To be called when it has its name: an old one in tmp/ is swept."""
    with contextlib.suppress(OSError):
        os.utime(path, (used, used))
