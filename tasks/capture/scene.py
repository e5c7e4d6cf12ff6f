"""Open a capture: find out its layout and list its files. Nothing is decoded here, as every command does this first."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from ss_flow.errors import InputError
from ss_flow.tasks.capture.hints import read_hints
from ss_flow.tasks.capture.layout_colmap import is_colmap, open_colmap
from ss_flow.tasks.capture.layout_nerfstudio import open_nerfstudio
from ss_flow.tasks.capture.layout_polycam import is_polycam, open_polycam
from ss_flow.tasks.capture.layout_replica import is_replica, open_replica
from ss_flow.tasks.capture.layout_scannet import is_scannet, open_scannet, open_sens
from ss_flow.tasks.capture.layout_stray import is_stray, open_stray
from ss_flow.tasks.capture.layout_tum import open_tum
from ss_flow.tasks.capture.names import by_name, finder, spelt
from ss_flow.tasks.capture.scene_files import (
    HEIC_SUFFIXES,
    PHOTO_SUFFIXES,
    PNM_SUFFIXES,
    UNREAD_SUFFIXES,
    VIDEO_SUFFIXES,
    SceneFiles,
    files_in,
    read_json,
)

ACCEPTED = (
    "a folder of photos, a video, a COLMAP workspace (sparse/ and images/), a nerfstudio transforms.json, a ScanNet "
    "export (color/ depth/ pose/ intrinsic/) or .sens file, a TUM RGB-D sequence (rgb.txt), a room of Replica (results/"
    " and traj.txt), Polycam's raw data (keyframes/), or a recording of Stray Scanner (rgb.mp4 and odometry.csv)"
)
_OTHER_TRANSFORMS = "transforms_*.json"
"""As NeRF's synthetic scenes have them, one for the views to train on and others to test with."""
_MASK_SUFFIXES = frozenset({".png", ".tif", ".tiff"})


def open_scene(
    path: Path, masks: Path | None = None, hints: Path | None = None, corrections: Path | None = None
) -> SceneFiles:
    """The files of a capture, whatever its layout.

    path: a folder, a video, a `.sens` file or a `transforms.json`.
    masks: a folder of ready-made instance masks, one image of ids a view, named by the view's stem, or a COCO file.
    hints: a file of points clicked on objects, in the place of masks. corrections: one of points clicked on what was
    joined or broken, beside any masks.
        By default, `instance_masks/`, `instance_masks.json` or `hints.json` in the scene's folder, where one exists.
        Likewise `instance/` is ground truth, of which every pixel is annotated where `instances.json` (id -> name)
        names 0; and `valid/` (or what the layout itself lists) holds masks that are 0
        where a pixel is to be ignored.
    Raises InputError when nothing is recognised, or a file that the layout needs is missing or makes no sense, or masks
    are given in two ways.
    """
    scene = replace(_open_layout(path), opened=path)
    if scene.kind != "video":
        _check_files(scene)
    # What lies beside a video or a .sens file that is named itself may belong to another one.
    in_folder = scene.kind != "video" and (path.is_dir() or scene.kind == "nerfstudio")
    if masks is not None and hints is not None:
        raise InputError(f"{masks} and {hints} cannot be used together; give masks or hints.")
    if masks is None and hints is None and in_folder:
        masks, hints = _found_masks(scene.root)
    if scene.kind == "video" and (given := masks or hints or corrections):
        raise InputError(f"{given} cannot go with a video, whose frames have no names yet; extract the frames first.")
    if corrections is not None:
        scene = replace(scene, corrections=read_hints(corrections, scene.names))
    if hints is not None:
        scene = replace(scene, hints=read_hints(hints, scene.names))
    elif masks is not None and masks.is_dir():
        scene = replace(scene, ready_masks=_all_by_name(masks, scene.names))
    elif masks is not None and masks.is_file() and masks.suffix.lower() == ".json":
        scene = replace(scene, coco_masks=masks)
    elif masks is not None:
        raise InputError(
            f"{masks} is no folder and no .json file; ready-made instance masks come as a folder of images named by "
            "view, or as a COCO file."
        )
    if in_folder and (scene.root / "instance").is_dir():
        scene = replace(
            scene,
            ground_truth=_some_by_name(scene.root / "instance", scene.names),
            zero_is_void=not _names_zero(scene.root / "instances.json"),
        )
    if in_folder and (scene.root / "valid").is_dir() and not any(scene.valid):
        scene = replace(scene, valid=_some_by_name(scene.root / "valid", scene.names))
    if not scene.valid:
        scene = replace(scene, valid=(None,) * len(scene.names))
    return replace(scene, remarks=_unused(scene)) if scene.kind == "photos" else scene


