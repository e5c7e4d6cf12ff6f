"""`ss-flow query`: which instances a text means."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.flows import settings
from ss_flow.flows.cli.context import (
    InStore,
    OptionalCount,
    OptionalNumber,
    OptionalPath,
    StoreOptions,
    choose_model,
    console,
    file_digests,
    open_run,
)
from ss_flow.flows.cli.telling import print_table
from ss_flow.flows.query import NEEDED, described_parts, words_left_out
from ss_flow.flows.results import BACKGROUND, FinishedRun, not_of_an_edit, read_run
from ss_flow.tasks.artifacts import Bool, PartMasks
from ss_flow.tasks.capture.id_images import written_ids
from ss_flow.tasks.deliver.places import Written, check_replaceable, replacing_own, sizes
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.colour_words import ColourWords
from ss_flow.tasks.semantics.describe import DescribeParams
from ss_flow.tasks.semantics.query import QueryParams, QueryResult, query

ANSWER_FILE = "answer.json"
ANSWER = Written(ANSWER_FILE, "an earlier answer", frozenset({"answer.ply"}))
ROWS = 10
"""So many instances are named at least; all that match are."""


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
    tau_view: OptionalNumber = None
    """Cosine distance above which views of an object show different sides of it, each of which the text may mean; 0
    takes their mean alone; the run's own value when left out."""
    background: bool = False
    """Rank the background too, as if it were an object."""
    parts: bool = False
    """Rank the parts of the instances in the place of whole instances; the first time takes the longest, as every part
    is looked up in the photos."""
    out: OptionalPath = None
    """Also write a folder: answer.json, answer.ply (the instances or parts that match) and masks/ (where each photo
    shows them)."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        document = read_run(self.result)
        if "edit" in document:
            raise not_of_an_edit(self.result, document, "photos")
        if self.parts and self.background:
            raise InputError("--background is no part of anything; leave it or --parts out.")
        run = open_run(self.result, self.store, ("describe", *(NEEDED if self.parts else ())))
        params = self._params(document)
        if self.out is not None:
            check_replaceable(self.out, ANSWER, run.store.location)
        encoder = encoder_of(run)

        def build() -> dict[str, Any]:
            nodes, known = run.results.nodes(), {}
            descriptors = nodes["describe"]
            if self.parts:
                describing = settings.recorded(DescribeParams(), document["params"], "semantics.describe")
                turns = document["params"].get("capture.turns") or 0
                known["parts"], descriptors = described_parts(nodes, encoder, describing, turns)
            found = query(descriptors, text=self.text, params=params, encoder=encoder, background=self.background)
            return {"query": found, **known}

        answers: list[tuple[QueryResult, list[PartMasks] | None]] = []

        def read(report: Report) -> None:
            # Within the run, which finds anew what turns out to be damaged.
            made = report.succeeded()
            shown = [run.store.get(digest) for digest in made["parts"]] if self.parts else None
            answers.append((run.store.get(str(made["query"])), shown))

        try:
            run_flows([Request(build, document["scene"], done=read)], run.store, recorded=False)
        except InputError as error:
            own = next((name for name in run.names.values() if name.casefold() == self.text.casefold()), None)
            if own is None:
                raise
            raise InputError(f"{error} An instance has this name: export and render take --instance {own!r}.") from None
        found, shown = answers[-1]
        if self.parts and not len(found.instance_id):
            raise InputError(f"no photo shows a part of any instance of {self.result}; leave --parts out.")
        answer = _document(found, run.instances, parts=self.parts)
        if self.out is not None:
            write_answer(self.out, run, answer, shown)
        self._tell(found, answer)
        return 0

    def _params(self, document: dict[str, Any]) -> QueryParams:
        """How to search: as the run does, but for what the options say. Raises InputError."""
        params = query_params(document)
        if self.tau_corr is not None:
            params = replace(params, tau_corr=self.tau_corr)
        if not 0 < params.tau_corr <= 2:
            raise InputError(f"--tau-corr {params.tau_corr} is out of range; it must be above 0 and at most 2.")
        if self.tau_view is not None:
            params = replace(params, tau_view=self.tau_view)
        if not 0 <= params.tau_view <= 2:
            raise InputError(f"--tau-view {params.tau_view} is out of range; it must be 0 to 2.")
        if self.top_k is not None:
            if self.top_k < 1 or self.tau_corr is not None:
                raise InputError("--top-k takes a whole number from 1 on, and takes the place of --tau-corr.")
            params = replace(params, select="topk", top_k=self.top_k)
        return params

    def _tell(self, found: QueryResult, document: dict[str, Any]) -> None:
        if self.json:
            print(json.dumps(document))
            return
        out = console(json=False)
        if not found.accepted:
            nearest = "; the nearest are:" if document["instances"] else ": no instance was found in it."
            out.print(f"nothing in the scene matches {found.text!r} ({found.encoder}){nearest}")
        part = ["part"] if self.parts else []
        table = Table("", "id", *part, "name", "score", "delta", "", box=None)
        rows = document["instances"]
        shown = rows[: max(ROWS, 1 + max((i for i, row in enumerate(rows) if row["matched"]), default=0))]
        for row in shown:
            mark = "[green]match[/]" if row["matched"] else ""
            place = [str(row[column]) for column in ("id", *part)]
            where = "in masks only" if row["num_gaussians"] == 0 else ""  # export and render cannot show it
            table.add_row(mark, *place, row["name"], f"{row['score']:.3f}", f"{row['delta']:.3f}", where)
        print_table(table, out)
        if len(shown) < len(rows):
            out.print(f"{len(rows) - len(shown)} more are farther off; --json names all.")
        if lacking := words_left_out(found):
            out.print(lacking)


def query_params(document: dict[str, Any]) -> QueryParams:
    """How a run searches, from its run.json."""
    return settings.recorded(QueryParams(), document["params"], "semantics.query")


def _document(found: QueryResult, instances: dict[str, Any], *, parts: bool) -> dict[str, Any]:
    """What --json prints; with `parts`, each row says which part of its instance it is.

    num_gaussians is that of the whole instance; the background's is not known (null).
    """
    names = {BACKGROUND: "background"} | {entry["id"]: entry["name"] for entry in instances["instances"]}
    sizes = {entry["id"]: entry["num_gaussians"] for entry in instances["instances"]}
    rows = [
        {
            "id": int(found.instance_id[i]),
            **({"part": int(found.part_id[i])} if parts else {}),
            "name": names.get(int(found.instance_id[i]), ""),
            "score": round(float(found.score[i]), 4),
            "delta": round(float(found.delta[i]), 4),
            "matched": bool(found.matched[i]),
            "num_gaussians": sizes.get(int(found.instance_id[i])),
        }
        for i in range(len(found.instance_id))
    ]
    return {"text": found.text, "encoder": found.encoder, "instances": rows}


def write_answer(
    folder: Path, run: FinishedRun, document: dict[str, Any], parts: Sequence[PartMasks] | None = None
) -> None:
    """Write the folder of an answer: answer.json, answer.ply, and a mask of 0 and 255 for every photo.

    document: what --json prints; answer.json lists the other files, too. parts: where the frames show the parts, when
    parts were searched.
    """
    import numpy as np

    from ss_flow.tasks.deliver.ply import write_gaussians
    from ss_flow.tasks.gaussians.initialise import select
    from ss_flow.tasks.gaussians.read_ply import read_gaussians
    from ss_flow.tasks.geometry.images import encode_png

    matched = [row for row in document["instances"] if row["matched"]]
    wanted = {(row["id"], row.get("part", 0)) for row in matched}
    scene = read_gaussians(run.folder / "scene_labeled.ply")
    part_of = scene.part_id if parts is not None else np.zeros_like(scene.part_id)
    rows = [pair in wanted for pair in zip(scene.instance_id.tolist(), part_of.tolist(), strict=True)]
    photos = sorted((run.folder / "masks").glob("*.png"))
    masks: Iterator[Bool]
    if parts is None:
        ids = [row["id"] for row in matched]
        masks = (np.isin(written_ids(photo), ids) for photo in photos)
    else:
        shown = [part for part in parts if (part.instance_id, part.part_id) in wanted]
        masks = _on_photos(run, shown, [photo.stem for photo in photos])
    with replacing_own(folder, ANSWER) as filling:
        write_gaussians(filling / "answer.ply", select(scene, np.array(rows, bool)), labelled=True)
        (filling / "masks").mkdir()
        for photo, mask in zip(photos, masks, strict=True):
            (filling / "masks" / photo.name).write_bytes(encode_png(np.uint8(255) * mask).tobytes())
        listed = document | {"files": sizes(filling)}
        (filling / ANSWER_FILE).write_text(json.dumps(listed, indent=1), encoding="utf-8")


def _on_photos(run: FinishedRun, parts: Sequence[PartMasks], names: Sequence[str]) -> Iterator[Bool]:
    """[H, W] which pixels of each named photo show one of these parts."""
    import numpy as np

    from ss_flow.flows.deliver import photo_lenses
    from ss_flow.tasks.capture.photo_pixels import on_photo, photo_pixels
    from ss_flow.tasks.capture.scene import open_scene

    frames = {frame.name: frame for frame in run.results.all("ingest")}
    lenses = photo_lenses(list(frames.values()), run.results.one("cameras"), open_scene(Path(run.document["scene"])))
    lens_of = dict(zip(frames, lenses, strict=True))
    for name in names:
        frame, lens = frames[name], lens_of[name]
        own = [part.mask(part.views.index(name)) for part in parts if name in part.views]
        mask = np.any([np.zeros((frame.height, frame.width), bool), *own], axis=0)
        yield on_photo(mask.astype(np.uint8), frame, None if lens is None else photo_pixels(frame, lens)) > 0


def encoder_name(run: FinishedRun) -> str:
    """The network that described the instances, which must also read the text; "none" for colour words."""
    descriptors = run.results.digests["describe"]
    name = run.store.get(descriptors[0]).encoder if descriptors else ColourWords.name
    return "none" if name == ColourWords.name else str(name)


def encoder_of(run: FinishedRun) -> Model | None:
    """The same, ready to be used; None for colour words. Raises InputError when it is not on this machine."""
    with file_digests(run.store) as digests:
        return choose_model("text-image", encoder_name(run), digests)
