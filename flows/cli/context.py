"""What every command needs: the store, and a place to print."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any

import tyro
from rich.console import Console
from rich.text import Text

from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.files import user_cache
from ss_flow.cache.location import is_url, open_store
from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.results import FinishedRun, Results, finished_run, read_run
from ss_flow.task import FileRef, Reference
from ss_flow.tasks.models import catalogue

# What may be left out: the help then shows what to give, not "{None}|PATH" and "(default: None)".
PositionalPath = Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[PATH]", help_behavior_hint="")]
PositionalText = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[TEXT]", help_behavior_hint="")]
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")]
OptionalCount = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")]
OptionalNumber = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]


@dataclass(frozen=True)
class StoreOptions:
    """Where results are kept."""

    cache: OptionalText = None
    """Folder of the store, or s3://BUCKET/PREFIX; by default SS_FLOW_CACHE, or else ss-flow/store in the user's
    cache folder."""

    @property
    def location(self) -> str | Path:
        """The store's folder, or its URL."""
        location = self.cache or os.environ.get("SS_FLOW_CACHE", "") or user_cache() / "store"
        return str(location) if is_url(location) else Path(location).expanduser()

    def existing_store(self) -> Store:
        """The store, to look into, be it on a disk that can only be read. Raises InputError when there is none, or it
        cannot be used."""
        location = self.location
        if isinstance(location, Path) and not location.exists():
            raise InputError(f"there is no store {location}; `ss-flow run SCENE` makes one, --cache names another.")
        return self._opened(location)

    def open_store(self) -> Store:
        """The store, made where there is none.

        Raises InputError when the folder cannot be used or the URL is not that of a store.
        """
        return self._opened(self.location, os.W_OK)

    def _opened(self, location: str | Path, mode: int = os.R_OK) -> Store:
        try:
            store = open_store(location.resolve() if isinstance(location, Path) else location)
            if not os.access(store.root, mode):
                raise PermissionError(f"no permission to {'write' if mode == os.W_OK else 'read'}")
        except ValueError as error:
            raise InputError(str(error)) from None
        except StoreFailure:
            raise
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(
                f"the store {location} cannot be used: {reason}; name another folder with --cache or SS_FLOW_CACHE."
            ) from None
        return store


InStore = tyro.conf.OmitArgPrefixes[StoreOptions]
"""Of a command's field `store`: its options are those of the command."""


def file_digests(store: Store, *, verify: bool = False) -> FileDigests:
    """The store's memory of input files."""
    return FileDigests(store.root / "files.json", verify=verify)


def choose_model(kind: str, name: str, digests: FileDigests, *, wanted: bool = True) -> catalogue.Model | None:
    """The model of a kind to use.

    name: "auto" takes the first of the catalogue that is on this machine, or None (the stated fallback); "none" is the
    fallback; any other name must be on this machine. The weights are checked against the catalogue once a content.
    wanted: whether the run has a use for it; otherwise only the name is checked.
    Raises InputError when a named model is not here, is of another kind, or its weights are damaged.
    """
    if name == "none":
        return None
    if name != "auto" and (known := catalogue.entry_of(name)).kind != kind:
        raise InputError(f"model {name!r} is a {known.kind}, not a {kind}.")
    if not wanted:
        return None
    if name == "auto":
        here = catalogue.available(kind)
        if not here:
            return None
        name = here[0].name
    model = catalogue.find(name, None, digests)
    if model is None:
        known = catalogue.entry_of(name)
        by_hand = ", or name the folder that holds them in SS_FLOW_MODELS" if known.downloads else ""
        raise InputError(f"the weights of {name!r} are not on this machine; run {known.commands}{by_hand}.")
    digests.once(catalogue.verify, model, [file.ref.digest for file in model.files])
    return model


def choose_patches(name: str, digests: FileDigests) -> catalogue.Model | None:
    """The network for vectors of single Gaussians; None for "none".

    name: "auto" takes DINOv2 where it is on this machine, else a segmenter; a segmenter may be named too.
    Raises InputError as `choose_model` does, and when "auto" finds neither.
    """
    if name != "auto":
        named = name != "none" and catalogue.entry_of(name).kind == "segmenter"
        return choose_model("segmenter" if named else catalogue.PATCHES, name, digests)
    model = choose_model(catalogue.PATCHES, name, digests) or choose_model("segmenter", name, digests)
    if model is None:
        raise InputError(
            "semantics.patches=auto needs DINOv2 or a segmenter, and neither is on this machine; run "
            "`ss-flow models fetch dinov2-small`."
        )
    return model


def references(digests: FileDigests) -> Reference:
    """References to files by absolute paths, since a worker may stand in another folder."""
    return lambda path: FileRef.of(path.absolute(), digests)


def open_run(folder: Path, options: StoreOptions, needed: Sequence[str]) -> FinishedRun:
    """A finished run by its output folder, with the store that it names, unless the options name one. Where that is not
    here, as after it was moved, the store of this machine is taken if it holds what is needed.

    needed: the results that the store must still hold.
    Raises InputError when the folder is not that of a run or is damaged, or a result is gone.
    """
    document = read_run(folder)
    named = StoreOptions(document["store"])
    if options.cache:
        store = options.existing_store()
    elif isinstance(named.location, Path) and not named.location.exists():
        store = _store_here(folder, document, needed)
    else:
        store = named.existing_store()
    return finished_run(folder, document, store, needed)


def _store_here(folder: Path, document: Mapping[str, Any], needed: Sequence[str]) -> Store:
    """The store of this machine. Raises InputError unless it holds the results of a folder whose own is not here."""
    with contextlib.suppress(InputError):
        store = StoreOptions().existing_store()
        if not Results(store, document["results"]).missing(needed or ("scene",)):
            return store
    raise InputError(
        f"the results of {folder} are in the store {document['store']}, which is not here; name a copy of it with "
        f"--cache or SS_FLOW_CACHE, or run {document['scene']} again."
    )


_COMMANDS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Control characters, but for tabs and ends of lines."""


class _Words(Console):
    """Where the reader has gone, as in `ss-flow cache ls | head -1`, it goes on in silence; Rich ends the program.

    What a terminal would take for a command shows as a number: names of files, and what a store from someone else
    holds, may say anything.
    """

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(_COMMANDS.sub(lambda found: f"\\x{ord(found[0]):02x}", text), **options)

    def on_broken_pipe(self) -> None:
        self.quiet = True
        silence(self.file)


def silence(stream: IO[str]) -> None:
    """Have what is written to a stream of the process go nowhere from now on."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def console(*, json: bool) -> Console:
    """Where words for people go: nowhere near a JSON document on stdout."""
    return _Words(stderr=json, highlight=False, soft_wrap=True)
