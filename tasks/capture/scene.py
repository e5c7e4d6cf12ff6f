"""Open a capture: find out its layout and list its files. Nothing is decoded here, as every command does this first."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from ss_flow.errors import InputError
from ss_flow.tasks.capture.hints import read_hints
from ss_flow.tasks.capture.layout_colmap import is_colmap, open_colmap
from ss_flow.tasks.capture.layout_nerfstudio import open_nerfstudio
from ss_flow.tasks.capture.layout_photos import open_photos, unused
from ss_flow.tasks.capture.layout_polycam import is_polycam, open_polycam
from ss_flow.tasks.capture.layout_replica import is_replica, open_replica
from ss_flow.tasks.capture.layout_scannet import is_scannet, open_scannet, open_sens
from ss_flow.tasks.capture.layout_stray import is_stray, open_stray
from ss_flow.tasks.capture.layout_tum import open_tum
from ss_flow.tasks.capture.names import by_name, finder, spelt
from ss_flow.tasks.capture.scene_files import (
    PHOTO_SUFFIXES,
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
    remarks = unused(scene) if scene.kind == "photos" else ()
    return replace(scene, remarks=(*remarks, *_alone(scene, path)))


def _alone(scene: SceneFiles, path: Path) -> tuple[str, ...]:
    """What to say where only the photos, or the video, of a capture were named that brings more."""
    above = path.absolute().parent
    if scene.kind not in ("photos", "video") or _known_layout(above) is None:
        return ()
    return (f"{path} is used without the poses or the depth that lie beside it; give {above} to use them.",)


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
    known = _known_layout(path)
    return _open_loose(path) if known is None else known(path)


def _known_layout(folder: Path) -> Callable[[Path], SceneFiles] | None:
    """What opens a folder of a layout that tells more than photos alone; None where it is of no such."""
    if (folder / "transforms.json").is_file():
        return lambda place: open_nerfstudio(place / "transforms.json")
    if is_scannet(folder):
        return open_scannet
    if (folder / "rgb.txt").is_file():
        return open_tum
    if is_replica(folder):
        return open_replica
    if is_polycam(folder):
        return open_polycam
    if is_stray(folder):
        return open_stray
    return open_colmap if is_colmap(folder) else None


def _open_loose(path: Path) -> SceneFiles:
    if others := sorted(path.glob(_OTHER_TRANSFORMS), key=lambda file: ("train" not in file.name, file.name)):
        raise InputError(
            f"{path} holds {others[0].name}, and poses are read from transforms.json only; copy it to that name, or "
            "move it away to have poses found."
        )
    if (photos := open_photos(path)) is not None:
        return photos
    recordings = files_in(path, VIDEO_SUFFIXES | {".sens"})
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
    captures = [folder for folder in sorted(path.glob("*/")) if _known_layout(folder) is not None]
    if len(captures) == 1:
        return f"its folder {captures[0].name}/ is a capture with poses or depth, so give that"
    if (path / "metadata.json").is_file() and any((path / name).is_dir() for name in ("rgbd", "rgb")):
        return (
            "Record3D's exports are read once nerfstudio has made a transforms.json of them (ns-process-data record3d, "
            "docs/rgbd.md)"
        )
    within = [(folder, photos) for folder in sorted(path.glob("*/")) if (photos := files_in(folder))]
    if len(within) == 1:
        folder, photos = within[0]
        return f"its folder {folder.name}/ holds {len(photos)} of them, so give that"
    return f"give {ACCEPTED}"


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
