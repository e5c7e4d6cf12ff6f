"""The content-addressed store: objects under the digest of what they are, actions under the key of what made them.

    objects/aa/<digest>/    Zarr groups
    actions/aa/<key>.json   key -> output digests, the key's components, seconds, memory, host, warnings
    parts/<digest>.json     what a digest in an action's components stands for: definitions of code, members of a list
    claims/<key>            who is computing what, now
    roots/runs/, roots/pins/    what must be kept: a manifest and an event log for every run; what the user pinned
    checkpoints/            what long tasks keep of half-done work, by key
    closures/               what the code of functions depends on, as it was worked out last
    tmp/                    what is being written

Notes
-----
*Crash.* An object or an action appears by one rename of something complete; what a killed process leaves is in tmp/,
and is never read. The action comes after all of its objects.

*Power cut, failing disk, foreign hands.* What can be made again is not synced (pins and checkpoints are), but checked
when it is read: an object whose content is not what its name says is taken out, and its maker runs again; a part that
is not what its name says counts as unknown until the next call that depends on it is computed.

*Another version.* An object whose type has got or lost fields since, or is not to be found here, is whole: it stays,
and OtherVersion is raised. No key of this version leads to it, since the definitions of types are code that keys depend
on.

*Concurrent writers.* Two processes that write the same object write the same bytes; the loser of the rename discards
its copy. Readers never lock.

*Full disk.* The write fails with StoreFailure before anything is visible; the store stays as it was.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import errno
import json
import math
import os
import re
import socket
import stat
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from ss_flow.cache import codec
from ss_flow.cache.canonical import DIGEST, digest
from ss_flow.cache.claims import Claims
from ss_flow.cache.errors import Gone, OtherVersion, reading, writing
from ss_flow.cache.files import entries, folder_bytes, read_stamped, remove, rename_folder, share
from ss_flow.cache.plain_json import read_json, reader
from ss_flow.cache.recent import Recent

MEMORY_BYTES = min(1 << 30, psutil.virtual_memory().total // 16)
"""About how much of what was read lately a process keeps in memory: photos and depth maps of hundreds of views, at
which each instance looks again, but no more than a small machine can spare."""
GRACE_SECONDS = 3600.0
"""What was made or used within this time is not collected, whoever asks: a run may be about to use it."""

_UNCHANGING = frozenset({str, bytes, int, float, bool, type(None)})
"""What nobody can change in a tuple."""
_TEMPORARY = re.compile(r"[0-9a-f]{32}")
"""What `temporary` calls things."""
_RECORD = re.compile(rf"{DIGEST.pattern}\.json")

NO_FILES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""What keeps a process from opening any file."""


@dataclass(frozen=True)
class Entry:
    """Something that a store holds."""

    name: str
    """The digest of an object, or the key of an action."""
    used: float
    """When it was last written or used, by the clock that stamps the store's files (about a quarter of the grace
    period behind, at most)."""
    bytes: int


@dataclass(frozen=True)
class Action:
    """The record of one computation: what went in (the key's components) and what came out."""

    key: str
    step: str
    outputs: tuple[str, ...]
    """Digests of the results, in order."""
    is_list: bool
    """Whether the task returned a list (of any length) rather than one artifact."""
    components: dict[str, Any]
    """What the key is the digest of: task, code, parameters, inputs, packages, environment. Of the code and of each
    input only a digest: that of an object, or else of one of the store's parts."""
    seconds: float
    peak_rss_mb: float
    host: str = socket.gethostname()
    warnings: tuple[str, ...] = ()


_read_action = reader(Action)


