"""Loose photos: a folder of images, with nothing that tells how they were taken."""

from __future__ import annotations

from pathlib import Path

from ss_flow.errors import InputError
from ss_flow.tasks.capture.scene_files import (
    HEIC_SUFFIXES,
    PHOTO_SUFFIXES,
    PNM_SUFFIXES,
    UNREAD_SUFFIXES,
    VIDEO_SUFFIXES,
    SceneFiles,
    files_in,
)


def open_photos(path: Path) -> SceneFiles | None:
    """The photos in a folder, or in its folder `images/`; None where there are none.

    Raises InputError when both hold some, or depth maps lie among them.
    """
    photos, more = _one_of_each(files_in(path)), _one_of_each(files_in(path / "images"))
    if photos and more:
        raise InputError(
            f"{path} holds photos ({len(photos)}), and so does its folder images/ ({len(more)}); give {path / 'images'}"
            " to use the latter, or move that folder away."
        )
    photos = photos or more
    if not photos:
        return None
    folder, stems = photos[0].parent, {photo.stem for photo in photos}
    depths = [photo for photo in photos if _is_depth(photo)]
    if 0 < len(depths) < len(photos):
        raise InputError(
            f"{folder} holds depth maps beside its photos, such as {depths[0].name}; lay them out as color/, "
            "depth/ and pose/ with one stem a view, and intrinsic/intrinsic_color.txt (docs/rgbd.md), or move the "
            "depth maps away to use photos alone."
        )
    unread = [file for file in files_in(folder, UNREAD_SUFFIXES) if file.stem not in stems]
    called = {photo: photo.stem for photo in photos} | {file: file.name for file in unread}
    listed = files_in(folder, PHOTO_SUFFIXES | UNREAD_SUFFIXES)
    return SceneFiles(
        kind="photos",
        root=path,
        names=tuple(p.stem for p in photos),
        photos=tuple(photos),
        skipped=tuple(file.name for file in unread),
        why_skipped="whose format is not read",
        all_names=tuple(called[file] for file in listed if file in called),
    )


def unused(scene: SceneFiles) -> tuple[str, ...]:
    """What to say of images that are not used: in folders beside the photos, though not of copies scaled down
    (images_4), which are no loss; PGM and its kin beside other photos; and recordings, but for those of the same names,
    as phones store with a photo what moved."""
    used = {file.parent.resolve() for file in scene.files()} | {(scene.root / "held_out").resolve()}
    beside = [f for f in sorted(scene.root.glob("*/")) if not f.name.startswith((".", "images_"))]
    left = [f for f in beside if not any(place.is_relative_to(f.resolve()) for place in used)]
    listed = ", ".join(f"{folder.name}/ ({number})" for folder in left if (number := len(files_in(folder))))
    why = "photos are read of one folder, and depth where a layout gives its lens and unit (docs/captures.md)"
    told = [f"{scene.root} holds images that are not used, in {listed}: {why}."] if listed else []
    pnm = set(files_in(scene.photos[0].parent, PNM_SUFFIXES)) - set(scene.photos)
    if pnm:
        told.append(
            f"{min(pnm)} is not used, nor what else of PGM and its kin ({len(pnm)}) lies beside the photos: if "
            "this is depth, lay all out as color/, depth/ and pose/ (docs/rgbd.md)."
        )
    recordings = [f for f in files_in(scene.root, VIDEO_SUFFIXES | {".sens"}) if f.stem not in scene.names]
    told += [f"{f} is not used, as photos lie beside it; give its own path to use it." for f in recordings]
    return tuple(told)


def _one_of_each(photos: list[Path]) -> list[Path]:
    """Photos without those in HEIC that lie beside a copy in another format, as phones export them, and without PGM and
    its kin beside other formats: there they hold depth, as in recordings of RGB-D cameras."""
    photos = [photo for photo in photos if photo.suffix.lower() not in PNM_SUFFIXES] or photos
    copied = {photo.stem for photo in photos if photo.suffix.lower() not in HEIC_SUFFIXES}
    return [photo for photo in photos if photo.suffix.lower() not in HEIC_SUFFIXES or photo.stem not in copied]


def _is_depth(photo: Path) -> bool:
    """Whether the header of a file is that of a PNG with 16 bits in one channel."""
    if photo.suffix.lower() != ".png" or not photo.is_file():
        return False
    with photo.open("rb") as file:
        return file.read(26)[24:] == bytes([16, 0])
