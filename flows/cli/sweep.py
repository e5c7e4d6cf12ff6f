"""`ss-flow sweep`: scenes with several values of parameters."""

from __future__ import annotations

import itertools
import json
import math
import types
import typing
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.markup import escape

from ss_flow.cache.canonical import digest
from ss_flow.cache.store import Store
from ss_flow.engine import Report, run_flows
from ss_flow.errors import InputError
from ss_flow.flows import settings
from ss_flow.flows.cli.context import OptionalPath, OptionalText, console, file_digests
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
from ss_flow.flows.cli.sweep_report import holds_other, in_short, tell_plan, tell_rows, write_files
from ss_flow.flows.deliver import STATUS_EXIT
from ss_flow.flows.measures import NAMES, measures, names_of
from ss_flow.flows.params import Params
from ss_flow.runs import DONE
from ss_flow.sweep import MOST_ROWS, Row, grid, in_words, recorded_as, rows_of, values_of, zipped
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.deliver.output import check_writable, writing_output
from ss_flow.tasks.deliver.places import check_outside


@dataclass(frozen=True)
class Variant:
    """One scene with one value of each swept parameter."""

    prepared: Prepared
    values: Mapping[str, Any]
    """The swept parameters by their full name, as they are in `prepared.params`."""

    def label(self, *, scene: bool) -> str:
        """Its values in words, after the scene's name where there are several scenes."""
        words = in_words({name.rpartition(".")[2]: in_short(value) for name, value in self.values.items()})
        return f"{self.prepared.scene.name} {words}" if scene else words


