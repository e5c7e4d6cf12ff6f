"""The lens of a photo: its intrinsics, and how to take its distortion out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Cameras, Float32, Float64, Frame, UInt8

_NOWHERE = -1e4
"""Where a map points for what no photo shows, pixels."""
_SCALED, _SAME_FACTOR = 1.3, 0.05
"""A principal point that lies so many times as far from the photo's upper and left borders as its middle does, or as
much nearer, is that of the photo at another size, where both tell nearly the same factor."""
_NEWTON_STEPS = 40
_NEWTON_CLOSE = 1e-6
"""Pixels of the photo."""
_NEWTON_SHORTEST = 1e-3
"""Share of Newton's step below which nothing nearer is to be found."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one photo as the capture states them, pixel centres at (i + 0.5, j + 0.5)."""

    width: int
    height: int
    """Size of the photo that the intrinsics refer to; 0, 0 when the capture does not say (then `of_photo` tells)."""
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """OpenCV's order: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4 of a fisheye; empty for a pinhole."""
    fisheye: bool = False
    turns: int = 0
    """Quarter turns, counterclockwise, that bring the photo, its depth too, from how they are stored to how they are
    seen here; all else is of the turned photo."""

    @property
    def pinhole(self) -> bool:
        """Whether straight lines stay straight."""
        return not self.fisheye and not any(self.distortion)

    def of_photo(self, width: int, height: int) -> tuple[float, float]:
        """The size that the intrinsics refer to, for a photo of such a size.

        Where the capture does not say, it is the photo's own, unless the principal point tells that the photo was
        scaled since: then that of a photo about whose middle it lies.
        """
        if self.width:
            return self.width, self.height
        x, y = 2 * self.cx / width, 2 * self.cy / height
        was_scaled = abs(x / y - 1) < _SAME_FACTOR and not 1 / _SCALED < x < _SCALED
        return (2 * self.cx, 2 * self.cy) if was_scaled else (width, height)

    def scaled(self, width: int, height: int) -> Lens:
        """The same lens for an image of another size (pixel borders map to pixel borders)."""
        own_width, own_height = self.of_photo(width, height)
        sx, sy = width / own_width, height / own_height
        focal, center = (self.fx * sx, self.fy * sy), (self.cx * sx, self.cy * sy)
        return Lens(width, height, *focal, *center, self.distortion, self.fisheye, self.turns)


def undistortion_map(lens: Lens) -> Float32:
    """Where each pixel of the undistorted image lies in the photo.

    The undistorted image is a pinhole's with the lens's own fx, fy, cx, cy and size, so that intrinsics stay as stated.
    Returns [H, W, 2] integer-centred (u, v), as `cv2.remap` takes them; far outside where the model has turned round,
    and shows once more, mirrored, what it showed nearer to the axis.
    """
    import cv2

    matrix = np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
    coefficients = np.array(lens.distortion or (0.0,) * 4)
    if lens.fisheye:
        size = (lens.width, lens.height)
        u, v = cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
    else:
        u, v = cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, (lens.width, lens.height), cv2.CV_32FC1)
    found = np.stack([u, v], axis=-1).astype(np.float32)
    x, y = (
        (np.arange(n) + 0.5 - c) / f for n, c, f in ((lens.width, lens.cx, lens.fx), (lens.height, lens.cy, lens.fy))
    )
    found[np.hypot(x, y[:, None]) >= _turning(lens)] = _NOWHERE
    return found


def _turning(lens: Lens) -> float:
    """The slope to the axis of the rays at which a lens's radial polynomial turns round or, divided by another, has its
    pole; infinite where it does not. Tangential distortion is left out, which is small."""
    if lens.fisheye:
        powers = np.arange(2 * len(lens.distortion) + 1, 0, -2)
        roots = np.roots([*reversed(lens.distortion), 1.0] * powers)
    else:
        k1, k2, _, _, k3, k4, k5, k6 = (*lens.distortion, *(0.0,) * (8 - len(lens.distortion)))
        above, below, twice = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([k6, k5, k4, 1.0]), np.poly1d([2.0, 0.0])
        slope = (above + twice * above.deriv()) * below - twice * above * below.deriv()
        roots = np.append(slope.roots, below.roots)
    square = np.min(roots.real[(roots.imag == 0) & (roots.real > 0)], initial=np.inf)
    if not lens.fisheye:
        return float(np.sqrt(square))
    return float(np.tan(np.sqrt(square))) if square < (np.pi / 2) ** 2 else np.inf


def photo_lens(frame: Frame, stated: Lens | None, cameras: Cameras) -> Lens | None:
    """The lens whose distortion was taken out of a frame, for the size of its input photo; None for a pinhole.

    stated: what the capture says, if anything; where that is no distortion, structure from motion may have found one
    (`Cameras.radial`). cameras: those of all frames.
    """
    lens = stated
    if (stated is None or stated.pinhole) and cameras.radial.size:
        lens = found_lens(cameras, cameras.names.index(frame.name))
    if lens is None or lens.pinhole:
        return None
    return lens.scaled(frame.source_width, frame.source_height)


