"""Pins: results that stay in the store until they are unpinned. A pin is a small JSON file under roots/pins/."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import StoreFailure, writing
from ss_flow.cache.files import write_atomically
from ss_flow.cache.plain_json import read_json
from ss_flow.cache.store import Store


@dataclass(frozen=True)
class Pin:
    """What one pin holds."""

    what: str
    """What the user called it: a step, a digest or a scene."""
    scene: str
    """The scene that it is about; empty for a digest."""
    keys: tuple[str, ...]
    """Actions that stay, with their outputs."""
    objects: tuple[str, ...]
    """Objects that stay."""
    pinned: float
    """When, in seconds since 1970."""


def read_pins(store: Store) -> list[Pin]:
    """All pins, the oldest first.

    Raises StoreFailure when one cannot be read: what it holds must not be lost.
    """
    found = []
    for path in (store.root / "roots" / "pins").glob("[!.]*.json"):
        try:
            content = read_json(path.read_text(encoding="utf-8"))
            content["keys"], content["objects"] = tuple(content["keys"]), tuple(content["objects"])
            found.append(Pin(**content))
        except FileNotFoundError:  # unpinned just now
            continue
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise StoreFailure(
                f"the pin {path} cannot be read ({error}); delete it, and pin again what it held."
            ) from None
    return sorted(found, key=lambda pin: pin.pinned)


def pin(store: Store, what: str, scene: str, keys: Sequence[str], objects: Sequence[str]) -> Pin:
    """Pin actions by key and objects by digest; what is pinned already under the same name stays one pin.

    Raises StoreFailure when it cannot be written.
    """
    made = Pin(what, scene, tuple(keys), tuple(objects), time.time())
    with writing(store.root):
        write_atomically(_path(store, made), json.dumps(vars(made), indent=1))
    return made


def unpin(store: Store, pinned: Pin) -> None:
    """Remove a pin; what it held may be collected from now on. Raises StoreFailure."""
    with writing(store.root):
        _path(store, pinned).unlink(missing_ok=True)


def _path(store: Store, pinned: Pin) -> Path:
    name = digest([pinned.what, pinned.scene, pinned.keys, pinned.objects])[:16]
    return store.root / "roots" / "pins" / f"{name}.json"