def _unused(scene: SceneFiles) -> tuple[str, ...]:
    """What to say of folders beside photos that hold images, too; copies scaled down (images_4) are no loss."""
    used = {file.parent.resolve() for file in scene.files()} | {(scene.root / "held_out").resolve()}
    beside = [f for f in sorted(scene.root.glob("*/")) if not f.name.startswith((".", "images_"))]
    left = [f for f in beside if not any(place.is_relative_to(f.resolve()) for place in used)]
    listed = ", ".join(f"{folder.name}/ ({number})" for folder in left if (number := len(files_in(folder))))
    why = "photos are read of one folder, and depth where a layout gives its lens and unit (docs/captures.md)"
    return (f"{scene.root} holds images that are not used, in {listed}: {why}.",) if listed else ()


def _names_zero(file: Path) -> bool:
    """Whether a file of names, if there is one, gives the id 0 a name."""
    names = read_json(file) if file.is_file() else None
    return isinstance(names, dict) and "0" in names


def _found_masks(folder: Path) -> tuple[Path | None, Path | None]:
    """The masks and the hints, one of them at most, that lie in a scene's folder."""
    masks = [place for place in (folder / "instance_masks", folder / "instance_masks.json") if place.exists()]
    hints = [place for place in (folder / "hints.json",) if place.exists()]
    if len(masks + hints) > 1:
        raise InputError(
            f"{folder} holds {' and '.join(place.name for place in masks + hints)}; name the one to use, with --masks "
            "or --hints."
        )
    return next(iter(masks), None), next(iter(hints), None)


def _open_layout(path: Path) -> SceneFiles:
    if not path.exists():
        raise InputError(f"{path} does not exist; give the path of a scene: {ACCEPTED}.")
    if path.is_file():
        if path.suffix.lower() in VIDEO_SUFFIXES:
            return SceneFiles(kind="video", root=path.parent, recording=path)
        if path.suffix.lower() == ".sens":
            return open_sens(path)
        if path.name == "transforms.json":
            return open_nerfstudio(path)
        if path.match(_OTHER_TRANSFORMS):
            raise InputError(f"{path} is not read under this name; copy it to {path.with_name('transforms.json')}.")
        if path.suffix.lower() == ".zip":
            raise InputError(f"{path} is an archive; unzip it, and give the folder that comes out.")
        suffixes = " ".join(sorted(VIDEO_SUFFIXES))
        raise InputError(f"{path} is no scene; give {ACCEPTED}; videos end in {suffixes}.")
    if (path / "transforms.json").is_file():
        return open_nerfstudio(path / "transforms.json")
    if is_scannet(path):
        return open_scannet(path)
    if (path / "rgb.txt").is_file():
        return open_tum(path)
    if is_replica(path):
        return open_replica(path)
    if is_polycam(path):
        return open_polycam(path)
    if is_stray(path):
        return open_stray(path)
    if is_colmap(path):
        return open_colmap(path)
    return _open_loose(path)


def _open_loose(path: Path) -> SceneFiles:
    if others := sorted(path.glob(_OTHER_TRANSFORMS), key=lambda file: ("train" not in file.name, file.name)):
        raise InputError(
            f"{path} holds {others[0].name}, and poses are read from transforms.json only; copy it to that name, or "
            "move it away to have poses found."
        )
    photos, more = _one_of_each(files_in(path)), _one_of_each(files_in(path / "images"))
    if photos and more:
        raise InputError(
            f"{path} holds photos ({len(photos)}), and so does its folder images/ ({len(more)}); give {path / 'images'}"
            " to use the latter, or move that folder away."
        )
    photos = photos or more
    recordings = files_in(path, VIDEO_SUFFIXES | {".sens"})
    if photos:
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
            all_names=tuple(called[file] for file in listed if file in called),
        )
    if len(recordings) > 1:
        raise InputError(f"{path} holds {len(recordings)} recordings; give the path of one of them.")
    if recordings:
        return _open_layout(recordings[0])
    if (path / "color").is_dir() and (path / "depth").is_dir():
        return open_scannet(path)  # which tells what is missing
    suffixes = " ".join(sorted(PHOTO_SUFFIXES))
    raise InputError(f"{path} holds no photo ({suffixes}) and no capture that is known; {_what_to_give(path)}.")


