"""How clean reconstructed objects are: dark fringes, floaters, and what taking one away changes elsewhere.

None of these needs ground truth; each is a share or a difference that is 0 for a perfect object.
"""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Gaussians
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.clustering import nearest_spacing

_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
_FAINTEST = 0.05
"""Alpha from which a pixel shows the object at all."""
_RIM = 3
"""Pixels from the outline inwards that count as the object's rim."""
_REACH = 8
"""Pixels over which the inside lends its darkest tone to the rim."""
_DARKER = 0.5
"""A fringe has less than this share of that tone."""


def dark_fringe(rgb: Float32, alpha: Float32) -> Bool:
    """The pixels of an object's rim that are far darker than anything inside near them.

    rgb: [H, W, 3] of the object alone before black; alpha: [H, W]. Before any bright colour, such as magenta, these
    pixels show as a dark line: the traces of a training that took black for the object's surroundings. The object's
    own tone at the rim is rgb / alpha; the tone inside is the darkest luminance of the solid pixels within 8 pixels.
    Returns [H, W].
    """
    import cv2

    shown = alpha >= _FAINTEST
    solid = (alpha >= 0.95).astype(np.uint8)
    inside = cv2.erode(solid, np.ones((2 * _RIM + 1,) * 2, np.uint8), borderValue=1) > 0
    tone = (rgb @ _LUMA) / np.maximum(alpha, _FAINTEST)
    far = np.float32(np.finfo(np.float32).max)
    darkest = cv2.erode(np.where(inside, tone, far), np.ones((2 * _REACH + 1,) * 2, np.uint8), borderValue=float(far))
    return shown & ~inside & (darkest < far) & (tone < _DARKER * darkest)


def fringe_share(gaussians: Gaussians, camera: Camera) -> tuple[int, int]:
    """Pixels with a dark fringe, and all pixels that show the object: counts, to be summed over views."""
    rendering = render(gaussians, camera)
    return int(dark_fringe(rendering.rgb, rendering.alpha).sum()), int((rendering.alpha >= _FAINTEST).sum())


def floaters(gaussians: Gaussians, points: Float32, spacings: float = 3.0) -> Bool:
    """[N] which Gaussians lie farther than so many spacings from all labelled points of their instance.

    points: [M, 3] world; their spacing is the median distance to the nearest other. Without two points none is a
    floater.
    """
    from scipy.spatial import cKDTree

    if len(points) < 2 or not len(gaussians):
        return np.zeros(len(gaussians), bool)
    distance, _ = cKDTree(points).query(gaussians.means, workers=1)
    return np.asarray(distance > spacings * nearest_spacing(points))


def change_elsewhere(scene: Gaussians, instance_id: int, camera: Camera, mask: Bool) -> float:
    """What taking an instance out of a scene changes outside its mask: the mean absolute difference, 0..1.

    mask: [H, W] where the instance is seen. 0 where the mask covers the whole view.
    """
    rest = select(scene, scene.instance_id != instance_id)
    elsewhere = ~mask
    if not elsewhere.any():
        return 0.0
    before, after = (np.clip(render(some, camera).rgb, 0, 1) for some in (scene, rest))
    return float(np.abs(before - after)[elsewhere].mean())
