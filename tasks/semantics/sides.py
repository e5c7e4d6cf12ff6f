"""What an object looks like from its different sides, such as the cover of a book and its back. Beyond Split&Splat."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Descriptors, Float32


def mean_direction(vectors: Float32, weights: Float32) -> Float32:
    """[D] the weighted mean of unit vectors [V, D], brought back to unit length; zeros where there is none."""
    total = np.einsum("v,vd->d", weights, vectors)
    length = np.linalg.norm(total)
    return np.asarray(total / length if length > 0 else total, np.float32)


def sides(described: Descriptors, tau_view: float) -> Float32:
    """[S, D] the mean of all views of an object, and the means of its sides where there are several.

    Views are clustered by complete linkage: any two of one side have a cosine distance of `tau_view` at most. With
    `tau_view` 0 there is the mean alone. The order of the views has no influence but for distances that are equal.
    """
    mean = described.embedding[None]
    if not tau_view or len(described.vectors) < 2:
        return mean
    from scipy.cluster.hierarchy import fcluster, linkage

    side = fcluster(linkage(described.vectors, "complete", "cosine"), tau_view, "distance")
    if side.max() == 1:
        return mean
    each = [mean_direction(described.vectors[side == s], described.weights[side == s]) for s in np.unique(side)]
    return np.concatenate([mean, each])
