"""How clean reconstructed objects are, and whether they hold from where no photo was taken.

Dark fringes, floaters, needles, and what taking an object away changes elsewhere need no ground truth; each is a share
or a difference that is 0 for a perfect object. `Likeness` compares with the true object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64, Gaussians
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, looking, up_of
from ss_flow.tasks.geometry.clustering import nearest_spacing
from ss_flow.tasks.geometry.sampling import sphere

_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
_FAINTEST = 0.05
"""Alpha from which a pixel shows the object at all."""
_RIM = 3
"""Pixels from the outline inwards that count as the object's rim."""
_REACH = 8
"""Pixels over which the inside lends its darkest tone to the rim."""
_DARKER = 0.5
"""A fringe has less than this share of that tone."""
_NEEDLE = 10.0
"""A needle is longer than so many times its second axis."""
_DIRECTIONS = 4000
"""Directions that new views are chosen from: 3 degrees from one to the next."""


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


def needles(gaussians: Gaussians) -> Bool:
    """[N] which Gaussians are more than ten times as long as they are wide; discs are none."""
    _, second, longest = np.sort(gaussians.log_scales, axis=1).T
    return np.asarray(longest - second > np.log(_NEEDLE))


def cameras_beside(
    cameras: Sequence[Camera], centre: Float64, radius: float, *, degrees: float = 35.0, count: int = 8
) -> list[Camera]:
    """Views of an object from directions that are so far off all directions it was seen from.

    cameras: those that see the object, at least one. centre: [3] of the object, radius: of a sphere around it that
    shows whole, world units. The new views stand at the median distance of the cameras, upright like these and with
    their focal length. They are spread as far as the directions allow: each is the one farthest from those before,
    the first the nearest to the mean direction. None where no direction is that far off.
    """
    seen = np.stack([camera.center - centre for camera in cameras])
    distances = np.linalg.norm(seen, axis=1)
    seen /= distances[:, None]
    directions = sphere(_DIRECTIONS)
    off = np.degrees(np.arccos(np.clip((directions @ seen.T).max(axis=1), -1, 1)))
    ring = directions[np.abs(off - degrees) < 2]
    if not len(ring):
        return []
    chosen = [int((ring @ seen.mean(axis=0)).argmax())]
    while len(chosen) < min(count, len(ring)):
        chosen.append(int((ring @ ring[chosen].T).max(axis=1).argmin()))
    up = up_of([camera.world_to_camera for camera in cameras])
    distance = max(float(np.median(distances)), 1.5 * radius)
    focal = float(np.median([camera.fx for camera in cameras]))
    return [_looking(centre, distance * ring[i], up, radius, focal) for i in chosen]


def _looking(centre: Float64, offset: Float64, up: Float64, radius: float, focal: float) -> Camera:
    """The camera at centre + offset that shows a sphere around `centre` whole."""
    distance = float(np.linalg.norm(offset))
    pose = looking(centre + offset, -offset / distance, up)
    half = int(np.ceil(focal * radius / np.sqrt(distance**2 - radius**2))) + 2
    return Camera(2 * half, 2 * half, focal, focal, half, half, pose)


@dataclass(frozen=True)
class Likeness:
    """How like the true object a reconstructed one looks; likenesses of several views are added up."""

    error: float = 0.0
    """Sum of the squared differences of colour, 0..1 a channel, where either of them is."""
    channels: int = 0
    """Number of such pixels times 3."""
    both: int = 0
    """Pixels that both cover by more than half."""
    either: int = 0
    """Pixels that at least one covers by more than half."""

    @classmethod
    def of(cls, rgb: Float32, alpha: Float32, true_rgb: Float32, true_alpha: Float32, counted: Bool) -> Likeness:
        """One view. rgb, true_rgb: [H, W, 3] before black; alpha, true_alpha: [H, W]; counted: [H, W] pixels that
        count. Colours are compared before white, in which a hole shows and so does a dark fringe."""
        shown, real = alpha > 0.5, true_alpha > 0.5
        union = (shown | real) & counted
        before_white = np.clip(rgb + 1 - alpha[..., None], 0, 1) - (true_rgb + 1 - true_alpha[..., None])
        error = float(np.square(before_white[union], dtype=np.float64).sum())
        return cls(error, 3 * int(union.sum()), int((shown & real & counted).sum()), int(union.sum()))

    def __add__(self, other: Likeness) -> Likeness:
        return Likeness(
            self.error + other.error,
            self.channels + other.channels,
            self.both + other.both,
            self.either + other.either,
        )

    @property
    def psnr(self) -> float:
        """dB; 100 at most."""
        return -10 * float(np.log10(max(self.error / max(self.channels, 1), 1e-10)))

    @property
    def iou(self) -> float:
        """Of the two outlines; 1 where there is nothing to see."""
        return self.both / self.either if self.either else 1.0
