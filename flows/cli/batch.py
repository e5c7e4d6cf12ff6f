"""`ss-flow batch`: many scenes; one that fails does not stop the others."""

from __future__ import annotations

import contextlib
import glob
import itertools
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape

from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import Gone, StoreFailure
from ss_flow.cache.file_digests import FileDigests
from ss_flow.cache.store import Store
from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError, OutputFailure
from ss_flow.flows import settings
from ss_flow.flows.cli.batch_rows import BATCH_FILE, Book, earlier_rows, has_ended, row_of, stays, table_of
from ss_flow.flows.cli.context import console, file_digests
from ss_flow.flows.cli.prepare import (
    Prefixed,
    Prepared,
    RunOptions,
    display,
    finish,
    first_failure,
    prepare,
    tell_remarks,
)
from ss_flow.flows.cli.telling import hits_of, plan_in_words, print_table, would_run
from ss_flow.flows.deliver import STATUS_EXIT
from ss_flow.flows.measures import measures
from ss_flow.flows.params import Params
from ss_flow.tasks.capture.names import capture_name, named_after
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.deliver.output import check_writable
from ss_flow.tasks.deliver.places import RESULT, check_outside, check_replaceable


@dataclass(frozen=True)
class Batch:
    """Run many scenes, each into a folder of its own; one that fails leaves the others alone."""

    scenes: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[PATH ...]", help_behavior_hint="")
    ] = ()
    """Captures, as `run` takes them, or quoted patterns such as 'scans/*/'."""
    list_file: Annotated[Path | None, tyro.conf.arg(name="list", metavar="PATH", help_behavior_hint="")] = None
    """A file with more of them, one a line, relative to the file's own folder; lines that begin with # do not count."""
    out: Path = Path("ss-flow-out")
    """The folder to write: NAME/ for each scene, and batch.json."""
    retry_failed: bool = False
    """Run only those that the folder's batch.json marks as failed or does not name, or that were run with other
    parameters or up to another step, or whose results are gone."""
    undistorted: bool = False
    """Also write the photos and cameras that the run worked with, without distortion, as a COLMAP workspace."""
    execution: tyro.conf.OmitArgPrefixes[RunOptions] = RunOptions()
    """How to run."""

    def run(self) -> int:
        options = self.execution
        engine = options.engine()
        params = settings.apply(settings.preset(Params(), options.preset), options.texts)
        folders = folder_names(_found(self.scenes, self.list_file))
        check_writable(self.out)
        check_outside(self.out, options.store.location)
        asked = digest([settings.flat(params), options.target, self.undistorted])
        places = {path: self.out.absolute() / name for path, name in folders.items()}
        earlier = earlier_rows(self.out / BATCH_FILE, needed=self.retry_failed)
        others = [row for row in earlier.values() if stays(row, places)]
        again = earlier if self.retry_failed else {}
        ended = {str(path): again[str(path)] for path in folders if has_ended(again.get(str(path)), asked)}
        tell = console(json=options.json)
        if ended:
            tell.print(f"{len(ended)} of {len(folders)} scenes have ended already and are left out")
        store = options.store.open_store()
        digests = file_digests(store, verify=options.verify)
        scenes: dict[Path, Prepared] = {}
        errors: dict[Path, str] = {}
        with digests:
            for path in (path for path in folders if str(path) not in ended):
                try:
                    scenes[path] = self._opened(path, places[path], params, digests, folders)
                except Exception as error:  # a fault in one scene must not stop the others
                    errors[path] = _in_words(error)
            if errors and not scenes and not ended:
                first = next(iter(errors.values()))
                raise InputError(first if len(errors) == 1 else f"no scene can be opened; of the first: {first}")
            tell_remarks(scenes.values(), tell)
            with display(tell) as screen:
                requests = [
                    prepared.request(options, Prefixed(screen, folders[path], leading=position == 0))
                    for position, (path, prepared) in enumerate(scenes.items())
                ]
                if options.dry_run:
                    return self._plan(list(scenes), errors, run_flows(requests, store, **engine), tell)
                book = Book(self.out / BATCH_FILE, list(map(str, folders)), ended, others, asked, tell)
                for path, words in errors.items():
                    book.add(row_of(path, "failed", error=words))
                ready = [(item, places[item[0]] if options.delivers else None) for item in scenes.items()]
                with _Finishing(store, book, ready, undistorted=self.undistorted) as finishing:
                    watched = [
                        replace(r, done=partial(finishing.done, position)) for position, r in enumerate(requests)
                    ]
                    run_flows(watched, store, **engine)
                for position in finishing.damaged:
                    finishing.again(requests[position], position, engine)
        if options.json:
            print(json.dumps(book.rows))
        else:
            print_table(table_of(book.rows, folders), tell)
        if not options.delivers:
            tell.print(escape(f"{options.stops_early}: only {self.out / BATCH_FILE} is written"))
        return STATUS_EXIT["ok" if all(row["status"] == "ok" for row in book.rows) else "degraded"]

    def _opened(self, path: Path, out: Path, params: Params, digests: FileDigests, every: Iterable[Path]) -> Prepared:
        """every: all scenes of the batch. Raises InputError, among others, when the scene cannot be run."""
        scene = open_scene(path)
        prepared = prepare(scene, params, self.execution, digests)
        prepared.steps()
        if self.execution.delivers:
            check_replaceable(out, RESULT, self.execution.store.location, [*scene.files(), *every])
        return prepared

    def _plan(
        self, scenes: Sequence[Path], errors: Mapping[Path, str], reports: Sequence[Report], tell: Console
    ) -> int:
        """Tell what would run."""
        if self.execution.json:
            rows: list[dict[str, Any]] = [{"scene": str(path), "error": error} for path, error in errors.items()]
            for path, report in zip(scenes, reports, strict=True):
                rows.append({"scene": str(path), "hits": hits_of(report), "would_run": would_run(report)})
            print(json.dumps(rows))
            return 0
        for path, error in errors.items():
            tell.print(f"[red]cannot run[/] {escape(f'{path}: {error}')}")
        for path, report in zip(scenes, reports, strict=True):
            tell.print(escape(f"{path}: {plan_in_words(report)}"))
        return 0