class Store:
    """A store in a folder, created when absent.

    Raises OSError (with the folder's name) when the folder cannot be created or written.
    """

    def __init__(self, root: Path | str, *, memory_bytes: int = MEMORY_BYTES) -> None:
        self.root = root = Path(root).absolute()  # a process may change its folder
        self._recent = Recent(memory_bytes)
        self._actions = f"{root}/actions"
        self._objects = f"{root}/objects"
        folders = [root / name for name in ("objects", "actions", "parts", "claims", "roots/runs", "roots/pins", "tmp")]
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
        if (mode := root.stat().st_mode) & (stat.S_ISGID | stat.S_IWGRP):  # a group's: see docs/clusters.md
            for folder in (root, root / "roots", *folders):
                share(folder, mode)

    def object_path(self, object_digest: str) -> Path:
        return self.root / "objects" / object_digest[:2] / object_digest

    def action_path(self, key: str) -> Path:
        return self.root / "actions" / key[:2] / f"{key}.json"

    @property
    def runs(self) -> Path:
        """The folder of the runs, one folder each."""
        return self.root / "roots" / "runs"

    @property
    def closures(self) -> Path:
        """The folder for what the code of functions depends on."""
        return self.root / "closures"

    @property
    def location(self) -> str:
        """Where the store is, as `open_store` takes it."""
        return str(self.root)

    def checkpoint(self, key: str) -> Path:
        """Where a long task may keep half-done work."""
        return self.root / "checkpoints" / f"{key}.npz"

    def open_claims(self) -> Claims:
        """The claims of this process."""
        return Claims(self.root)

    def __contains__(self, object_digest: str) -> bool:
        path = f"{self._objects}/{object_digest[:2]}/{object_digest}/"  # of "", the folder of all objects
        return DIGEST.fullmatch(object_digest) is not None and os.access(path, os.F_OK)  # quicker than isdir

    def _holds(self, digests: Sequence[str]) -> bool:
        return all(map(self.__contains__, digests))

    def put(self, value: Any) -> str:
        """Store a dataclass of arrays; return its digest. Storing the same content again costs only the hashing.

        Raises StoreFailure when it cannot be written, TypeError for a value that cannot be stored.
        """
        try:
            object_digest = digest(value)
        except (TypeError, RecursionError):
            codec.check(value)  # names the field
            raise
        target = self.object_path(object_digest)
        with writing(self.root):
            if target.is_dir() and not codec.is_current(target):
                self._take_out(target, math.inf)
            try:
                os.utime(f"{target}/")  # used again: it must not be collected before its action is recorded
            except (FileNotFoundError, NotADirectoryError):
                with self.temporary() as place:
                    codec.write(value, place)
                    target.parent.mkdir(exist_ok=True)
                    rename_folder(place, target)
        return object_digest

    def limit_memory(self, most_bytes: int) -> None:
        """Keep about so many bytes of what was read lately in memory, and forget what is there."""
        self._recent = Recent(most_bytes)

    def get(self, object_digest: str) -> Any:
        """The stored value. Shared between callers: its arrays are read-only, its lists and tables the caller's own.

        Raises Gone when the store holds no such object, or one that is damaged, which is then taken out; OtherVersion
        when its type has other fields by now, or is not to be found here; StoreFailure, or MemoryError, when it cannot
        be read now.
        """
        value = self._recent.get(object_digest)
        if value is None:
            try:
                value = self._load(object_digest)
            except OtherVersion as found:
                raise self._with_its_step(found) from None
            self._recent.keep(object_digest, value)
        return _own(value)

    def _load(self, object_digest: str) -> Any:
        return self.read(object_digest)

    def read(self, object_digest: str) -> Any:
        """The same, from the disk."""
        folder = self.object_path(object_digest)
        if object_digest not in self:
            if os.path.lexists(folder) and not folder.is_dir():
                self.discard(object_digest)
                raise Gone(object_digest, "was damaged (it is no folder)")
            raise Gone(object_digest, "is not in the store")
        try:
            return self._verified(folder, object_digest)
        except ValueError as error:
            self.discard(object_digest)
            raise Gone(object_digest, f"was damaged ({error})") from None

    def _verified(self, folder: Path, object_digest: str) -> Any:
        """The object in a folder. Raises ValueError when it is damaged, and else as `get`."""
        with reading(self.root):
            try:
                value = codec.read(folder)
            except codec.OtherFields as error:
                if codec.digest_as_stored(folder) == object_digest:
                    raise OtherVersion(object_digest, str(error)) from None
                raise
        if digest(value) != object_digest:
            raise ValueError("its content is not what its name says")
        return value

    def _with_its_step(self, found: OtherVersion) -> OtherVersion:
        """The same, naming the step that made the object, where one is recorded; reads every record."""
        recorded = (self.action(entry.name, whole=False) for entry in self.actions())
        step = next((action.step for action in recorded if action and found.digest in action.outputs), None)
        return OtherVersion(found.digest, f"{found.reason} (a result of {step})") if step else found

    def restore(self, object_digest: str) -> None:
        """Restore what can be restored when someone else finds an object missing that this process counts on."""

    def size(self, object_digest: str) -> int:
        """How many bytes an object takes; 0 when it is not there."""
        return folder_bytes(self.object_path(object_digest))

    def discard(self, object_digest: str, *, unused_since: float = math.inf) -> bool:
        """Take an object out, at once for all readers; False when it is not there, or was used since.

        Raises ValueError for what is no digest.
        """
        if not DIGEST.fullmatch(object_digest):
            raise ValueError(f"{object_digest!r} is no digest of an object")
        self._recent.drop(object_digest)
        return self._take_out(self.object_path(object_digest), unused_since)

    def forget(self, key: str, *, unused_since: float = math.inf) -> bool:
        """Take an action out, at once for all readers; False when it is not there, or was used since."""
        return self._take_out(self.action_path(key), unused_since)

    def _take_out(self, path: Path, unused_since: float) -> bool:
        with writing(self.root), self.temporary() as place:
            try:
                path.rename(place)
            except FileNotFoundError:
                return False
            try:
                if place.lstat().st_mtime < unused_since:
                    return True
            except FileNotFoundError:  # old enough that another process has swept it from tmp/
                return True
            with contextlib.suppress(OSError):  # back again, unless someone has just made it anew
                place.rename(path)
            return False

    def objects(self) -> Iterator[Entry]:
        """Every object."""
        for folder in entries(self._objects):
            for entry in filter(lambda entry: DIGEST.fullmatch(entry.name), entries(folder.path)):
                with contextlib.suppress(FileNotFoundError):
                    status = entry.stat(follow_symlinks=entry.is_dir())  # a link may lead nowhere
                    yield Entry(entry.name, status.st_mtime, folder_bytes(Path(entry.path)))

    def actions(self) -> Iterator[Entry]:
        """Every action."""
        for folder in entries(self._actions):
            yield from _records(folder.path)

    def action(self, key: str, *, whole: bool = True) -> Action | None:
        """The record under a key, or None when there is none; with `whole`, also when one of its outputs is gone.

        A whole one counts as used now. Raises StoreFailure when this process can read no file at the moment.
        """
        path = f"{self._actions}/{key[:2]}/{key}.json"
        try:
            content, modified = read_stamped(path)
            action = _read_action(content)
        except ValueError:  # not one of ours
            return None
        except OSError as error:  # not there, no file, or not ours to read
            if error.errno in NO_FILES:
                with reading(self.root):
                    raise
            return None
        if action.key != key or not _is_sound(action):
            return None
        if not whole:
            return action
        if not self._holds(action.outputs):
            return None
        if time.time() - modified > GRACE_SECONDS / 4:
            with contextlib.suppress(OSError):
                os.utime(path)
                self.use(action.outputs)
        return action

    def use(self, digests: Iterable[str]) -> None:
        """Count objects as used now, so that they are not collected for a while."""
        for name in digests:
            with contextlib.suppress(OSError):
                os.utime(self.object_path(name))

    def record(self, action: Action) -> None:
        """Publish an action; its outputs must be stored already."""
        self._write(self.action_path(action.key), json.dumps(vars(action), separators=(",", ":")))

    def put_part(self, name: str, part: Any) -> None:
        """Keep what a digest in the components of actions stands for, once for all of them; plain data."""
        path, text = self._part_path(name), json.dumps(part, separators=(",", ":"))
        with contextlib.suppress(OSError):
            if path.read_bytes() == text.encode():  # a power cut may have left it empty, or a disk may fail
                return
        self._write(path, text)

    def part(self, name: str) -> Any:
        """What a digest in the components of an action stands for; None when not known."""
        try:
            return read_json(self._part_path(name).read_text())
        except (OSError, ValueError):
            return None

    def _part_path(self, name: str) -> Path:
        return self.root / "parts" / f"{name}.json"

    def find(self, prefix: str) -> list[str]:
        """Digests of the stored objects that begin with `prefix` (at least two characters)."""
        if len(prefix) < 2 or not re.fullmatch("[0-9a-f]+", prefix):
            return []
        return sorted(name for name in self._beginning(prefix[:2]) if name.startswith(prefix))

    def _beginning(self, two: str) -> set[str]:
        """Digests of the stored objects that begin with two characters."""
        return {entry.name for entry in entries(f"{self._objects}/{two}")}

    @contextlib.contextmanager
    def temporary(self) -> Iterator[Path]:
        """A name in tmp/ for a file or a folder; what is left of it is removed."""
        place = self.root / "tmp" / uuid.uuid4().hex
        try:
            yield place
        finally:
            remove(place)

    def _write(self, path: Path, text: str) -> None:
        with writing(self.root), self.temporary() as place:
            place.write_text(text, encoding="utf-8")
            path.parent.mkdir(exist_ok=True)
            try:
                place.replace(path)
            except IsADirectoryError:  # a foreign hand's, and no record
                remove(path)
                place.replace(path)

    def now(self) -> float:
        """The time by the clock that stamps the store's files, which may be another host's; by this machine's where the
        store can only be read."""
        with writing(self.root), self.temporary() as place:
            try:
                place.touch()
            except OSError as error:
                if error.errno in (errno.EROFS, errno.EACCES):
                    return time.time()
                raise
            return place.stat().st_mtime

    def sweep_temporaries(self) -> int:
        """Delete what killed processes left half-written; return how many. A writer at work is left alone by age, and
        what no store has named so by its name: the folder may have been someone's before it was a store."""
        before = self.now() - GRACE_SECONDS
        stale = 0
        for entry in filter(lambda entry: _TEMPORARY.fullmatch(entry.name), entries(f"{self.root}/tmp")):
            with contextlib.suppress(FileNotFoundError):  # its writer has just finished
                if entry.stat().st_mtime < before:
                    remove(Path(entry.path))
                    stale += 1
        return stale

    def parts(self) -> Iterator[Entry]:
        """Every part, by its digest."""
        return _records(f"{self.root}/parts")

    def drop_part(self, name: str, *, unused_since: float = math.inf) -> bool:
        """Take a part out; False when it is not there, or was written since."""
        return self._take_out(self._part_path(name), unused_since)


def _own(value: Any) -> Any:
    """The same with lists and tables of its own, which can be changed as nothing else of a frozen dataclass can."""
    own = value
    for item in dataclasses.fields(value):
        if _can_change(content := getattr(value, item.name)):
            own = copy.copy(value) if own is value else own
            object.__setattr__(own, item.name, copy.deepcopy(content))
    return own


def _can_change(content: Any) -> bool:
    if isinstance(content, tuple):
        return not _UNCHANGING.issuperset(map(type, content))
    return isinstance(content, dict | list)


def _records(folder: str) -> Iterator[Entry]:
    """The JSON files of a folder that are named by digests."""
    for entry in filter(lambda entry: _RECORD.fullmatch(entry.name), entries(folder)):
        with contextlib.suppress(FileNotFoundError):
            status = entry.stat(follow_symlinks=False)  # which may lead round in a circle
            yield Entry(entry.name.removesuffix(".json"), status.st_mtime, status.st_size)


def _is_sound(action: Action) -> bool:
    """Whether the outputs are digests, which lead nowhere out of the store, and one where one is due."""
    return all(map(DIGEST.fullmatch, action.outputs)) and (action.is_list or len(action.outputs) == 1)
