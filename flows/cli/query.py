"""`ss-flow query`: which instances a text means."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from ss_flow.cache.store import Store
from ss_flow.engine import Request, run_flows
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import (
    OptionalCount,
    OptionalNumber,
    OptionalPath,
    StoreOptions,
    choose_model,
    console,
    file_digests,
    open_run,
)
from ss_flow.flows.results import read_run
from ss_flow.graph import stored
from ss_flow.keys import Value
from ss_flow.resolution import Failure
from ss_flow.tasks.deliver.output import check_place, replacing
from ss_flow.tasks.semantics.query import QueryParams, QueryResult, query

ANSWER_FILE = "answer.json"


@dataclass(frozen=True)
class Query:
    """Find the instances of a result that a text describes."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    text: Annotated[str, tyro.conf.Positional]
    """What to look for, such as "red mug", or "mug, not the red one"."""
    tau_corr: OptionalNumber = None
    """How much further than the best an instance may be and still match; the run's own value when left out."""
    top_k: OptionalCount = None
    """Take the best so many that the text fits, in the place of those near the best (--tau-corr)."""
    background: bool = False
    """Rank the background too, as if it were an object."""
    out: OptionalPath = None
    """Also write a folder: answer.json, answer.ply (the instances that match) and masks/ (where each photo shows
    them)."""
    json: bool = False
    """Print one JSON document."""
    store: tyro.conf.OmitArgPrefixes[StoreOptions] = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        document = read_run(self.result)
        if "edit" in document:
            raise InputError(
                f"{self.result} is an edited run, whose objects no photo shows as they are; search its source, "
                f"{document['edit']['source']}."
            )
        run = open_run(self.result, self.store, ("describe",))
        store, descriptors = run.store, tuple(document["results"]["describe"])
        params = query_params(document)
        if self.tau_corr is not None:
            params = replace(params, tau_corr=self.tau_corr)
        if not 0 < params.tau_corr <= 2:
            raise InputError(f"--tau-corr {params.tau_corr} is out of range; it must be above 0 and at most 2.")
        if self.top_k is not None:
            if self.top_k < 1 or self.tau_corr is not None:
                raise InputError("--top-k takes a whole number from 1 on, and takes the place of --tau-corr.")
            params = replace(params, select="topk", top_k=self.top_k)
        if self.out is not None:
            check_place(self.out, ANSWER_FILE)
        digests = file_digests(store)
        encoder = choose_model("text-image", encoder_name(store, descriptors), digests)
        digests.save()
        answers: list[QueryResult] = []
        request = Request(
            lambda: {
                "query": query(
                    stored("describe", descriptors),
                    text=self.text,
                    params=params,
                    encoder=encoder,
                    background=self.background,
                )
            },
            document["scene"],
            done=lambda report: answers.append(_answer(store, report.values["query"])),
        )
        run_flows([request], store, recorded=False)
        answer = _document(answers[-1], run.instances)
        if self.out is not None:
            write_answer(self.out, self.result, answer)
        self._tell(answers[-1], answer)
        return 0

    def _tell(self, found: QueryResult, document: dict[str, Any]) -> None:
        if self.json:
            print(json.dumps(document))
            return
        out = console(json=False)
        if not found.accepted:
            out.print(f"nothing in the scene matches {found.text!r} ({found.encoder}); the nearest are:")
        table = Table("", "id", "name", "score", "delta", box=None)
        for row in document["instances"][:10]:
            mark = "[green]match[/]" if row["matched"] else ""
            table.add_row(mark, str(row["id"]), row["name"], f"{row['score']:.3f}", f"{row['delta']:.3f}")
        out.print(table)


def query_params(document: dict[str, Any]) -> QueryParams:
    """How a run searches, from its run.json."""
    own = {f.name: document["params"].get(f"semantics.query.{f.name}", f.default) for f in fields(QueryParams)}
    return QueryParams(**own)


def _document(found: QueryResult, instances: dict[str, Any]) -> dict[str, Any]:
    """What --json prints."""
    names = {entry["id"]: entry["name"] for entry in instances["instances"]}
    rows = [
        {
            "id": int(found.instance_id[i]),
            "name": names.get(int(found.instance_id[i]), ""),
            "score": round(float(found.score[i]), 4),
            "delta": round(float(found.delta[i]), 4),
            "matched": bool(found.matched[i]),
        }
        for i in range(len(found.instance_id))
    ]
    return {"text": found.text, "encoder": found.encoder, "instances": rows}


def write_answer(folder: Path, result: Path, document: dict[str, Any]) -> None:
    """Write the folder of an answer: answer.json, answer.ply, and a mask of 0 and 255 for every photo.

    result: the output folder of the run. document: what --json prints.
    """
    import cv2
    import numpy as np

    from ss_flow.tasks.deliver.ply import write_gaussians
    from ss_flow.tasks.gaussians.initialise import select
    from ss_flow.tasks.gaussians.read_ply import read_gaussians
    from ss_flow.tasks.geometry.images import encode_png

    ids = [row["id"] for row in document["instances"] if row["matched"]]
    scene = read_gaussians(result / "scene_labeled.ply")
    with replacing(folder) as filling:
        write_gaussians(filling / "answer.ply", select(scene, np.isin(scene.instance_id, ids)), labelled=True)
        (filling / "masks").mkdir()
        for file in sorted((result / "masks").glob("*.png")):
            matched = np.isin(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), ids)
            (filling / "masks" / file.name).write_bytes(encode_png(np.uint8(255) * matched).tobytes())
        (filling / ANSWER_FILE).write_text(json.dumps(document, indent=1), encoding="utf-8")


def _answer(store: Store, value: Value | Failure) -> QueryResult:
    if isinstance(value, Failure):
        raise value.error
    assert isinstance(value, str)
    found: QueryResult = store.get(value)
    return found


def encoder_name(store: Store, descriptors: Sequence[str]) -> str:
    """The network that described the instances, which must also read the text."""
    from ss_flow.tasks.models.colour_words import ColourWords

    name = store.get(descriptors[0]).encoder if descriptors else ColourWords.name
    return "none" if name == ColourWords.name else str(name)