class _Finishing(contextlib.AbstractContextManager["_Finishing"]):
    """Finishes scenes in a thread of its own, so that the engine need not wait for files to be written.

    scenes: each with its folder to write, if any. Left, it waits for the scenes that have ended; left by an interrupt
    or another fault, only for the one that it is at: the others have no row, and are finished by the next batch.
    A scene of which a result is damaged has no row either until `again` was called for it.
    """

    def __init__(
        self,
        store: Store,
        book: Book,
        scenes: Sequence[tuple[tuple[Path, Prepared], Path | None]],
        *,
        undistorted: bool,
    ) -> None:
        self._store, self._book, self._scenes, self._undistorted = store, book, scenes, undistorted
        self._worker = ThreadPoolExecutor(1)
        self._ended: list[Future[None]] = []
        self.damaged: list[int] = []
        """Positions of the scenes of which a result could not be read."""

    def done(self, position: int, report: Report) -> None:
        """A scene has ended."""
        self._ended.append(self._worker.submit(self._finish, position, report))

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._worker.shutdown(cancel_futures=kind is not None)
        if kind is None:
            for future in self._ended:
                future.result()  # raises when batch.json could not be written

    def again(self, request: Request, position: int, options: Mapping[str, Any]) -> None:
        """Run a scene once more and finish it while the engine is there to make again what is damaged."""
        try:
            run_flows([replace(request, done=partial(self._add, position))], self._store, **options)
        except StoreFailure as error:
            (path, _), _ = self._scenes[position]
            self._book.add(row_of(path, "failed", error=str(error)))

    def _finish(self, position: int, report: Report) -> None:
        try:
            self._add(position, report)
        except Gone:
            self.damaged.append(position)

    def _add(self, position: int, report: Report) -> None:
        """Raises Gone when a result is damaged."""
        (path, prepared), out = self._scenes[position]
        try:
            document = finish(prepared, report, self._store, out, undistorted=self._undistorted)
            row = row_of(
                path, document["status"], report, out, first_failure(document), measures(self._store, document)
            )
        except Gone:
            raise
        except Exception as error:  # a fault in one scene's result must not stop the others
            row = row_of(path, "failed", report, error=_in_words(error))
        self._book.add(row)


def _in_words(error: BaseException) -> str:
    return str(error) if isinstance(error, InputError | OutputFailure) else f"{type(error).__name__}: {error}"


def _found(patterns: Sequence[str], list_file: Path | None) -> list[Path]:
    """The scenes that are named, in order, each once. Raises InputError when there are none."""
    named = [(Path(), pattern) for pattern in patterns]
    if list_file is not None:
        try:
            lines = list_file.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, ValueError) as error:
            raise InputError(f"--list {list_file} cannot be read: {error}.") from None
        named += [(list_file.parent, s) for line in lines if (s := line.strip()) and not s.startswith("#")]
    found: dict[Path, None] = {}
    for folder, pattern in named:
        place = folder / Path(pattern).expanduser()
        matches = [str(place)] if place.exists() or not glob.has_magic(pattern) else sorted(glob.glob(str(place)))
        if not matches:
            raise InputError(f"nothing matches {pattern!r}; name scenes, or a pattern that some match.")
        found |= dict.fromkeys(Path(match).resolve() for match in matches)
    if not found:
        raise InputError("there is no scene to run; name some, or a --list of them.")
    return list(found)


def folder_names(scenes: Iterable[Path]) -> dict[Path, str]:
    """A folder name for each scene: its own, as `run` has it; where several have the same, with its ending, its
    parents' names, or at last a number."""
    left = list(scenes)
    names: dict[Path, str] = {}
    for depth in range(1, max(len(scene.parts) for scene in left) + 1):
        for last in (capture_name, lambda scene: named_after(scene).name):
            tried = {scene: "-".join([*named_after(scene).parts[1:][-depth:-1], last(scene)]) for scene in left}
            counts = Counter([*names.values(), *tried.values()])
            names |= {scene: name for scene, name in tried.items() if counts[name] == 1}
            left = [scene for scene in left if scene not in names]
    for scene in left:
        numbered = (f"{capture_name(scene)}-{number}" for number in itertools.count(2))
        names[scene] = next(name for name in numbered if name not in names.values())
    return names
