"""The pictures of a report: some views in every form that a run gives them, the scene from outside, the cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame, Gaussians, LabelMap, UInt8
from ss_flow.tasks.deliver.compressed import Picture, compressed
from ss_flow.tasks.deliver.draw import draw
from ss_flow.tasks.deliver.palette import depth_colors, instance_colors
from ss_flow.tasks.deliver.point_view import draw_points, orbit_camera
from ss_flow.tasks.gaussians.rasterize import backend_identity

_SHOWN = 3
"""Views that are drawn, evenly chosen."""


@task(environment=backend_identity)
def report_pictures(
    frames: Sequence[Frame],
    cameras: Cameras,
    depths: Sequence[DepthMap],
    split_maps: Sequence[LabelMap],
    maps: Sequence[LabelMap],
    scene: Gaussians,
    *,
    turns: int = 0,
) -> tuple[Picture, ...]:
    """Draw three views, each as "VIEW/photo", "VIEW/masks_split", "VIEW/masks", "VIEW/render" and "VIEW/depth, WHAT IT
    MEANS", then "Instances", the Gaussians in the colours of their instances, and "Cameras".

    All lists are in the order of the frames. An empty scene has no renderings. turns: by how many quarters,
    counterclockwise, views are turned to stand upright.
    """

    def of_view(k: int) -> Iterator[tuple[str, UInt8]]:
        frame = frames[k]
        yield f"{frame.name}/photo", draw(frame)
        yield f"{frame.name}/masks_split", draw(split_maps[k], frame=frame)
        yield f"{frame.name}/masks", draw(maps[k], frame=frame)
        if len(scene):
            yield f"{frame.name}/render", draw(scene, cameras=cameras, view=k)
        picture, note = _depth(depths[k], "m" if cameras.metric else "units")
        yield f"{frame.name}/depth, {note}", picture

    def drawn() -> Iterator[tuple[str, UInt8]]:
        for k in sorted({int(k) for k in (np.arange(_SHOWN) + 0.5) * len(frames) / _SHOWN}):
            yield from ((name, np.rot90(picture, turns)) for name, picture in of_view(k))
        if len(scene):
            colors = instance_colors(int(scene.instance_id.max()) + 1)[scene.instance_id]
            spacing = 2 * float(np.exp(np.median(scene.log_scales)))
            yield "Instances", draw_points(scene.means, colors, orbit_camera(scene.means, cameras), spacing)
        yield "Cameras", draw(cameras)

    return tuple(Picture(name, compressed(picture)) for name, picture in drawn())


def _depth(value: DepthMap, unit: str) -> tuple[UInt8, str]:
    """A depth map in colours, and what they mean."""
    colors, low, high = depth_colors(value.depth)
    known = float((value.depth > 0).mean())
    if not known:
        return colors, f"{value.source}, nothing known"
    return colors, f"{low:.3g} to {high:.3g} {unit}, near = red; {value.source}, {100 * known:.0f} % known"
