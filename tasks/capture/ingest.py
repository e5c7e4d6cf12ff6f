"""From files to artifacts: frames and cameras.

File contents come as `FileRef`s; a reference's place is no part of a step's key, hence views are named apart.
Masks and depth follow the frames they belong to by name, so that frames may have been dropped in between.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress, warn
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Bool, Cameras, Frame, UInt8
from ss_flow.tasks.capture.layout_colmap import read_points
from ss_flow.tasks.capture.lens import Lens, without_distortion
from ss_flow.tasks.capture.photo_files import Photo, Pixels, pixels_of, read_gray, read_photo
from ss_flow.tasks.capture.scene_files import Pose
from ss_flow.tasks.geometry.images import averaged_valid, encode_valid, size_within
from ss_flow.tasks.ranges import Count, JpegQuality
from ss_flow.tasks.words import first_of

_BLACK = 8
"""Of 255; JPEG makes black up to so bright beside a picture."""
_UPRIGHT = {2: (True, 0), 3: (False, 2), 4: (True, 2), 5: (True, 1), 6: (False, 3), 7: (True, 3), 8: (False, 1)}
"""By EXIF's orientation, whether a photo is to be mirrored, and by how many quarters turned then, counterclockwise."""


@dataclass(frozen=True)
class IngestParams:
    """How photos are read."""

    max_side: Count = 1600
    """Photos whose longer side is above this are scaled down to it, in pixels (1600 is what 3DGS trains at)."""
    jpeg_quality: JpegQuality = 95
    """Quality at which photos are encoded again when they must be; 0 keeps them lossless as PNG."""


@task(name="capture.ingest")
def frames(
    *,
    names: tuple[str, ...],
    photos: tuple[FileRef, ...],
    valid: tuple[FileRef | None, ...] = (),
    lenses: tuple[Lens, ...] | None = None,
    skipped: tuple[str, ...] = (),
    why_skipped: str = "",
    black_borders: bool = False,
    params: IngestParams = IngestParams(),
) -> tuple[Frame, ...]:
    """The photos as frames: upright, without distortion, not above `params.max_side`.

    A photo that is all this already keeps its bytes. Where intrinsics are known, a photo is turned upright (EXIF) only
    if they refer to the turned one, which their size tells, or else their principal point. Pixels that the lens does
    not reach after undistortion become invalid, as do those that an alpha channel does not show. Warns of photos of 16
    bits that are nearly black.
    skipped: views of the capture that are not among these, of which the run is to warn, and why_skipped, as of
    `SceneFiles`. black_borders: whether borders of the photos that are black become invalid, too.
    Raises InputError when a photo is damaged, or its size or that of its valid mask is not the stated one.
    """
    warn_of_skipped(skipped, why_skipped)
    result = []
    sizes: dict[Lens, tuple[int, int, str]] = {}
    dim: list[str] = []
    for i, (name, ref) in enumerate(zip(names, photos, strict=True)):
        try:
            photo = read_photo(ref.path)
        except InputError as error:
            raise InputError(f"{error}{_damaged_too(photos[i + 1 :])}") from error
        mask = valid[i] if valid else None
        lens = lenses[i] if lenses else None
        pixels = pixels_of(photo, str(ref.path))
        if black_borders:
            pixels = replace(pixels, opaque=~black_border(pixels.image))
        frame = frame_of(name, photo, pixels, str(ref.path), mask, lens, params)
        if pixels.dim:
            dim.append(name)
        if lens is not None:
            size = (frame.source_width, frame.source_height)
            *first, where = sizes.setdefault(lens, (*size, str(ref.path)))
            if tuple(first) != size:
                raise InputError(
                    f"{ref.path} is {size[0]}x{size[1]} but {where} is {first[0]}x{first[1]}, while both share one "
                    "camera's intrinsics; photos of one camera must have one size."
                )
        result.append(frame)
        progress(i + 1, len(photos), name)
    if dim:
        warn(
            f"Photos of 16 bits that use less than an eighth of their range, and are read as nearly black: {len(dim)} "
            f"of {len(names)}, {first_of(dim)}; values of 12 bits, as raw files hold, must be multiplied by 16."
        )
    return tuple(result)


def _damaged_too(photos: tuple[FileRef, ...]) -> str:
    """What to add of photos that are damaged as well, so that all are known at once."""
    names = []
    for ref in photos:
        try:
            read_photo(ref.path)
        except InputError:
            names.append(ref.path.name)
    return f" Of the photos after it {len(names)} cannot be read either: {first_of(names)}." if names else ""


def warn_of_skipped(names: tuple[str, ...], why: str) -> None:
    """Say which views are left out of a run, the first of them by name."""
    if names:
        views = "1 view is" if len(names) == 1 else f"{len(names)} views are"
        warn(f"{views} left out, {why}: {first_of(names)}.")


