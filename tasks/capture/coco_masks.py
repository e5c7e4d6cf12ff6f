"""Ready-made instance masks in a COCO file: polygons, and run lengths plain or packed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.running import progress, warn
from ss_flow.task import FileRef, Resources, task
from ss_flow.tasks.artifacts import Bool, Cameras, Float64, Frame, MaskSet
from ss_flow.tasks.capture.id_images import frame_pixels
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.names import finder
from ss_flow.tasks.capture.scene_files import is_number, read_json
from ss_flow.tasks.masks.pool import mask_set
from ss_flow.tasks.words import first_of

_SCORES = ("predicted_iou", "score")


@task(
    name="capture.coco_masks",
    resources=Resources(cores=1, memory_mb=1500),
)
def coco_masks(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    *,
    names: tuple[str, ...],
    file: FileRef,
    lenses: tuple[Lens, ...] | None = None,
) -> tuple[MaskSet, ...]:
    """The masks of a COCO instance file, for each frame; those of one view may overlap.

    names, lenses: of the capture's views. An image of the file is the view that has its file name's stem, or its
    path where views are called so (`names.view_names`); a view that the file does not list has no masks. Crowd
    regions, which stand for many objects at once, are left out. The masks come in canonical order; `predicted_iou` is
    what the file gives as `predicted_iou` or `score`, else 1.

    Raises InputError when the file is not of this form, lists no view or crowds only, or gives a mask that cannot be
    read or has not its photo's size.
    """
    row = {name: i for i, name in enumerate(names)}
    images, annotations = _contents(file.path, row.keys())
    if not row.keys() & images.keys():
        raise InputError(
            f"{file.path} lists no image named after a view; {names[0]}.jpg, for one, is expected among its file names."
        )
    if without := [frame.name for frame in frames if frame.name not in images]:
        warn(f"{file.path.name} does not list {len(without)} of {len(frames)} views: {first_of(without)}.")
    result = []
    for i, frame in enumerate(frames):
        progress(i, len(frames), frame.name)
        pixels = frame_pixels(frame, lenses[row[frame.name]] if lenses else None, cameras)
        masks: list[Bool] = []
        scores: list[float] = []
        if image := images.get(frame.name):
            _check_size(image, frame, file.path)
            for annotation in annotations.get(image["id"], ()):
                where = f"annotation {annotation['id']} of {file.path}"
                mask = _decode(annotation.get("segmentation"), frame.source_height, frame.source_width, where)
                masks.append((pixels >= 0) & mask.ravel()[pixels])
                scores.append(_score(annotation, where))
        dense = np.array(masks, bool).reshape(len(masks), frame.height, frame.width)
        result.append(mask_set(frame.name, dense, np.array(scores, np.float32), "ready-made"))
    return tuple(result)


def _contents(path: Path, names: Iterable[str]) -> tuple[dict[str, dict[str, Any]], dict[Any, list[dict[str, Any]]]]:
    """The images of a COCO file by their views, and its annotations, crowds left out, by their image's id."""
    document = read_json(path)
    if not isinstance(document, dict) or not all(_is_table(document.get(key)) for key in ("images", "annotations")):
        raise InputError(
            f"{path} is no COCO instance file; an object with the lists `images` and `annotations` is one."
        )
    images: dict[str, dict[str, Any]] = {}
    ids = set()
    called = finder(names)
    for image in document["images"]:
        if not _is_id(image.get("id")) or not isinstance(image.get("file_name"), str):
            raise InputError(f"{path} lists an image without an `id` or a `file_name`; both are needed.")
        view = _view(PureWindowsPath(image["file_name"]), called)  # whose separators are those of every system
        if view in images or image["id"] in ids:
            raise InputError(
                f"{path} lists two images with the id {image['id']!r} or the stem {view!r}; both must be unique."
            )
        images[view] = image
        ids.add(image["id"])
    annotations: dict[Any, list[dict[str, Any]]] = {}
    crowds = 0
    for number, annotation in enumerate(document["annotations"]):
        named = {"id": f"number {number}", **annotation}
        if not _is_id(annotation.get("image_id")) or annotation["image_id"] not in ids:
            raise InputError(
                f"annotation {named['id']} of {path} has the image_id {annotation.get('image_id')!r}, which is that of "
                "no image of the file."
            )
        if annotation.get("iscrowd"):
            crowds += 1
        else:
            annotations.setdefault(annotation["image_id"], []).append(named)
    if crowds and not annotations:
        raise InputError(
            f"{path} has iscrowd = 1 in all its {crowds} annotations, and crowds are left out, since each stands for "
            "many objects at once; where each is one object, as in CVAT's exports, set it to 0."
        )
    if crowds:
        warn(f"{crowds} crowd regions of {path.name} are left out: each stands for many objects at once.")
    return images, annotations


def _view(file: PurePath, called: Callable[[str], str | None]) -> str:
    """The view that a file belongs to: one called by its path or by the end of it, else by its stem."""
    parts = [*file.parent.parts, file.stem]
    ends = ("_".join(parts[place:]) for place in range(len(parts)))
    return next(filter(None, map(called, ends)), file.stem)


def _is_table(rows: Any) -> bool:
    return isinstance(rows, list) and all(isinstance(row, dict) for row in rows)


def _is_id(value: Any) -> bool:
    return isinstance(value, int | str)


