"""Which named objects each text-image encoder finds in a finished run: strict LERF scores and ranks.

    python tests/bench/bench_queries.py RUN CAPTURE [--encoder imagenet-class-names ...]

RUN is the output folder of a run of CAPTURE, which has `label/NAME.json` (LERF-OVS polygons). The instances are
described anew by each encoder, from the run's refined masks. A category is searched by its name; what is found is
compared, frame by frame, with the union of its polygons (spec 2.2, strict). The rank is that of the instance which
covers the category best over all frames. "truth" finds each category's own polygons and has to score 1, "shuffled"
those of the next category and has to score near 0.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from ss_flow.cache.location import open_store
from ss_flow.errors import InputError
from ss_flow.flows.results import FinishedRun, finished_run, read_run
from ss_flow.tasks.artifacts import Bool
from ss_flow.tasks.evaluate.openvocab import LabelledFrame, labelled_frame, strict_ious, strict_scores, strict_targets
from ss_flow.tasks.masks.overlap import iou
from ss_flow.tasks.models.catalogue import find
from ss_flow.tasks.semantics.describe import describe
from ss_flow.tasks.semantics.query import QueryResult, query

Finder = Callable[[LabelledFrame, str], Bool | None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--encoder", nargs="*", default=["none", "imagenet-class-names"], help="none = colour words")
    options = parser.parse_args()
    document = read_run(options.run)
    run = finished_run(options.run, document, open_store(Path(document["store"])), ("ingest", "refine"))
    files = sorted((options.capture / "label").glob("*.json"))
    frames = [labelled_frame(json.loads(file.read_text()), file.name) for file in files]
    ids = {frame.name: _ids(options.run, frame) for frame in frames}
    categories = list(dict.fromkeys(category for frame in frames for category, _ in frame.polygons))
    best = {category: _best(category, frames, ids) for category in categories}

    following = dict(zip(categories, categories[1:] + categories[:1], strict=True))
    tell("truth", frames, lambda frame, category: strict_targets(frame)[category])
    tell("shuffled", frames, lambda frame, category: strict_targets(frame).get(following[category]))
    covers = {category: f"{category} {overlap:.2f} (instance {i})" for category, (i, overlap) in best.items()}
    print(f"best instances: {', '.join(covers.values())}")
    tell("best instances", frames, lambda frame, category: ids[frame.name] == best[category][0])
    for name in options.encoder:
        answers = search(run, name, categories)
        for category, answer in answers.items():
            if answer is None:
                print(f"  {category}: cannot be read")
                continue
            order = answer.instance_id.tolist()
            rank = order.index(best[category][0]) + 1
            print(f"  {category}: found {answer.matches()}, the true one is number {rank} of {len(order)}")

        def found(frame: LabelledFrame, category: str, answers: dict[str, QueryResult | None] = answers) -> Bool | None:
            answer = answers[category]
            return None if answer is None else np.isin(ids[frame.name], answer.matches())

        tell("colour words" if name == "none" else name, frames, found)


def search(run: FinishedRun, name: str, categories: list[str]) -> dict[str, QueryResult | None]:
    """The answer to each category; None where the encoder cannot read it."""
    model = None if name == "none" else find(name)
    if model is None and name != "none":
        raise SystemExit(f"the weights of {name!r} are not on this machine")
    frames = tuple(run.results.all("ingest"))
    described = tuple(describe(frames, instance, encoder=model) for instance in run.results.all("refine"))
    answers: dict[str, QueryResult | None] = {}
    for category in categories:
        try:
            answers[category] = query(described, text=category, encoder=model)
        except InputError:
            answers[category] = None
    return answers


def tell(name: str, frames: list[LabelledFrame], found: Finder) -> None:
    scores = []
    for frame in frames:
        predicted = {category: found(frame, category) for category in strict_targets(frame)}
        scores.append(strict_ious(frame, {k: mask for k, mask in predicted.items() if mask is not None}))
    total = strict_scores(scores)
    print(f"{name}: strict mIoU {100 * total['miou']:.1f}, mAcc(25) {100 * total['macc25']:.1f}", flush=True)


def _ids(run: Path, frame: LabelledFrame) -> np.ndarray:
    """The ids of the run's finished masks on a labelled photo."""
    ids = cv2.imread(str(run / "masks" / f"{Path(frame.name).stem}.png"), cv2.IMREAD_UNCHANGED)
    if ids is None or ids.shape != (frame.height, frame.width):
        raise SystemExit(f"the run has no mask of {frame.name} in that photo's own size")
    return ids


def _best(category: str, frames: list[LabelledFrame], ids: dict[str, np.ndarray]) -> tuple[int, float]:
    """The instance with the highest IoU with a category over all frames that show it, and that IoU."""
    seen = [(strict_targets(frame)[category], ids[frame.name]) for frame in frames if category in strict_targets(frame)]
    targets = np.concatenate([target.ravel() for target, _ in seen])
    painted = np.concatenate([image.ravel() for _, image in seen])
    overlaps = {int(i): iou(painted == i, targets) for i in np.unique(painted[targets])}
    return max(overlaps.items(), key=lambda pair: pair[1])


if __name__ == "__main__":
    main()
