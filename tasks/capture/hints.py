"""Points that a user clicked on objects in a few views: the file that holds them, and where they lie in the frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, Clicks, Float64, Frame
from ss_flow.tasks.capture.lens import Lens, photo_lens, undistorted
from ss_flow.tasks.capture.names import finder
from ss_flow.tasks.capture.scene_files import Hint, Hints, Point, is_number, read_json
from ss_flow.tasks.words import first_of


def read_hints(path: Path, views: tuple[str, ...]) -> Hints:
    """The hints of a file: {view: {object: [[x, y], ...] or {"in": [[x, y], ...], "out": [[x, y], ...]}}}.

    views: the names that there are. Raises InputError when the file is not of this form or names another view.
    """
    document = read_json(path)
    if not isinstance(document, dict) or not all(isinstance(objects, dict) for objects in document.values()):
        raise InputError(
            f"{path} holds no hints; an object of the form {{view: {{object: [[x, y], ...]}}}} is expected."
        )
    labels: dict[str, int] = {}
    hints = []
    called = finder(views)
    for view, objects in document.items():
        if (own := called(view)) is None:
            raise InputError(f"{path} has hints for {view!r}, which is no view of the scene; {views[0]!r} is one.")
        for name, given in objects.items():
            where = f"the hint for {name!r} in view {view!r} of {path}"
            if not name.strip():
                raise InputError(f"{where} names no object; give it a name.")
            if isinstance(given, list):
                given = {"in": given}
            if not isinstance(given, dict) or given.keys() - {"in", "out"} or not given.get("in"):
                raise InputError(
                    f"{where} has no points; [[x, y], ...] is expected, or the same under `in` and, for points beside "
                    "the object, `out`."
                )
            label = labels.setdefault(name, len(labels) + 1)
            hints.append(Hint(own, label, *(_points(given.get(key, []), where) for key in ("in", "out"))))
    if not hints:
        raise InputError(f"{path} holds no hints; at least one point in one view is needed.")
    return Hints(path, tuple(labels), tuple(hints))


def _points(given: Any, where: str) -> tuple[Point, ...]:
    if not isinstance(given, list) or not all(
        isinstance(point, list) and len(point) == 2 and all(map(is_number, point)) for point in given
    ):
        raise InputError(f"{where} has points that are not of the form [x, y], in pixels of the photo.")
    return tuple((float(x), float(y)) for x, y in given)


@task(name="capture.hints")
def clicks(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    *,
    names: tuple[str, ...],
    hints: Hints,
    lenses: tuple[Lens, ...] | None = None,
) -> tuple[Clicks, ...]:
    """The clicked points of each frame, in its pixels.

    names, lenses: of the capture's views, of which the frames are some. Each view has an artifact of its own, so that
    another click in one view leaves what follows from the others as it is.
    Raises InputError when a point lies outside its photo, or no frame has any.
    """
    row = {name: i for i, name in enumerate(names)}
    result = []
    for frame in frames:
        of_frame = sorted((hint for hint in hints.hints if hint.view == frame.name), key=lambda hint: hint.label)
        lens = photo_lens(frame, lenses[row[frame.name]] if lenses else None, cameras)
        parts = [_on_frame(hint, frame, lens, hints) for hint in of_frame]
        result.append(
            Clicks(
                name=frame.name,
                label=np.repeat([hint.label for hint in of_frame], [len(part) for part in parts]).astype(np.int32),
                points=np.concatenate([np.zeros((0, 2)), *parts]),
                inside=np.concatenate(
                    [np.zeros(0), *(np.repeat([1, 0], [len(h.inside), len(h.outside)]) for h in of_frame)]
                ).astype(np.int32),
            )
        )
    used = {frame.name for frame in frames}
    if lost := [view for view in dict.fromkeys(hint.view for hint in hints.hints) if view not in used]:
        warn(f"The points of {hints.path.name} in views that are left out do not count: {first_of(lost)}.")
    if not any(len(of_view.label) for of_view in result):
        raise InputError(f"{hints.path} has hints for none of the {len(frames)} views that are used; give some there.")
    return tuple(result)


def _on_frame(hint: Hint, frame: Frame, lens: Lens | None, hints: Hints) -> Float64:
    """[N, 2] the points of a hint in pixels of the frame, those inside first."""
    points = np.array(hint.inside + hint.outside)
    size = frame.source_width, frame.source_height
    moved = points if lens is None else undistorted(points, lens)
    for place, known in ((points, "photo"), (moved, "photo once its lens's distortion is taken out")):
        beyond = ~((place >= 0) & (place < size)).all(axis=1)
        if beyond.any():
            x, y = points[beyond][0]
            raise InputError(
                f"{hints.path} has the point ({x:g}, {y:g}) for {hints.objects[hint.label - 1]!r} in view "
                f"{hint.view!r}, which lies outside of the {known}; it has {size[0]}x{size[1]} pixels."
            )
    return moved * (frame.width / size[0], frame.height / size[1])
