"""The content-addressed store: objects under the digest of what they are, actions under the key of what made them.

    objects/aa/<digest>/    Zarr groups
    actions/aa/<key>.json   key -> output digests, the key's components, seconds, memory, host, warnings
    claims/<key>            who is computing what, now
    roots/runs/             a manifest and an event log for every run
    checkpoints/            what long tasks keep of half-done work, by key
    tmp/                    what is being written

Notes
-----
*Crash.* An object or an action appears by one rename of something complete and fsynced; what a killed process leaves is
in tmp/, and is never read. The action comes after all of its objects.

*Concurrent writers.* Two processes that write the same object write the same bytes; the loser of the rename discards
its copy. Readers never lock.

*Full disk.* The write fails with OSError before anything is visible; the store stays as it was.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import threading
import uuid
from collections import OrderedDict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.cache import codec
from ss_flow.cache.canonical import digest

MEMORY_BYTES = 2 << 30
"""How much of what was read lately a process keeps in memory."""


@dataclass(frozen=True)
class Action:
    """The record of one computation: what went in (the key's components) and what came out."""

    key: str
    step: str
    outputs: tuple[str, ...]
    """Digests of the results, in order."""
    is_list: bool
    """Whether the task returned a list (of any length) rather than one artifact."""
    components: dict[str, dict[str, Any]]
    """What the key is the digest of: code, parameters, inputs, packages, environment."""
    seconds: float
    peak_rss_mb: float
    host: str = field(default_factory=socket.gethostname)
    warnings: tuple[str, ...] = ()


class Store:
    """A store in a folder, created when absent.

    Raises OSError (with the folder's name) when the folder cannot be created or written.
    """

    def __init__(self, root: Path, *, memory_bytes: int = MEMORY_BYTES) -> None:
        self.root = root
        self._memory_bytes = memory_bytes
        self._recent: OrderedDict[str, Any] = OrderedDict()
        self._held = 0
        self._lock = threading.Lock()
        for name in ("objects", "actions", "claims", "roots/runs", "tmp"):
            (root / name).mkdir(parents=True, exist_ok=True)

    def object_path(self, object_digest: str) -> Path:
        return self.root / "objects" / object_digest[:2] / object_digest

    def action_path(self, key: str) -> Path:
        return self.root / "actions" / key[:2] / f"{key}.json"

    def __contains__(self, object_digest: str) -> bool:
        return self.object_path(object_digest).is_dir()

    def put(self, value: Any) -> str:
        """Store a dataclass of arrays; return its digest. Storing the same content again costs only the hashing."""
        object_digest = digest(value)
        target = self.object_path(object_digest)
        if not target.is_dir():
            temporary = self.root / "tmp" / uuid.uuid4().hex
            try:
                codec.write(value, temporary)
                _sync_tree(temporary)
                target.parent.mkdir(exist_ok=True)
                _rename_folder(temporary, target)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
        return object_digest

    def get(self, object_digest: str) -> Any:
        """The stored value. Shared between callers: its arrays are read-only.

        Raises KeyError when the store holds no such object.
        """
        with self._lock:
            if object_digest in self._recent:
                self._recent.move_to_end(object_digest)
                return self._recent[object_digest]
        path = self.object_path(object_digest)
        if not path.is_dir():
            raise KeyError(f"no object {object_digest} in {self.root}")
        value = codec.read(path)
        self._remember(object_digest, value)
        return value

    def _remember(self, object_digest: str, value: Any) -> None:
        size = _array_bytes(value)
        with self._lock:
            if size > self._memory_bytes // 4 or object_digest in self._recent:
                return
            self._recent[object_digest] = value
            self._held += size
            while self._held > self._memory_bytes:
                self._held -= _array_bytes(self._recent.popitem(last=False)[1])

    def action(self, key: str, *, whole: bool = True) -> Action | None:
        """The record under a key, or None when there is none; with `whole`, also when one of its outputs is gone."""
        try:
            record = json.loads(self.action_path(key).read_text())
        except FileNotFoundError:
            return None
        record["outputs"], record["warnings"] = tuple(record["outputs"]), tuple(record["warnings"])
        action = Action(**record)
        return action if not whole or all(output in self for output in action.outputs) else None

    def record(self, action: Action) -> None:
        """Publish an action; its outputs must be stored already."""
        write_atomically(self.action_path(action.key), json.dumps(asdict(action), separators=(",", ":")))

    def find(self, prefix: str) -> list[str]:
        """Digests of the stored objects that begin with `prefix` (at least two characters)."""
        folder = self.root / "objects" / prefix[:2]
        return sorted(path.name for path in folder.glob(f"{prefix}*")) if len(prefix) >= 2 else []

    def sweep_temporaries(self, older_than_seconds: float, now: float) -> int:
        """Delete what killed processes left half-written; return how many. A writer at work is left alone by age."""
        stale = [path for path in (self.root / "tmp").iterdir() if now - path.stat().st_mtime > older_than_seconds]
        for path in stale:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        return len(stale)


def write_atomically(path: Path, text: str) -> None:
    """Write a file so that a reader, and a crash, sees the old content or the new, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.name}.{uuid.uuid4().hex}"
    try:
        with temporary.open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _rename_folder(source: Path, target: Path) -> None:
    try:
        source.rename(target)
    except OSError:
        # A folder cannot be renamed onto one that is not empty: another writer was first, with the same bytes.
        if not target.is_dir():
            raise


def _sync_tree(folder: Path) -> None:
    for directory, _, files in os.walk(folder):
        for name in (*files, "."):
            handle = os.open(os.path.join(directory, name), os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)


def _array_bytes(value: Any) -> int:
    return 256 + sum(item.nbytes for item in vars(value).values() if isinstance(item, np.ndarray))