def _what_to_give(path: Path) -> str:
    """What to give in the place of a folder without a photo: its only folder that is a capture, or has some photos, or
    any capture."""
    captures = [
        folder for folder in sorted(path.glob("*/")) if is_colmap(folder) or (folder / "transforms.json").is_file()
    ]
    if len(captures) == 1:
        return f"its folder {captures[0].name}/ is a capture with poses, so give that"
    within = [(folder, photos) for folder in sorted(path.glob("*/")) if (photos := files_in(folder))]
    if len(within) == 1:
        folder, photos = within[0]
        return f"its folder {folder.name}/ holds {len(photos)} of them, so give that"
    return f"give {ACCEPTED}"


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


def _check_files(scene: SceneFiles) -> None:
    if scene.photos:
        by_name(scene.names, scene.photos)
    depths = scene.depths or ()
    _check_exist([*scene.photos, *depths])
    for files, expected in ((scene.photos, "JPEG, PNG or HEIC"), (depths, "PNG of 16 bits or TIFF of 32-bit floats")):
        for file in files:
            if file.suffix.lower() not in PHOTO_SUFFIXES:
                raise InputError(f"{file} is no image file by its name; {expected} is expected.")


def _check_exist(files: Sequence[Path]) -> None:
    # One listing a folder is far cheaper than asking for each file.
    listings = {folder: _names_of_files(folder) for folder in {file.parent for file in files}}
    for file in files:
        if file.name in listings[file.parent]:
            continue
        if file.is_symlink():
            raise InputError(
                f"{file} links to {file.readlink()}, which is no file; put it there or take the link away."
            )
        alike = _alike(file, listings[file.parent])
        there = f"; {alike} lies there, which is spelt differently: rename it" if alike else ""
        raise InputError(f"{file}, which the scene lists, does not exist{there or '; put it there or drop the view'}.")


def _alike(file: Path, names: Iterable[str]) -> str | None:
    """A name that differs from a file's in capitals, in how accents are stored, or else in the ending only."""

    def plain(name: str) -> str:
        return spelt(name).casefold()

    known = [name for name in sorted(names) if Path(name).suffix.lower() in PHOTO_SUFFIXES]
    same = [name for name in known if plain(name) == plain(file.name)]
    return next(iter([*same, *(name for name in known if plain(Path(name).stem) == plain(file.stem))]), None)


def _names_of_files(folder: Path) -> set[str]:
    return {entry.name for entry in os.scandir(folder) if entry.is_file()} if folder.is_dir() else set()


def _some_by_name(folder: Path, names: Sequence[str]) -> tuple[Path | None, ...]:
    files = [file for place in sorted(folder.glob("**/")) for file in files_in(place, _MASK_SUFFIXES)]
    # As `view_names` has it where photos lie in several folders.
    found = by_name(["_".join([*file.parent.relative_to(folder).parts, file.stem]) for file in files], files)
    called = finder(found)
    matched = tuple(found[own] if (own := called(name)) else None for name in names)
    _check_exist([file for file in matched if file is not None])
    if not any(matched):
        raise InputError(f"{folder} holds no image named after a view; {names[0]}.png, for one, is expected.")
    return matched


def _all_by_name(folder: Path, names: Sequence[str]) -> tuple[Path, ...]:
    matched = _some_by_name(folder, names)
    for name, file in zip(names, matched, strict=True):
        if file is None:
            raise InputError(f"{folder} lacks the masks of view {name}; {name}.png is expected there.")
    return tuple(file for file in matched if file is not None)
