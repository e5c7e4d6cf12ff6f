"""What an array holds, in a few words."""

from __future__ import annotations

import numpy as np


def statistics(array: np.ndarray) -> str:
    """Least and greatest value, mean, and shares of zeros and NaN, where there are some; of booleans the share of true.

    Means and extremes are those of the finite values.
    """
    if not array.size or array.dtype.kind not in "biuf":
        return ""
    if array.dtype.kind == "b":
        return f"{array.mean():.3g} true"
    finite = array[np.isfinite(array)] if array.dtype.kind == "f" else array
    told = []
    if finite.size:
        told = [f"{finite.min():.6g} .. {finite.max():.6g}", f"mean {finite.mean(dtype=np.float64):.4g}"]
    shares = {"zero": array == 0}
    if array.dtype.kind == "f":
        shares |= {"NaN": np.isnan(array), "infinite": np.isinf(array)}
    told += [f"{100 * share.mean():.3g}% {word}" for word, share in shares.items() if share.any()]
    return ", ".join(told)
