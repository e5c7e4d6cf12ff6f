"""Where the photo decides between a mask and the finished scene. Beyond Split&Splat.

Gaussians lie where the depth says, and on real captures depth and colour are some pixels apart; a segmenter's mask ends
where the photo changes. So a thin strip by which the two differ goes to the one whose borders cost less, as in a graph
cut: a border between pixels costs the less, the more the photo changes there (Boykov and Jolly 2001).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Float32, Int32, UInt8
from ss_flow.tasks.geometry.images import near_border

_Ids = NDArray[np.uint16]
_Flat = NDArray[np.intp]


def settled_by_photo(rgb: UInt8, masks: _Ids, shown: _Ids, reach: int) -> _Ids:
    """What a view's finished scene shows, [H, W], with the ids of the masks in thin strips where these end better.

    A strip is a connected set of pixels to which the masks give one id and the scene another; thin, if each of its
    pixels is no farther than `reach` from one outside of it, along rows or columns or both. Pixels that no mask has
    stay the scene's: a mask that is missing is no statement.

    rgb: [H, W, 3]; masks, shown: [H, W].
    """
    strip = _strips(masks, shown)
    if not strip.any():
        return shown
    thin = np.ones(int(strip.max()) + 1, bool)
    thin[strip[~near_border(strip.astype(np.float32), reach)]] = False
    own, beside = _side_by_side(np.flatnonzero(strip), *strip.shape)
    change = _change(rgb).ravel()
    square = np.maximum(change[own], change[beside]).astype(np.float64) ** 2
    cost = np.exp(-square / max(2 * float(np.mean(change.astype(np.float64) ** 2)), 1e-12))
    of = strip.ravel()[own]
    by_masks, by_scene = (
        np.bincount(of, cost * (ids.ravel()[own] != ids.ravel()[beside]), len(thin)) for ids in (masks, shown)
    )
    keeps = thin & (by_masks < by_scene)
    keeps[0] = False
    return np.where(keeps[strip], masks, shown)


def _strips(masks: _Ids, shown: _Ids) -> Int32:
    """[H, W] number of the strip that each pixel is part of, 0 for none."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    differs = ((masks != shown) & (masks > 0)).ravel()
    row = np.cumsum(differs) - 1
    own, beside = _side_by_side(np.flatnonzero(differs), *masks.shape)
    pair = masks.astype(np.int64).ravel() << 16 | shown.ravel()
    same = (own < beside) & differs[beside] & (pair[own] == pair[beside])
    count = int(differs.sum())
    links = coo_array((np.ones(int(same.sum()), bool), (row[own[same]], row[beside[same]])), (count, count))
    strip = np.zeros(masks.size, np.int32)
    strip[differs] = 1 + connected_components(links, directed=False)[1]
    return strip.reshape(masks.shape)


def _side_by_side(pixels: _Flat, height: int, width: int) -> tuple[_Flat, _Flat]:
    """Flat indices of pixels, and of those right of, below, left of and above them in the image."""
    row, column = np.divmod(pixels, width)
    sides = ((1, column < width - 1), (width, row < height - 1), (-1, column > 0), (-width, row > 0))
    own, steps = [pixels[there] for _, there in sides], [step for step, _ in sides]
    return np.concatenate(own), np.concatenate([some + step for some, step in zip(own, steps, strict=True)])


def _change(rgb: UInt8) -> Float32:
    """[H, W] how much the colour changes from pixel to pixel (CIELAB; Sobel)."""
    import cv2

    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    across, down = (cv2.Sobel(lab, cv2.CV_32F, dx, 1 - dx) for dx in (1, 0))
    return np.sqrt((across**2 + down**2).sum(axis=2))
