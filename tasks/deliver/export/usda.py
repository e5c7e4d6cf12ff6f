"""OpenUSD's text form: a `ParticleField3DGaussianSplat` prim for each instance (OpenUSD 26.03 and later)."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from ss_flow.running import progress
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, Gaussians
from ss_flow.tasks.deliver.export.content import FileContent, name_of, y_up
from ss_flow.tasks.gaussians.initialise import select

_HEAD = """#usda 1.0
(
    defaultPrim = "Scene"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Scene"
{{
    quatf xformOp:orient = {turn}
    uniform token[] xformOpOrder = ["xformOp:orient"]
"""
_PRIM = """
    def ParticleField3DGaussianSplat "instance_{id:04d}" (
        customData = {{
            int instance_id = {id}
        }}
        displayName = {name}
    )
    {{
        float3[] extent = {extent}
        point3f[] positions = {positions}
        quatf[] orientations = {orientations}
        float3[] scales = {scales}
        float[] opacities = {opacities}
        uniform int radiance:sphericalHarmonicsDegree = {degree}
        float3[] radiance:sphericalHarmonicsCoefficients = {coefficients}
        uniform token projectionModeHint = "perspective"
        uniform token sortingModeHint = "cameraDistance"
    }}
"""


@task(name="deliver.export.usda")
def usda(gaussians: Gaussians, cameras: Cameras, *, names: Mapping[str, str]) -> FileContent:
    """The file, with all that the Gaussians hold; labels are prims, part ids are lost.

    names: of the instances, by their ids as text.
    """
    ids = np.unique(gaussians.instance_id).tolist()
    x, y, z, w = y_up(cameras)
    parts = [_HEAD.format(turn=_tuples(np.array([[w, x, y, z]]))[1:-1])]
    for done, instance_id in enumerate(ids):
        progress(done, len(ids), f"instance {instance_id}")
        own = select(gaussians, gaussians.instance_id == instance_id)
        reach = 3 * np.exp(own.log_scales.max(axis=1, keepdims=True))
        parts.append(
            _PRIM.format(
                id=instance_id,
                name=_string(name_of(instance_id, names)),
                extent=_tuples(np.stack([(own.means - reach).min(axis=0), (own.means + reach).max(axis=0)])),
                positions=_tuples(own.means),
                orientations=_tuples(own.unit_quaternions),
                scales=_tuples(np.exp(own.log_scales)),
                opacities=_tuples(own.opacities.astype(np.float32)),
                degree=own.sh_degree,
                coefficients=_tuples(own.sh.reshape(-1, 3)),
            )
        )
    return FileContent.of("".join(parts).encode(), b"}\n")


def _string(text: str) -> str:
    """A string in quotes, with USD's escapes."""
    escaped = re.sub(r'["\\]', r"\\\g<0>", text)
    return '"' + re.sub(r"[\x00-\x1f]", lambda control: f"\\x{ord(control[0]):02x}", escaped) + '"'


def _tuples(rows: np.ndarray) -> str:
    """Numbers, or rows of them, as a list that gives the same float32 back."""
    one = "%.9g" if rows.ndim == 1 else f"({', '.join(['%.9g'] * rows.shape[1])})"
    return f"[{', '.join([one] * len(rows)) % tuple(rows.ravel().tolist())}]"
