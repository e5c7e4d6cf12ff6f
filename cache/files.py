"""Files and folders: written whole or not at all, listed, measured and removed while others do the same."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
import struct
import time
import uuid
from pathlib import Path

from ss_flow.cache.errors import StoreFailure

AT_WORK_SECONDS = 3600.0
"""For so long after its last change an unfinished file, or folder, counts as being written."""
UNFINISHED = re.compile(r"\..+\.[0-9a-f]{32}")
"""What `write_atomically` calls files that are not yet whole."""
_ACL_VERSION, _ACL_USER, _ACL_GROUP, _ACL_OTHER = 2, 0x01, 0x04, 0x20
_NAME_BYTES = 200
"""How much of a name goes into a hidden one: file systems allow 255 bytes in all."""


def write_atomically(path: Path, content: str | bytes, *, synced: bool = True) -> None:
    """Write a file so that a reader, and a crash, sees the old content or the new, never a part.

    synced: also after a power cut, which takes milliseconds; for what nothing makes again.
    What was written beside it by a process that was killed is taken away by a later call. In a text, what is no UTF-8
    of a file's name is written as an escape, such as \\udcff.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _tidy(path)
    temporary = path.parent / f"{hidden(path.name)}.{uuid.uuid4().hex}"
    try:
        with temporary.open("wb") as stream:
            stream.write(content.encode(errors="backslashreplace") if isinstance(content, str) else content)
            if synced:
                stream.flush()
                os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_checked(path: Path, text: str) -> None:
    """Write what can be learnt again, so that `read_checked` notices damage; no error where it cannot be written."""
    with contextlib.suppress(OSError):
        if path.parent.is_dir():  # else that of a store which was moved away would be there again
            write_atomically(path, f"{_digest(text)}\n{text}", synced=False)


def read_checked(path: Path) -> str | None:
    """What `write_checked` wrote; None where there is none, it is damaged, or not ours to read."""
    try:
        stated, _, text = path.read_text(encoding="utf-8").partition("\n")
    except (OSError, ValueError):
        return None
    return text if stated == _digest(text) else None


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=32).hexdigest()


def hidden(name: str) -> str:
    """What the names begin with of things that will take the place of a file or a folder of this name."""
    whole = os.fsencode(name)
    if len(whole) > _NAME_BYTES:  # with a digest, since names may differ at their ends alone
        name = f"{whole[: _NAME_BYTES - 9].decode(errors='ignore')}.{hashlib.blake2b(whole, digest_size=4).hexdigest()}"
    return f".{name}"


def _tidy(path: Path) -> None:
    """Remove what killed calls of `write_atomically` left beside a file."""
    unfinished = re.compile(rf"{re.escape(hidden(path.name))}\.[0-9a-f]{{32}}")
    with contextlib.suppress(OSError):  # a folder that may be written, but not be listed
        for left in filter(lambda entry: unfinished.fullmatch(entry.name), entries(str(path.parent))):
            if left.stat(follow_symlinks=False).st_mtime < time.time() - AT_WORK_SECONDS:
                os.unlink(left.path)


def share(folder: Path, mode: int) -> None:
    """Give the group what it has by `mode` in a folder of this user's, and in all that anybody makes there from now on,
    whatever umask they have; where the file system has POSIX access control lists."""
    bits = ((_ACL_USER, mode >> 6), (_ACL_GROUP, mode >> 3), (_ACL_OTHER, mode))
    entries = b"".join(struct.pack("<HHI", tag, one & 7, 0xFFFFFFFF) for tag, one in bits)
    with contextlib.suppress(OSError, AttributeError):  # of another user, or not on Linux
        folder.chmod(stat.S_IMODE(folder.stat().st_mode) | mode & stat.S_IRWXG)
        os.setxattr(folder, "system.posix_acl_default", struct.pack("<I", _ACL_VERSION) + entries, os.XATTR_CREATE)


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


def stamp(path: Path | str) -> tuple[int, int, int, int]:
    """Size, time of change, inode and time of the inode's change: while they are the same, so is a file's content.

    Unpacking an archive gives the new file the time that the old one had, and often its inode; the last time of them
    nobody sets. It is another one also after a change of permissions, or of how many links there are: that such a file
    is another one, only its content tells. Raises OSError.
    """
    status = os.stat(path)
    return status.st_size, status.st_mtime_ns, status.st_ino, status.st_ctime_ns


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
