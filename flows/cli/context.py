"""What every command needs: the store, and a place to print."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.tasks.models import catalogue


@dataclass(frozen=True)
class StoreOptions:
    """Where results are kept."""

    cache: Path | None = None
    """Folder of the store; by default SS_FLOW_CACHE, or else ss-flow in the user's cache folder."""

    def open_store(self) -> Store:
        """Raises InputError when the folder cannot be used."""
        root = self.cache or Path(os.environ.get("SS_FLOW_CACHE", "") or default_cache()).expanduser()
        try:
            store = Store(root.resolve())
            if not os.access(root, os.W_OK):
                raise PermissionError("no permission to write")
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(
                f"the store {root} cannot be used: {reason}; name another folder with --cache or SS_FLOW_CACHE."
            ) from None
        return store


def default_cache() -> Path:
    """The user's cache folder for ss-flow."""
    return Path(os.environ.get("XDG_CACHE_HOME", "") or "~/.cache").expanduser() / "ss-flow" / "store"


def file_digests(store: Store, *, verify: bool = False) -> FileDigests:
    """The store's memory of input files."""
    return FileDigests(store.root / "files.json", verify=verify)


def choose_model(kind: str, name: str, digests: FileDigests) -> catalogue.Model | None:
    """The model of a kind to use.

    name: "auto" takes the first of the catalogue that is on this machine, or None (the stated fallback); "none" is the
    fallback; any other name must be on this machine. The weights are checked against the catalogue once a content.
    Raises InputError when a named model is not here, is of another kind, or its weights are damaged.
    """
    if name == "none":
        return None
    if name == "auto":
        here = catalogue.available(kind)
        if not here:
            return None
        name = here[0].name
    entry = catalogue.entry_of(name)
    if entry.kind != kind:
        raise InputError(f"model {name!r} is a {entry.kind}, not a {kind}.")
    model = catalogue.find(name, None, digests)
    if model is None:
        raise InputError(
            f"the weights of {name!r} are not on this machine; run `ss-flow models fetch {name}`, "
            "or name the folder that holds them in SS_FLOW_MODELS."
        )
    digests.once(catalogue.verify, model, [file.ref.digest for file in model.files])
    return model


def console(*, json: bool) -> Console:
    """Where words for people go: nowhere near a JSON document on stdout."""
    return Console(stderr=json, highlight=False, soft_wrap=True)
