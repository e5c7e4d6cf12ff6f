"""Points of a scene that lie evenly."""

import numpy as np

from ss_flow.tasks.artifacts import PointCloud


def even_cloud(points: np.ndarray, colors: np.ndarray, unit: float, spacing: float) -> PointCloud:
    """Points [N, 3] with colours [N, 3], all as far apart."""
    return PointCloud(points, colors, unit, np.full(len(points), spacing, np.float32))
