"""What Split finds without a sensor's depth, held against what it finds with it.

    python tests/bench/bench_sensorless.py CAPTURE [--preset fast] [--set STEP.PARAM=VALUE ...] [--store DIR]

CAPTURE has a sensor's depth. It is run until Split's masks with that depth and with depth from comparing views
(`capture.depth=mvs`), all else being equal; and, since chance has a say, with the sensor's and a tenth fewer points.
Printed of the two latter: the mean IoU, over all views, of each instance found with the sensor and its best partner
(several may share one); the same of those that fill more than 0.1 % of all pixels; and the agreement as `ss-flow diff`
gives it, one to one over the instances of both.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from bench_masks import masks_of

from ss_flow.cache.store import Store
from ss_flow.flows import settings
from ss_flow.flows.params import Params
from ss_flow.tasks.evaluate.comparison import correspondence
from ss_flow.tasks.evaluate.contingency import contingency


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--store", type=Path, help="a store to keep")
    options = parser.parse_args()
    params = settings.apply(settings.preset(Params(), options.preset), options.set)
    fewer = f"split.dense.max_points={params.split.dense.max_points * 9 // 10}"
    runs = {
        "with the sensor": ["capture.depth=sensor"],
        "without": ["capture.depth=mvs"],
        "a tenth fewer points": ["capture.depth=sensor", fewer],
    }
    with tempfile.TemporaryDirectory() as temporary:
        store, found = Store(options.store or Path(temporary)), []
        for changes in runs.values():
            (views,) = masks_of(options.capture, settings.apply(params, changes), store, ["masks_split"])
            found.append(np.stack([view.ids for view in views]))
    for name, other in zip(list(runs)[1:], found[1:], strict=True):
        tell(name, found[0], other)


def tell(name: str, with_sensor: np.ndarray, other: np.ndarray) -> None:
    """A line on two runs' ids, [views, H, W] each."""
    table = contingency(with_sensor, other).without(truth=0, predicted=0)
    best, large = table.best_iou(), table.truth_area > 0.001 * with_sensor.size
    one_to_one = correspondence(zip(with_sensor, other, strict=True))
    print(f"{name}: {one_to_one.num_second} instances beside {one_to_one.num_first};", end=" ")
    print(f"best IoU {best.mean():.3f}, of the {large.sum()} large ones {best[large].mean():.3f};", end=" ")
    print(f"one to one {one_to_one.agreement:.3f}")


if __name__ == "__main__":
    main()
