"""From a finished run to pictures: what `ss-flow render` adds to a flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ss_flow.graph import each
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Cameras, Gaussians
from ss_flow.tasks.deliver.camera_paths import along, given, round_instance, round_scene
from ss_flow.tasks.deliver.export.content import FileContent, chosen
from ss_flow.tasks.deliver.pictures import What, film, picture, side_by_side
from ss_flow.tasks.geometry.cameras import Camera

CameraPath = Literal["input", "orbit"] | FileRef


@dataclass(frozen=True)
class Shot:
    """How a film is taken."""

    path: CameraPath
    """Along the input views, round the scene or an instance, or the cameras of a file."""
    frames: int
    elevation_deg: float
    """Of an orbit round an instance."""
    what: What
    width: int
    """Of the pictures, pixels; 0 = the cameras' own."""
    depth_unit: float
    """World units of a step in pictures of depth."""
    fps: int


def shoot(
    scene: Gaussians,
    cameras: Cameras,
    ids: tuple[int, ...] | None,
    shot: Shot,
    *,
    whole: bool,
    is_film: bool,
    before: Gaussians | None = None,
) -> dict[str, Any]:
    """The nodes of the pictures, of their cameras, and of the film where one is wanted.

    ids: the instances that an orbit goes round, and that are rendered unless `whole`; None = the scene. before: the
    scene before it was edited, shown on the left of every picture.
    """
    own = scene if ids is None else chosen(scene, instances=ids)
    if isinstance(shot.path, FileRef):
        path = given(file=shot.path)
    elif shot.path == "input":
        path = along(cameras, frames=shot.frames)
    elif ids is None:
        path = round_scene(scene, cameras, frames=shot.frames)
    else:
        path = round_instance(own, cameras, frames=shot.frames, elevation_deg=shot.elevation_deg)

    def taken(shown: Gaussians, camera: Camera) -> FileContent:
        return picture(shown, camera, what=shot.what, width=shot.width, depth_unit=shot.depth_unit)

    shown, left = scene if whole else own, before
    if before is not None and not whole and ids is not None:
        left = chosen(before, instances=ids)
    if left is None:
        pictures = each(path, build=lambda camera: taken(shown, camera))
    else:
        pictures = each(path, build=lambda camera: side_by_side(taken(left, camera), taken(shown, camera)))
    films = {"film": film(pictures, what=shot.what, fps=shot.fps)} if is_film else {}
    return {"cameras": path, "pictures": pictures, **films}
