"""Files and folders: written whole or not at all, listed, measured and removed while others do the same."""

from __future__ import annotations

import os
import shutil
import uuid
from pathlib import Path

from ss_flow.cache.errors import StoreFailure


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader, and a crash, sees the old content or the new, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.name}.{uuid.uuid4().hex}"
    try:
        with temporary.open("wb") as stream:
            stream.write(content.encode() if isinstance(content, str) else content)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def rename_folder(source: Path, target: Path) -> None:
    """Give a complete folder its name, unless another writer was first. What is there and is no folder makes way."""
    try:
        source.rename(target)
    except OSError:
        # A folder cannot be renamed onto one that is not empty: another writer was first, with the same bytes.
        if target.is_dir():
            return
        if not os.path.lexists(target):
            raise
        remove(target)  # a foreign hand's: a file, or a link that leads nowhere
        source.rename(target)


def remove(path: Path) -> None:
    """Delete a file or a folder, if it is there."""
    try:
        path.unlink()
    except FileNotFoundError:
        pass
    except (IsADirectoryError, PermissionError):
        shutil.rmtree(path, ignore_errors=True)
    except OSError:  # a disk that can only be read says so of what is not there, too
        if path.exists():
            raise


def entries(folder: str) -> list[os.DirEntry[str]]:
    """What a folder holds, by name; nothing when it is not there, or a file, as file managers leave some anywhere."""
    try:
        with os.scandir(folder) as found:
            return sorted(found, key=lambda entry: entry.name)
    except (FileNotFoundError, NotADirectoryError):
        return []


def read_stamped(path: str) -> tuple[bytes, float]:
    """A small file's content, and when it was last changed: half the time of `open`, for what every hit does."""
    handle = os.open(path, os.O_RDONLY)
    try:
        status = os.fstat(handle)
        return os.read(handle, status.st_size), status.st_mtime
    finally:
        os.close(handle)


def stamp(path: Path | str) -> tuple[int, int, int]:
    """Size, time of change and inode of a file: while they are the same, so is its content. Raises OSError."""
    status = os.stat(path)
    return status.st_size, status.st_mtime_ns, status.st_ino


def folder_bytes(folder: Path) -> int:
    """How many bytes the files below a folder take."""
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())


def user_cache() -> Path:
    """The folder of ss-flow in the user's cache folder. Raises StoreFailure for a user without a home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME", "") or "~/.cache").expanduser() / "ss-flow"
    except RuntimeError:
        raise StoreFailure(
            "this user has no home folder; set XDG_CACHE_HOME to a folder that can be written."
        ) from None
