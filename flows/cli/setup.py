"""What this machine has: networks, libraries, the compiled rasterizer."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import tyro
from rich.markup import escape
from rich.table import Table

from ss_flow.distributions import ABSENT, version
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import InStore, PositionalText, StoreOptions, console
from ss_flow.flows.cli.telling import print_table
from ss_flow.tasks.models import catalogue


@dataclass(frozen=True)
class ModelsList:
    """List the networks that can be used, and which are here."""

    json: bool = False
    """Print one JSON document."""

    def run(self) -> int:
        rows = []
        for entry in catalogue.load_catalogue().values():
            model = catalogue.find(entry.name)
            where = str(model.files[0].ref.path.parent) if model else ""
            rows.append(
                {
                    "name": entry.name,
                    "kind": entry.kind,
                    "licence": entry.licence,
                    "about": entry.about,
                    "source": entry.source,
                    "here": where,
                }
            )
        if self.json:
            print(json.dumps(rows, indent=1))
            return 0
        table = Table("name", "kind", "licence", "source", "here", box=None)
        for row in rows:
            table.add_row(*(escape(row[k]) for k in ("name", "kind", "licence", "source")), row["here"] or "[dim]no[/]")
        print_table(table, console(json=False))
        return 0


@dataclass(frozen=True)
class ModelsFetch:
    """Download a network's weights into the user's cache folder."""

    name: Annotated[str, tyro.conf.Positional]
    """Name in the catalogue."""

    def run(self) -> int:
        from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn

        from ss_flow.running import Surroundings, running
        from ss_flow.tasks.models.fetch import fetch

        shown = console(json=False)
        if here := catalogue.searched_before_cache(self.name):
            shown.print(
                escape(f"{self.name} is in {here}, which is searched first; nothing was downloaded"), soft_wrap=True
            )
            return 0
        columns = ("{task.description}", BarColumn(), DownloadColumn(), TimeRemainingColumn())
        with Progress(*columns, console=shown, transient=True, disable=not shown.is_terminal) as display:
            row = display.add_task(self.name, total=None)

            def listener(done: int, total: int, note: str) -> None:
                display.update(row, completed=done, total=total)

            with running(Surroundings(listener)):
                folder = fetch(self.name)
        shown.print(f"{self.name} is in {folder}; runs use it from now on", soft_wrap=True)
        return 0


@dataclass(frozen=True)
class ModelsVerify:
    """Check the weights that are here against their digests."""

    name: PositionalText = None
    """Name in the catalogue; all that are here, when left out."""

    def run(self) -> int:
        names = [self.name] if self.name else list(catalogue.load_catalogue())
        found = [model for model in map(catalogue.find, names) if model]
        if self.name and not found:
            raise InputError(f"the weights of {self.name!r} are not on this machine.")
        if not found:
            console(json=False).print("no weights are on this machine")
        for model in found:
            catalogue.verify(model)
            console(json=False).print(f"{model.name}: as they should be")
        return 0


@dataclass(frozen=True)
class Completion:
    """Print a script with which the shell completes commands and options at the Tab key.

    bash: ss-flow completion bash > ~/.local/share/bash-completion/completions/ss-flow
    zsh:  ss-flow completion zsh > FOLDER/_ss-flow, where FOLDER is in your $fpath
    """

    shell: Annotated[Literal["bash", "zsh"], tyro.conf.Positional]
    """The shell."""

    def run(self) -> int:
        from ss_flow.flows.cli.main import main

        try:
            return main(["--tyro-print-completion", self.shell])
        except SystemExit as ended:  # tyro prints it and leaves
            return int(ended.code or 0)


@dataclass(frozen=True)
class Doctor:
    """Tell whether this machine has all that runs need, and what to do where it has not."""

    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        again = "install again: pip install --force-reinstall"
        open3d = "open3d-cpu" if _x86_linux() else "open3d"
        # What a run may need; what says its state, with what would better it where that is worth saying, and raises
        # where it is needed and lacking; what to do then.
        checks: list[tuple[str, Callable[[], str | tuple[str, str]], str]] = [
            ("Python", lambda: sys.version.split()[0], ""),
            ("store", partial(_store, self.store), "name a folder that can be written, with --cache"),
            ("rasterizer", _rasterizer, "install ss-flow again, with a C++17 compiler at hand"),
            ("CUDA", _cuda, ""),
            ("Open3D", _open3d, f"{again} {open3d} libusb-package"),
            ("pycolmap", _pycolmap, f"{again} pycolmap"),
            ("onnxruntime", _onnxruntime, f"{again} onnxruntime"),
            *((name, partial(_library, name, module), f"{again} {name}") for name, module in _LIBRARIES),
            *((f"{kind} network", partial(_model, kind), "") for kind in _WITHOUT),
        ]
        rows: list[dict[str, Any]] = []
        for name, look, mend in checks:
            try:
                found, ok = look(), True
            except Exception as error:
                found, ok = (str(error) or type(error).__name__, mend), False
            state, to_do = (found, "") if isinstance(found, str) else found
            rows.append({"what": name, "ok": ok, "state": state, "what_to_do": to_do})
        if self.json:
            print(json.dumps(rows, indent=1))
        else:
            table = Table("what", "state", "what to do", box=None)
            for row in rows:
                state = escape(row["state"])
                table.add_row(row["what"], state if row["ok"] else f"[red]{state}[/]", escape(row["what_to_do"]))
            print_table(table, console(json=False))
        return 0 if all(row["ok"] for row in rows) else 1


def _store(options: StoreOptions) -> str:
    store = options.open_store()
    store.now()  # it can be written, and a bucket can be reached
    return store.location


_LIBRARIES = (
    ("torch", "torch"),
    ("opencv-contrib-python-headless", "cv2"),
    ("zarr", "zarr"),
)


def _library(distribution: str, module: str) -> str:
    importlib.import_module(module)
    return importlib.metadata.version(distribution)


def _open3d() -> str:
    from ss_flow.tasks.geometry.open3d import load_open3d

    return str(load_open3d().__version__)


def _pycolmap() -> str:
    from ss_flow.tasks.capture.colmap import has_pycolmap, load_pycolmap

    if platform.system() == "Linux" and not _x86_linux() and not has_pycolmap():
        return "none, as it is not built for this processor; captures need poses, which are taken as they are"
    return str(load_pycolmap().__version__)


def _x86_linux() -> bool:
    """Whether this is the one system that open3d-cpu is built for."""
    return (platform.system(), platform.machine()) == ("Linux", "x86_64")


def _onnxruntime() -> str:
    from ss_flow.tasks.models.onnx import load_onnxruntime

    return str(load_onnxruntime().__version__)


def _rasterizer() -> str:
    from ss_flow.tasks.gaussians.rasterize import backend_identity

    return ", ".join(f"{name} {value}" for name, value in backend_identity().items())


def _cuda() -> tuple[str, str]:
    import torch

    from ss_flow.tasks.gaussians.rasterize import device_here
    from ss_flow.tasks.models.onnx import lacks_cuda

    lacks = lacks_cuda()
    what = f"Gaussians on {device_here()}, networks on {'cuda' if lacks is None else 'cpu'}"
    if torch.cuda.is_available():
        to_do = {
            "to train and draw on it: pip install 'ss-flow[cuda]'": version("gsplat") == ABSENT,
            "to run networks on it: pip uninstall onnxruntime; pip install 'onnxruntime-gpu[cuda,cudnn]'": lacks,
        }
        why = f", since {lacks}" if lacks else ""
        return f"{torch.cuda.get_device_name()}: {what}{why}", "; ".join(text for text, so in to_do.items() if so)
    if shutil.which("nvidia-smi"):
        return "a driver, but torch is built without CUDA", "to use the GPU: install a torch built for CUDA"
    return f"none: {what}", ""


_WITHOUT = {
    "segmenter": "none; colour, depth and normals segment instead",
    "text-image": "none; colour words answer queries instead",
    "monodepth": "none; depth comes from the sensor or from several views",
    catalogue.PATCHES: "none; a segmenter can give vectors of single Gaussians instead",
    catalogue.DISTANCES: "none; LPIPS is not measured",
}


def _model(kind: str) -> tuple[str, str]:
    if here := catalogue.available(kind):
        return ", ".join(entry.name for entry in here), ""
    known = next(entry for entry in catalogue.load_catalogue().values() if entry.kind == kind and not entry.on_request)
    return _WITHOUT[kind], f"if you want one: {known.commands}"
