"""Whether a capture's photos lie on their side, as a phone or a camera on its side stores them where nobody turns them.

Who walks round a thing, or turns on the spot, turns about the plumb line; and looks down on things more than up. Where
that line runs across the photos instead of up and down, they lie.
"""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Float64

_SAMPLE = 48
"""So many views tell."""
_TURNED = np.radians(20)
"""How far views must be turned from one another about the line (root mean square) for it to be known."""
_CLEAR = 3.0
"""How many times as much as about any line across it, counted in squares."""
_ALONG = 0.7
"""How far along the line the photos' rows must run (cosine), and how much farther than their columns."""
_DOWN = 0.2
"""How far down the photos must look (sine), all together and most of them."""


def quarter_turns(poses: Float64) -> int:
    """By how many quarters, counterclockwise, photos must be turned to stand upright: 1 or 3; 0 where they do, or where
    their poses do not tell.

    poses: [K, 4, 4] world to camera. Photos that are upside down are not found out: they may as well look up.
    """
    axes = np.asarray(poses)[:: max(1, -(-len(poses) // _SAMPLE)), :3, :3]
    i, j = np.triu_indices(len(axes), 1)
    if not len(i):
        return 0
    strength, lines = np.linalg.eigh(_turned_about(np.einsum("kji,kjl->kil", axes[j], axes[i])))
    if strength[2] < _TURNED**2 or strength[2] < _CLEAR * strength[1]:
        return 0
    across, along, ahead = (axes @ lines[:, 2]).T
    rows, columns = np.abs(across).mean(), np.abs(along).mean()
    if rows < _ALONG or rows < columns + _ALONG / 2 or abs(across.mean()) < _ALONG:
        return 0
    down = ahead.mean()
    if abs(down) < _DOWN or (ahead * np.sign(down) > 0).mean() < 0.75:
        return 0
    # Up lies against the line where the photos look along it.
    return 1 if across.mean() * down < 0 else 3


def _turned_about(rotations: Float64) -> Float64:
    """[3, 3] whose product with a line from both sides is the mean square, in radians, of the turns about that line.

    rotations: [M, 3, 3]. One by an angle t about a line a is, but for a part that is odd, cos t + (1 - cos t) a a^T.
    """
    cosine = np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1)
    angle = np.arccos(cosine)
    weight = np.divide(angle**2, 1 - cosine, out=np.full(len(angle), 2.0), where=cosine < 1)
    even = (rotations + rotations.transpose(0, 2, 1)) / 2 - cosine[:, None, None] * np.eye(3)
    return np.asarray((weight[:, None, None] * even).mean(axis=0))