def found_lens(cameras: Cameras, view: int) -> Lens:
    """The lens of the photo that a camera was estimated from, for the size of its frame; a pinhole unless structure
    from motion found a distortion."""
    width, height = cameras.sizes[view].tolist()
    fx, fy, cx, cy = cameras.intrinsics[view].tolist()
    radial = (float(cameras.radial[view]), 0.0, 0.0, 0.0) if cameras.radial.size else ()
    return Lens(width, height, fx, fy, cx, cy, radial)


def distorted(points: Float64, lens: Lens) -> Float64:
    """Where points of the undistorted image lie in the photo: [N, 2] x, y in pixels -> [N, 2] (OpenCV's models).

    cv2.projectPoints and cv2.fisheye.distortPoints do the same, the former much more slowly.
    """
    x, y = (points[:, 0] - lens.cx) / lens.fx, (points[:, 1] - lens.cy) / lens.fy
    square = x * x + y * y
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if lens.fisheye:
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            radial = np.polyval([*reversed(lens.distortion), 1.0], angle * angle) * angle / np.maximum(radius, 1e-12)
            bent_x, bent_y = x * radial, y * radial
        else:
            k1, k2, p1, p2, k3, k4, k5, k6 = (*lens.distortion, *(0.0,) * (8 - len(lens.distortion)))
            radial = np.polyval([k3, k2, k1, 1.0], square) / np.polyval([k6, k5, k4, 1.0], square)
            across = 2 * (p1 * y + p2 * x)
            bent_x, bent_y = x * (radial + across) + p2 * square, y * (radial + across) + p1 * square
    return np.column_stack([bent_x * lens.fx + lens.cx, bent_y * lens.fy + lens.cy])


def undistorted(points: Float64, lens: Lens) -> Float64:
    """Where points of the photo lie in the undistorted image: [N, 2] x, y in pixels -> [N, 2], NaN where none is found.

    Newton's method, as OpenCV's fixed-point iteration goes astray in strong distortion without telling. Where the model
    folds the image over (a polynomial that turns round), it starts from the side of the axis, as is meant.
    """
    found = np.full(points.shape, np.nan)
    rows, aim, place, share = np.arange(len(points)), points, points, np.ones(len(points))
    off = distorted(place, lens) - aim
    for _ in range(_NEWTON_STEPS):
        error = np.linalg.norm(off, axis=1)
        close = error < _NEWTON_CLOSE
        found[rows[close]] = place[close]
        left = ~close & (share > _NEWTON_SHORTEST)
        if not left.any():
            break
        rows, aim, place, share, off, error = (values[left] for values in (rows, aim, place, share, off, error))
        # The derivatives by x and y, and Newton's step by Cramer's rule.
        (a, c), (b, d) = ((distorted(place + by, lens) - aim - off).T / 1e-4 for by in ((1e-4, 0), (0, 1e-4)))
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.column_stack([d * off[:, 0] - b * off[:, 1], a * off[:, 1] - c * off[:, 0]])
            tried = place - step * (share / (a * d - b * c))[:, None]
        off_tried = distorted(tried, lens) - aim
        better = np.linalg.norm(off_tried, axis=1) < error
        place, off = np.where(better[:, None], tried, place), np.where(better[:, None], off_tried, off)
        share = np.where(better, np.minimum(1, 2 * share), share / 4)
    return found


def without_distortion(image: UInt8, keep: Bool, lens: Lens) -> tuple[UInt8, Bool]:
    """A photo as a pinhole of the same intrinsics would have taken it, and which of its pixels count.

    image: [H, W, 3]. keep: [H, W] which pixels of the photo count. Beyond the photo its border is repeated, as pixels
    that count mix with what lies half a pixel outside; nothing further out counts.
    """
    import cv2

    source = undistortion_map(lens)
    straight: UInt8 = cv2.remap(image, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    kept = cv2.remap(keep.astype(np.uint8), source, None, cv2.INTER_NEAREST) > 0
    return straight, kept & inside_source(source)


def inside_source(source_map: Float32) -> Bool:
    """[H, W] which pixels of an undistorted image the photo really shows."""
    height, width = source_map.shape[:2]
    u, v = source_map[..., 0], source_map[..., 1]
    return (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)


def depth_to_color_map(depth: Lens, color: Lens) -> Float32:
    """Where each pixel of a depth map registered to the colour camera lies in the depth camera's own image.

    Both cameras share their optical centre and axes, so z-depth carries over and only pixels move.
    depth: lens of the depth camera, with its size. color: lens of the colour photo, with its size.
    Returns [h, w, 2] integer-centred (u, v) at the depth camera's resolution.
    """
    target = color.scaled(depth.width, depth.height)
    v, u = np.mgrid[: depth.height, : depth.width] + 0.5
    x = (u - target.cx) / target.fx * depth.fx + depth.cx - 0.5
    y = (v - target.cy) / target.fy * depth.fy + depth.cy - 0.5
    return np.stack([x, y], axis=-1).astype(np.float32)
