"""What adaptive prompting saves and what it loses: prompts, CPU seconds a view, and agreement with the full grids.

    python tests/bench/bench_segment.py CAPTURE [--views 15] [--models DIR]

A folder of photos is segmented as the preset "default" does it, and again with every point of every grid. Agreement:
for each mask of the full grids that covers more than 1 % of its image, the best IoU with a mask of the adaptive ones.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Float32, Frame, MaskSet
from ss_flow.tasks.capture.ingest import IngestParams, frames
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.geometry.images import decode_rgb
from ss_flow.tasks.models import sam as network
from ss_flow.tasks.models.catalogue import Model, available, blake3_of, default_folders, find
from ss_flow.tasks.split import segment as step

LARGE = 0.01
"""Share of the image from which a mask counts."""


class CountingImage(network.PromptedImage):
    """Counts prompts, and the CPU seconds that they and what they share take."""

    prompts, seconds = 0, 0.0

    def __init__(self, *args):
        begun = time.process_time()
        super().__init__(*args)
        CountingImage.seconds += time.process_time() - begun

    def predict(self, points, labels=None):
        begun = time.process_time()
        answer = super().predict(points, labels)
        CountingImage.seconds += time.process_time() - begun
        CountingImage.prompts += len(points)
        return answer


def load(path: Path, count: int) -> list[Frame]:
    """So many frames of a folder of photos, evenly spread; all of them for 0."""
    scene = open_scene(path)
    stride = max(1, len(scene.names) // count) if count else 1
    chosen = slice(0, stride * (count or len(scene.names)), stride)
    photos, valid = (tuple(FileRef(p, blake3_of(p)) if p else None for p in of) for of in (scene.photos, scene.valid))
    return list(
        frames(
            names=scene.names[chosen],
            photos=photos[chosen],
            valid=valid[chosen],
            lenses=scene.lenses[chosen] if scene.lenses else None,
            params=IngestParams(),
        )
    )


def first_segmenter(folder: Path | None) -> Model | None:
    """The first segmenter of a folder of models, or of the usual ones; None where there is none."""
    folders = [folder] if folder else default_folders()
    names = [entry.name for entry in available("segmenter", folders)]
    return find(names[0], folders) if names else None


def best_iou(masks: MaskSet, others: MaskSet) -> Float32:
    """For each large mask the best IoU with any of the others."""
    one, other = (m.dense().reshape(len(m), -1).astype(np.float32) for m in (masks, others))
    one = one[one.mean(axis=1) > LARGE]
    shared = one @ other.T
    union = one.sum(axis=1)[:, None] + other.sum(axis=1)[None] - shared
    best: Float32 = np.max(shared / union, axis=1, initial=0)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--views", type=int, default=0, help="so many, evenly spread; 0 = all")
    parser.add_argument("--models", type=Path, help="a folder of models; by default SS_FLOW_MODELS")
    options = parser.parse_args()
    model = first_segmenter(options.models)
    if model is None:
        parser.error("no segmenter is here; see `ss-flow models list`")
    network.PromptedImage = CountingImage
    adaptive = step.SegmentParams()
    variants = {"adaptive": adaptive, "full": replace(adaptive, adaptive=False)}
    views = load(options.capture, options.views)

    sam = network.Sam(model)
    encoding = 0.0
    spent: dict[str, list[tuple[int, float, float, int]]] = {name: [] for name in variants}
    there, back = [], []
    for view in views:
        begun = time.process_time()
        embedding = sam.encode(decode_rgb(view))
        encoding += time.process_time() - begun
        pools = {}
        for name, params in variants.items():
            CountingImage.prompts, CountingImage.seconds = 0, 0.0
            begun = time.process_time()
            pools[name] = step.segment(view, embedding, params=params, model=model)
            rest = time.process_time() - begun - CountingImage.seconds
            spent[name].append((CountingImage.prompts, CountingImage.seconds, rest, len(pools[name])))
        there.append(best_iou(pools["full"], pools["adaptive"]))
        back.append(best_iou(pools["adaptive"], pools["full"]))
        line = ", ".join(f"{name} {rows[-1][0]} prompts {rows[-1][3]} masks" for name, rows in spent.items())
        print(f"{view.name}: {line}, best IoU {there[-1].mean():.3f}", flush=True)

    print(f"\n{len(views)} views of {options.capture.name}, {model.name}; load {os.getloadavg()[0]:.1f}")
    print(f"CPU seconds a view: encoder {encoding / len(views):.2f}")
    for name, rows in spent.items():
        prompts, decoder, rest, masks = np.mean(rows, axis=0)
        print(
            f"{name:8s} {prompts:5.1f} prompts, decoder {decoder:.2f} s, filters and merging {rest:.2f} s a view; "
            f"{masks:.1f} masks"
        )
    for title, values in (("full in adaptive", there), ("adaptive in full", back)):
        best = np.concatenate(values)
        worst = min((v.mean() for v in values if len(v)), default=0.0)
        print(
            f"{title}: mean best IoU {best.mean():.3f}, above 0.9 {np.mean(best > 0.9):.3f}, "
            f"worst view {worst:.3f}, {len(best)} masks over {LARGE:.0%} of the image"
        )


if __name__ == "__main__":
    main()
