"""Ready-made instance masks with the faults of a segmenter: missed, split, merged and wobbly (spec leads, "mask
corrupters")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError

Ids = NDArray[np.uint16]

_WOBBLE = 7.0
"""Correlation length of the boundary noise: standard deviation of its smoothing kernel, pixels."""


@dataclass(frozen=True)
class DegradeParams:
    """How good masks are made worse. All shares are of the whole scene's masks and hold exactly, up to rounding."""

    missed: float = 0.2
    """Share of the masks that are dropped."""
    split: float = 0.15
    """Share of the masks that fall into two or three pieces."""
    merged: float = 0.0
    """Share of the pairs of touching masks that become one mask."""
    jitter_px: float = 5.0
    """Largest displacement of a boundary, pixels."""


def degrade(truth: Ids, params: DegradeParams, *, seed: int) -> Ids:
    """Masks as a mediocre segmenter would give them, with ids that mean nothing beyond their view.

    truth: [K, H, W] instance ids, 0 = no mask. Returns [K, H, W]: in each view the masks are numbered 1.. in random
    order. Raises InputError when a share is outside 0..1, or missed and split together exceed 1.
    """
    shares = {"missed": params.missed, "split": params.split, "merged": params.merged}
    for name, share in shares.items():
        if not 0 <= share <= 1:
            raise InputError(f"The share of {name} masks is {share}; it must lie between 0 and 1.")
    if params.missed + params.split > 1:
        raise InputError("The shares of missed and of split masks add up to more than 1; no mask is in both.")
    rng = np.random.default_rng(seed)
    masks = [(view, int(i)) for view in range(len(truth)) for i in np.unique(truth[view]) if i]
    order = rng.permutation(len(masks))
    missed = round(params.missed * len(masks))
    split = round(params.split * len(masks))
    result = truth.astype(np.int64)
    for n in order[:missed]:
        view, instance = masks[n]
        result[view][truth[view] == instance] = 0
    for n in order[missed : missed + split]:
        view, instance = masks[n]
        _split(result[view], truth[view] == instance, rng)
    _merge(result, params.merged, rng)
    return np.stack([_shuffled(_wobbled(ids, params.jitter_px, rng), rng) for ids in result])


def _split(ids: NDArray[np.int64], mask: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Divide a mask among two or three of its own pixels, each pixel to the nearest; in place, new ids on top."""
    pixels = np.argwhere(mask)
    count = min(int(rng.integers(2, 4)), len(pixels))
    seeds = pixels[rng.choice(len(pixels), count, replace=False)]
    nearest = ((pixels[:, None] - seeds) ** 2).sum(axis=-1).argmin(axis=1)
    top = ids.max()
    for piece in range(1, count):
        ids[tuple(pixels[nearest == piece].T)] = top + piece


def _merge(result: NDArray[np.int64], share: float, rng: np.random.Generator) -> None:
    """Unite a share of all pairs of masks that touch; in place."""
    pairs = [(view, a, b) for view in range(len(result)) for a, b in _touching(result[view])]
    chosen = rng.permutation(len(pairs))[: round(share * len(pairs))]
    name: list[dict[int, int]] = [{} for _ in result]
    for n in sorted(int(i) for i in chosen):
        view, a, b = pairs[n]
        renamed = name[view]
        while a in renamed:
            a = renamed[a]
        while b in renamed:
            b = renamed[b]
        if a != b:
            renamed[max(a, b)] = min(a, b)
            result[view][result[view] == max(a, b)] = min(a, b)


def _touching(ids: NDArray[np.int64]) -> list[tuple[int, int]]:
    across = np.stack([ids[:, 1:].ravel(), ids[:, :-1].ravel()], axis=1)
    down = np.stack([ids[1:].ravel(), ids[:-1].ravel()], axis=1)
    both = np.concatenate([across, down])
    both = both[(both > 0).all(axis=1) & (both[:, 0] != both[:, 1])]
    return [(int(a), int(b)) for a, b in np.unique(np.sort(both, axis=1), axis=0)]


def _wobbled(ids: NDArray[np.int64], amplitude: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Look every pixel up at a place displaced by a smooth random field: half of `amplitude` in each direction as a
    rule (standard deviation), never more than `amplitude` in all."""
    if amplitude <= 0:
        return ids
    from scipy.ndimage import gaussian_filter

    field = np.stack([gaussian_filter(rng.normal(size=ids.shape), _WOBBLE) for _ in range(2)])
    field *= amplitude / 2 / field.std()
    field *= np.minimum(1, amplitude / np.maximum(np.hypot(*field), 1e-12))
    row, column = np.indices(ids.shape)
    row = np.clip(np.round(row + field[0]), 0, ids.shape[0] - 1).astype(np.intp)
    column = np.clip(np.round(column + field[1]), 0, ids.shape[1] - 1).astype(np.intp)
    return ids[row, column]


def _shuffled(ids: NDArray[np.int64], rng: np.random.Generator) -> Ids:
    present = np.unique(ids[ids > 0])
    table = np.zeros(int(ids.max(initial=0)) + 1, np.uint16)
    table[present] = rng.permutation(len(present)) + 1
    return table[ids]
