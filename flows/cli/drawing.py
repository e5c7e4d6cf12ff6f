"""Pictures of results, with what they need for context."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.results import of_type
from ss_flow.runs import Run
from ss_flow.tasks.artifacts import Cameras, Frame, PointCloud
from ss_flow.tasks.deliver.draw import draw
from ss_flow.tasks.geometry.images import encode_png


def draw_results(store: Store, run: Run, values: Sequence[Any], view: int, file: Path) -> None:
    """Draw one result, or a sheet of several, as a PNG file.

    view: the position of the view that looks at points and Gaussians. Raises InputError when the run has no such view.
    """
    frames = of_type(store, run, Frame)
    by_name = {frame.name: frame for frame in frames}
    cameras = next(iter(of_type(store, run, Cameras)), None)
    if cameras is not None and not 0 <= view < len(cameras.names):
        raise InputError(f"--view {view} is out of range; the run has views 0 to {len(cameras.names) - 1}.")
    context: dict[str, Any] = {
        "frames": frames,
        "cameras": cameras,
        "points": next(iter(of_type(store, run, PointCloud)), None),
        "view": view,
    }
    if len(values) == 1:
        picture = draw(values[0], frame=by_name.get(getattr(values[0], "name", "")), **context)
    else:
        picture = draw(list(values), **context)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(encode_png(picture).tobytes())
