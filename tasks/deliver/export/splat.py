""".splat: 32 bytes a Gaussian, for the web viewers that came first."""

from __future__ import annotations

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver.export.content import FileContent, base_colors, levels

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


@task(name="deliver.export.splat")
def splat(gaussians: Gaussians) -> FileContent:
    """Mean, standard deviations, colour and opacity, quaternion w x y z (of 128 levels a unit); no harmonics.

    Rows come by falling volume times opacity, so that what is loaded first shows most.
    """
    rows = np.zeros(len(gaussians), _ROW)
    rows["mean"] = gaussians.means
    rows["scale"] = np.exp(gaussians.log_scales)
    rows["rgba"][:, :3] = levels(base_colors(gaussians), 8)
    rows["rgba"][:, 3] = levels(gaussians.opacities, 8)
    rows["rotation"] = np.clip(np.rint(gaussians.unit_quaternions * 128 + 128), 0, 255)
    weight = gaussians.log_scales.sum(axis=1, dtype=np.float64) + np.log(gaussians.opacities)
    return FileContent.of(rows[np.argsort(-weight, kind="stable")].tobytes())
