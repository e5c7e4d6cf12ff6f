"""What Split finds without a sensor's depth, held against what it finds with it.

    python tests/bench/bench_sensorless.py CAPTURE [--preset fast] [--set STEP.PARAM=VALUE ...] [--store DIR]

CAPTURE has a sensor's depth. It is run until Split's masks with that depth and with depth from comparing views
(`capture.depth=mvs`), all else being equal. Printed: the mean IoU, over all views, of each instance found with the
sensor and its best partner without (several may share one); the same of those that fill more than 0.1 % of all pixels;
and the agreement as `ss-flow diff` gives it, one to one over the instances of both.
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
    with tempfile.TemporaryDirectory() as temporary:
        store, found = Store(options.store or Path(temporary)), []
        for source in ("sensor", "mvs"):
            params = settings.apply(
                settings.preset(Params(), options.preset), [*options.set, f"capture.depth={source}"]
            )
            (views,) = masks_of(options.capture, params, store, ["masks_split"])
            found.append(np.stack([view.ids for view in views]))
    with_sensor, without = found
    table = contingency(with_sensor, without).without(truth=0, predicted=0)
    best, large = table.best_iou(), table.truth_area > 0.001 * with_sensor.size
    one_to_one = correspondence(zip(with_sensor, without, strict=True))
    print(f"{one_to_one.num_first} instances with the sensor, {one_to_one.num_second} without;", end=" ")
    print(f"best IoU {best.mean():.3f}, of the {large.sum()} large ones {best[large].mean():.3f};", end=" ")
    print(f"one to one {one_to_one.agreement:.3f}")


if __name__ == "__main__":
    main()