@dataclass(frozen=True)
class Sweep:
    """Run scenes with several values of parameters, as in --set split.tau_depth=0.001,0.02,0.1, and compare them.

    Values have commas between them, values that are lists themselves semicolons; lo:hi:n are n values from lo to hi,
    lo:hi:nlog the same evenly in the logarithm. What variants share is computed once. No output folders are written:
    `ss-flow run` with the chosen values gives one at once, since all its results are there.
    """

    scenes: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH ...", help_behavior_hint="")]
    """Captures, as `run` takes them."""
    out: OptionalPath = None
    """The folder for sweep.json, sweep.csv and sweep.png; by default ss-flow-out/NAME-sweep, with a number where
    another sweep lies there."""
    zipped: Annotated[bool, tyro.conf.arg(name="zip")] = False
    """Take the first values together, the second together, and so on, instead of every combination."""
    metrics: Annotated[
        tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]],
        tyro.conf.arg(name="metric", metavar="NAME", help_behavior_hint="may be given several times"),
    ] = ()
    """Tell only of these figures, such as split.miou; for an unknown one, the known ones are named."""
    query: OptionalText = None
    """Also search every result for this text, so that query.tau_corr can be swept."""
    masks: OptionalPath = None
    """Ready-made instance masks for the only scene, as `run` takes them."""
    hints: OptionalPath = None
    """A file of points clicked on objects of the only scene, as `run` takes it."""
    execution: tyro.conf.OmitArgPrefixes[RunOptions] = RunOptions()
    """How to run."""

    def run(self) -> int:
        options = self.execution
        engine = options.engine()
        settings_of = self._variants(settings.preset(Params(), options.preset), options.texts)
        self._check()
        once = {path.resolve(): path for path in self.scenes}.values()
        scenes = [open_scene(path, self.masks, self.hints) for path in once]
        asked = self._asked(scenes, settings_of)
        out = self._place(scenes, asked)
        check_writable(out)
        check_outside(out, options.store.location)
        store = options.store.open_store()
        digests = file_digests(store, verify=options.verify)
        tell = console(json=options.json)
        with digests:
            variants = [
                Variant(prepare(scene, params, options, digests, text=self.query), values)
                for scene in scenes
                for params, values in settings_of
            ]
            chosen = self._chosen(variants)
            found: dict[int, _Found | InputError] = {}

            def done(position: int, report: Report) -> None:
                if not options.dry_run:
                    found[position] = _found(variants[position].prepared, report, store)

            tell_remarks((variant.prepared for variant in variants), tell)
            with display(tell) as screen:
                requests = [
                    variant.prepared.request(
                        options,
                        Prefixed(screen, variant.label(scene=len(scenes) > 1), leading=position == 0),
                        partial(done, position),
                        recorded_as(variant.prepared.name, variant.values, asked),
                    )
                    for position, variant in enumerate(variants)
                ]
                rows = rows_of([v.values for v in variants], run_flows(requests, store, **engine))
        for name in _idle(variants, rows, zipped=self.zipped):
            hint = "; --query TEXT adds one" if name.startswith("semantics.query.") and self.query is None else ""
            tell.print(f"[yellow]warning:[/] no step of these runs depends on {name}{hint}.")
        if options.dry_run:
            labels = [variant.label(scene=len(scenes) > 1) for variant in variants]
            return tell_plan(labels, rows, tell, scenes=[v.prepared.name for v in variants] if options.json else None)
        documents = [
            {"sweep": asked, **row}
            for row in _documents(variants, rows, [found[position] for position in range(len(rows))], chosen)
        ]
        if options.json:
            print(json.dumps(documents))
        else:
            tell_rows(documents, tell)
        if options.target and not names_of([options.target]):
            tell.print(escape(f"--until {options.until} gives no figures; these steps do: {', '.join(NAMES)}"))
        with writing_output(out):
            written = write_files(out, documents, zipped=self.zipped)
        tell.print(escape(f"see {out}: {', '.join(written)}"))
        statuses = {document["status"] for document in documents}
        return STATUS_EXIT[statuses.pop()] if len(statuses) == 1 else STATUS_EXIT["degraded"]

    def _asked(self, scenes: Sequence[SceneFiles], variants: Sequence[tuple[Params, dict[str, Any]]]) -> str:
        """A digest of all that is asked: a sweep of the same one may take the place of another's files."""
        given = [str(path.resolve()) for path in (*(s.root for s in scenes), self.masks, self.hints) if path]
        values = [settings.flat(params) for params, _ in variants]
        return digest([given, values, self.metrics, self.query, self.execution.target])

    def _place(self, scenes: Sequence[SceneFiles], asked: str) -> Path:
        """The folder to write. Raises InputError when --out holds the files of another sweep."""
        if self.out is not None:
            if not self.execution.dry_run and holds_other(self.out, asked):
                what = "another sweep, or something else under the names of its files"
                raise InputError(f"{self.out} holds {what}; name another folder with --out.")
            return self.out
        name = f"{scenes[0].name}-sweep" if len(scenes) == 1 else "sweep"
        places = (Path("ss-flow-out") / (f"{name}-{n}" if n > 1 else name) for n in itertools.count(1))
        return next(place for place in places if not holds_other(place, asked))

    def _variants(self, params: Params, texts: Sequence[str]) -> list[tuple[Params, dict[str, Any]]]:
        """The parameters of every variant, and those of them that are swept, by name."""
        lists: dict[str, list[str]] = {}
        for text in texts:
            name, equals, listed = text.partition("=")
            if not equals or not name:
                settings.apply(params, [text])  # says what is wrong with it
            path = settings.find(params, name.strip())
            full = ".".join(path)
            if full in lists:
                raise InputError(f"parameter {full} is given twice; give all its values in one --set.")
            lists[full] = values_of(listed, separator=";" if _is_list(settings.type_of(params, path)) else ",")
        fixed = [f"{name}={values[0]}" for name, values in lists.items() if len(values) == 1]
        swept = {name: values for name, values in lists.items() if len(values) > 1}
        if not self.zipped and (count := math.prod(map(len, swept.values()))) > MOST_ROWS:
            raise InputError(f"these values have {count:,} combinations; a sweep may have at most {MOST_ROWS:,}.")
        found: dict[str, tuple[Params, dict[str, Any]]] = {}  # a value that is named twice, 0.6 and 0.60, counts once
        for values in zipped(swept) if self.zipped else grid(swept):
            variant = settings.apply(params, [*fixed, *(f"{name}={text}" for name, text in values.items())])
            flat = settings.flat(variant)
            found.setdefault(digest(flat), (variant, {name: flat[name] for name in values}))
        if len(found) < 2:
            raise InputError("there is nothing to sweep; give a parameter several values: --set tau_label=0.6,0.8.")
        return list(found.values())

    def _check(self) -> None:
        if not self.scenes:
            raise InputError("there is no scene to sweep; name one, or several.")
        if (self.masks or self.hints) and len(self.scenes) != 1:
            given = "--masks" if self.masks else "--hints"
            raise InputError(f"{given} belongs to one scene; sweep scenes with masks of their own one by one.")
        if self.query is not None and self.execution.target not in (None, "query"):
            raise InputError("--query is the last step; leave out --until, or stop with --until query.")

    def _chosen(self, variants: Sequence[Variant]) -> list[str]:
        """The figures that --metric names, [] for all. Raises InputError for one that no scene will have."""
        chosen = [name for group in self.metrics for name in group]
        if chosen:
            target = self.execution.target
            steps = [[target] if target else variant.prepared.steps() for variant in variants]
            known = list(dict.fromkeys(name for some in steps for name in names_of(some)))
            for name in chosen:
                if name not in known:
                    there = ", ".join(known) or "none: --until stops before them"
                    raise InputError(f"there is no metric {name!r} here; there are {there}.")
        return chosen