def frame_of(
    name: str, photo: Photo, pixels: Pixels, where: str, mask: FileRef | None, lens: Lens | None, params: IngestParams
) -> Frame:
    import cv2

    image = pixels.image
    stored = image.shape[1::-1]
    turn = _UPRIGHT.get(photo.orientation, (False, 0))
    if lens is not None and (lens.turns or _as_stored(lens, *stored)):
        turn = (False, lens.turns)
    image = _turned(image, *turn)
    height, width = image.shape[:2]
    if lens is not None and lens.width and (width, height) != (lens.width, lens.height):
        raise InputError(
            f"{where} is {stored[0]}x{stored[1]} pixels, but its intrinsics are those of a photo of "
            f"{lens.width}x{lens.height}; the two must agree."
        )
    keep = np.ones((height, width), bool) if mask is None else _valid_mask(mask, width, height)
    if pixels.opaque is not None:
        keep = keep & _turned(pixels.opaque, *turn)
    distorted = lens is not None and not lens.pinhole
    if lens is not None and distorted:
        image, keep = without_distortion(image, keep, lens.scaled(width, height))
    w, h = size_within(params.max_side, width, height)
    if shrinks := (w, h) != (width, height):
        image = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA)
        keep = averaged_valid(keep, w, h)
    # A photo that is to be read as it is stored must not tell other programs to turn it.
    if photo.orientation != 1 or any(turn) or distorted or shrinks or photo.format not in ("jpeg", "png"):
        if params.jpeg_quality:
            encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, params.jpeg_quality])[1].ravel()
        else:
            encoded = cv2.imencode(".png", image)[1].ravel()
    else:
        encoded = np.frombuffer(photo.data, np.uint8)
    return Frame(name, w, h, encoded, encode_valid(keep), width, height, photo.focal)


def _as_stored(lens: Lens, width: int, height: int) -> bool:
    """Whether a lens is of a photo of this size as it is stored, not as EXIF turns it; without a stated size, whether
    its principal point lies no nearer to the middle of the turned one."""
    if lens.width:
        return (width, height) == (lens.width, lens.height)
    x, y = 2 * lens.cx, 2 * lens.cy
    return abs(x - width) + abs(y - height) <= abs(x - height) + abs(y - width)


def black_border(image: UInt8) -> Bool:
    """[H, W] the pixels near a photo's border, within a thirtieth of its longer side, from which only black ones lead
    there: what undistorting it has left empty."""
    import cv2

    height, width = image.shape[:2]
    black = image.max(axis=2) <= _BLACK
    margin = max(height, width) // 30
    black[margin : height - margin, margin : width - margin] = False
    _, piece = cv2.connectedComponents(np.pad(black, 1, constant_values=True).astype(np.uint8), connectivity=4)
    return np.asarray(piece[1:-1, 1:-1] == piece[0, 0])


def _turned(image: np.ndarray, mirrored: bool, quarters: int) -> np.ndarray:
    return np.ascontiguousarray(np.rot90(image[:, ::-1] if mirrored else image, quarters))


def _valid_mask(ref: FileRef, width: int, height: int) -> Bool:
    mask = read_gray(ref.path)
    if mask.shape != (height, width):
        raise InputError(
            f"{ref.path} is {mask.shape[1]}x{mask.shape[0]} pixels, but its photo is {width}x{height}; a valid mask "
            "must have its photo's size."
        )
    return mask > 0


@task(name="capture.cameras")
def cameras(
    frames: tuple[Frame, ...],
    *,
    names: tuple[str, ...],
    lenses: tuple[Lens, ...],
    poses: tuple[Pose, ...],
    metric: bool,
    sparse: FileRef | None = None,
) -> Cameras:
    """The cameras that came with the capture, scaled to the frames.

    names, lenses, poses: of the capture's views, of which the frames are some.
    sparse: COLMAP's points3D file.
    Raises InputError when that file is damaged.
    """
    row = {name: i for i, name in enumerate(names)}
    intrinsics, other_sizes = [], []
    for frame in frames:
        lens = lenses[row[frame.name]]
        size = frame.source_width, frame.source_height
        if (meant := lens.of_photo(*size)) != size:
            other_sizes.append("{} x {}, though its intrinsics are of about {:.0f} x {:.0f}".format(*size, *meant))
        scaled = lens.scaled(*size).scaled(frame.width, frame.height)
        intrinsics.append((scaled.fx, scaled.fy, scaled.cx, scaled.cy))
    if other_sizes:
        warn(
            "Intrinsics were scaled to their photos, since their principal points show that they are those of photos "
            f"of another size: {len(other_sizes)} of {len(frames)} views, the first of {other_sizes[0]}."
        )
    return Cameras(
        names=tuple(f.name for f in frames),
        sizes=np.array([(f.width, f.height) for f in frames], np.int32).reshape(-1, 2),
        intrinsics=np.array(intrinsics, np.float64).reshape(-1, 4),
        world_to_camera=np.array([poses[row[f.name]] for f in frames], np.float64).reshape(-1, 4, 4),
        metric=metric,
        sparse_points=np.zeros((0, 3), np.float32) if sparse is None else read_points(sparse.path),
    )
