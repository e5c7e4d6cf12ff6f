"""Draw the pictures of troubleshooting.md: what faults look like, and what mends them.

`python docs/make_symptoms.py granularity|depth CAPTURE VIEW FILE.jpg --cache DIR`, where VIEW is the name of a photo.
Preset `fast`, up to the masks after Split; what is in the store is not computed again. `granularity`: the photo, and
its masks at three values of split.granularity. `depth`: edges of measured depth on the photo, as they are with a wrong
focal length, and as they should be.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ss_flow.cache.location import open_store
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import DepthMap, Frame, UInt8
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.deliver.palette import paint_ids

WIDTH = 420
"""Of one picture, pixels."""
GAP = 6
WRONG_FOCAL = 1.12
"""A depth sensor's focal length over that of its camera, where the capture says that they are the same."""


def results(capture: Path, granularity: float, store: Store, *names: str) -> dict[str, Any]:
    """Some results of a run, of all views."""
    params = settings.apply(settings.preset(Params(), "fast"), [f"split.granularity={granularity}"])
    run = prepare(open_scene(capture), params, RunOptions(), file_digests(store))

    def build() -> dict[str, Any]:
        outputs = run.build()
        return {name: outputs[name] for name in names}

    values = run_flow(build, store, scene=run.name, header={}).values
    return {name: [store.get(digest) for digest in digests] for name, digests in values.items()}


def photo_of(frame: Frame) -> UInt8:
    return cv2.cvtColor(cv2.imdecode(frame.encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def outlined(photo: UInt8, depth: DepthMap, zoom: float) -> UInt8:
    """The photo with the edges of its depth in red; zoom: by how much the depth is too large."""
    height, width = photo.shape[:2]
    middle = (width / 2, height / 2)
    known = cv2.resize(depth.depth, (width, height), interpolation=cv2.INTER_NEAREST)
    known = cv2.warpAffine(known, cv2.getRotationMatrix2D(middle, 0, zoom), (width, height), flags=cv2.INTER_NEAREST)
    smooth = cv2.medianBlur(known, 5)
    jump = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)) > 0.15 * smooth
    red = cv2.dilate((jump & (smooth > 0)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.where(red[..., None], np.uint8([230, 20, 20]), photo // 2 + 100)


def save(pictures: list[UInt8], file: Path) -> None:
    """The pictures side by side, as a JPEG."""
    height = WIDTH * pictures[0].shape[0] // pictures[0].shape[1]
    small = [cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA) for picture in pictures]
    gap = np.full((height, GAP, 3), 255, np.uint8)
    row = np.hstack([part for picture in small for part in (picture, gap)][:-1])
    cv2.imwrite(str(file), cv2.cvtColor(row, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("granularity", "depth"))
    parser.add_argument("capture", type=Path)
    parser.add_argument("view")
    parser.add_argument("file", type=Path)
    parser.add_argument("--cache", required=True)
    args = parser.parse_args()
    store = open_store(args.cache)
    depth = results(args.capture, 1.0, store, "ingest", "depth")
    number = [frame.name for frame in depth["ingest"]].index(args.view)
    photo = photo_of(depth["ingest"][number])
    if args.what == "depth":
        save([outlined(photo, depth["depth"][number], zoom) for zoom in (WRONG_FOCAL, 1.0)], args.file)
        return
    cuts = [results(args.capture, granularity, store, "masks_split")["masks_split"] for granularity in (1.0, 0.45, 0.2)]
    save([photo, *(paint_ids(cut[number].ids, photo) for cut in cuts)], args.file)


if __name__ == "__main__":
    main()