def _check_size(image: Mapping[str, Any], frame: Frame, path: Path) -> None:
    size = image.get("width"), image.get("height")
    if size != (frame.source_width, frame.source_height):
        raise InputError(
            f"{path} gives {image['file_name']} a width and height of {size[0]} and {size[1]}, but the photo has "
            f"{frame.source_width} and {frame.source_height}; masks must have their photo's size."
        )


def _score(annotation: Mapping[str, Any], where: str) -> float:
    for key in _SCORES:
        if (score := annotation.get(key)) is not None:
            if not is_number(score):
                raise InputError(f"{where} has the {key} {score!r}; a number is expected.")
            return float(score)
    return 1.0


def _decode(segmentation: Any, height: int, width: int, where: str) -> Bool:
    """[height, width] the mask that a `segmentation` stands for, whichever its form."""
    if isinstance(segmentation, list) and segmentation:
        mask = np.zeros((height, width), bool)
        for outline in segmentation:
            mask |= fill_polygon(_polygon(outline, height, width, where), height, width)
        return mask
    if not isinstance(segmentation, dict) or "counts" not in segmentation:
        raise InputError(f"{where} has no segmentation; polygons, or run lengths with `size` and `counts`, are one.")
    if segmentation.get("size") != [height, width]:
        raise InputError(
            f"{where} has run lengths of size {segmentation.get('size')!r}; that of its photo, [{height}, {width}] "
            "(height first), is expected."
        )
    counts = segmentation["counts"]
    try:
        lengths = unpack_counts(counts) if isinstance(counts, str) else _plain_counts(counts)
    except ValueError as error:
        raise InputError(f"{where} has `counts` that cannot be read: {error}.") from error
    if lengths.min(initial=0) < 0 or lengths.sum() != height * width:
        raise InputError(
            f"{where} has run lengths that do not add up to the {height * width} pixels of its photo; they are damaged "
            "or of another photo."
        )
    # Runs go down the columns, the first of them outside the mask.
    return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths).reshape(width, height).T


def _polygon(outline: Any, height: int, width: int, where: str) -> Float64:
    """[N, 2] the corners of a polygon."""
    if not isinstance(outline, list) or len(outline) < 6 or len(outline) % 2 or not all(map(is_number, outline)):
        raise InputError(f"{where} has a polygon that is no list of numbers x, y, x, y, ... of three corners or more.")
    corners = np.array(outline, np.float64).reshape(-1, 2)
    # Annotating tools go a little over the border; much more than that was made for another photo.
    if (corners < (-width, -height)).any() or (corners > (2 * width, 2 * height)).any():
        raise InputError(
            f"{where} has a polygon that leaves its photo of {width}x{height} pixels far behind; coordinates in pixels "
            "of the photo are expected."
        )
    return corners


def fill_polygon(corners: Float64, height: int, width: int) -> Bool:
    """[height, width] the pixels whose centres lie in a polygon; where it overlaps itself, in an odd number of layers.

    corners: [N, 2] x, y; pixel (0, 0) reaches from (0, 0) to (1, 1). OpenCV's polygons hold their outline's pixels too,
    which makes a mask half a pixel larger all round.
    """
    (x, y), (next_x, next_y) = corners.T, np.roll(corners, -1, axis=0).T
    # Each edge is crossed by the rows of centres from `first` to before `last`.
    first = np.ceil(np.minimum(y, next_y) - 0.5).clip(0, height).astype(np.intp)
    last = np.ceil(np.maximum(y, next_y) - 0.5).clip(0, height).astype(np.intp)
    count = last - first
    edge = np.repeat(np.arange(len(corners)), count)
    row = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - first, count)
    slope = (next_x - x)[edge] / (next_y - y)[edge]
    crossing = x[edge] + (row + 0.5 - y[edge]) * slope
    column = np.ceil(crossing - 0.5).clip(0, width).astype(np.intp)
    turns = np.zeros((height, width + 1), np.uint8)
    np.add.at(turns, (row, column), 1)
    return np.cumsum(turns[:, :width], axis=1, dtype=np.uint8) % 2 == 1


def _plain_counts(counts: Any) -> NDArray[np.int64]:
    if not isinstance(counts, list) or not all(type(n) is int and 0 <= n < 1 << 31 for n in counts):
        raise ValueError("a list of whole numbers from 0 on, or a packed string, is expected")
    return np.array(counts, np.int64)


def unpack_counts(text: str) -> NDArray[np.int64]:
    """The run lengths of a packed string, COCO's "compressed RLE".

    A character from "0" on carries 6 bits: 5 of a number, the lowest first, and one that says that more follow. The
    highest bit carried is the number's sign. From the fourth on, numbers are differences to the length two before.
    Raises ValueError for a string that is none.
    """
    codes = np.frombuffer(text.encode(), np.uint8).astype(np.int64) - ord("0")
    if not codes.size or codes.min() < 0 or codes.max() > 63 or codes[-1] & 32:
        raise ValueError("the string has other characters than those from 0 to o, or it is cut short")
    ends = np.flatnonzero(codes & 32 == 0)
    used = np.diff(ends, prepend=-1)
    if used.max() > 7:
        raise ValueError("the string holds a number of more than 35 bits")
    place = np.arange(len(codes)) - np.repeat(ends + 1 - used, used)
    numbers = np.add.reduceat((codes & 31) << 5 * place, ends + 1 - used)
    numbers -= np.where(codes[ends] & 16, 1 << 5 * used, 0)
    lengths = numbers.copy()
    lengths[1::2] = np.cumsum(numbers[1::2])
    lengths[2::2] = np.cumsum(numbers[2::2])
    return lengths