def _is_list(kind: Any) -> bool:
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return any(_is_list(choice) for choice in typing.get_args(kind))
    return typing.get_origin(kind) is tuple


_Found = tuple[str, str | None, dict[str, float]]
"""Status of a variant, what failed first, and its figures."""


def _found(prepared: Prepared, report: Report, store: Store) -> _Found | InputError:
    """What a variant came to; the error, when it failed because of what it was given."""
    try:
        document = finish(prepared, report, store, None)
        return document["status"], first_failure(document), measures(store, document)
    except InputError as bad:
        return bad


def _documents(
    variants: Sequence[Variant], rows: Sequence[Row], all_found: Sequence[_Found | InputError], chosen: Sequence[str]
) -> list[dict[str, Any]]:
    """The rows of sweep.json. Raises InputError when every variant failed because of what it was given."""
    documents, refused = [], []
    for variant, row, came_to in zip(variants, rows, all_found, strict=True):
        if isinstance(came_to, InputError):
            refused.append(came_to)
        status, error, found = ("failed", str(came_to), {}) if isinstance(came_to, InputError) else came_to
        documents.append(
            {
                "scene": variant.prepared.name,
                "params": dict(variant.values),
                "metrics": {name: found[name] for name in chosen or found if name in found},
                "hits": row.hits,
                "misses": row.misses,
                "seconds": round(row.seconds, 3),
                "status": status,
                "error": error,
            }
        )
    if len(refused) == len(documents):
        raise refused[0]
    return documents


def _idle(variants: Sequence[Variant], rows: Sequence[Row], *, zipped: bool) -> list[str]:
    """Swept parameters that no step depends on: other values of them alone (all together, when zipped) change no key.

    Nothing is said of rows that did not get to their end: what they did not reach may depend on anything.
    """
    if any(node["event"] not in DONE for row in rows for node in row.report.nodes):
        return []
    idle = []
    for name in rows[0].values:
        keys: dict[tuple[str, ...], set[frozenset[str]]] = defaultdict(set)
        for variant, row in zip(variants, rows, strict=True):
            others = [] if zipped else [str(value) for other, value in row.values.items() if other != name]
            keys[variant.prepared.name, *others].add(frozenset(node["key"] for node in row.report.nodes))
        several = len({str(row.values[name]) for row in rows}) > 1
        if several and all(len(different) == 1 for different in keys.values()):
            idle.append(name)
    return idle
