"""Structure from motion: photos without poses -> cameras and sparse points, by COLMAP's incremental mapper."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Cameras, Frame
from ss_flow.tasks.capture.ingest import warn_of_skipped
from ss_flow.tasks.capture.lens import Lens, inside_source, undistortion_map
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, encode_png, suffix_of
from ss_flow.tasks.ranges import Angle, Count, Fraction, Natural, Positive

_MATCHING_THREADS = 2


@dataclass(frozen=True)
class SfmParams:
    """How poses are found from photos alone."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which photos are compared: "exhaustive" (all pairs), "sequential" (neighbours in order, for video), or "auto":
    all pairs up to `exhaustive_limit` photos."""
    exhaustive_limit: Natural = 200
    """The most photos that "auto" compares in all pairs."""
    overlap: Count = 12
    """How many neighbours on either side sequential matching compares."""
    max_features: Count = 8192
    """The most SIFT features a photo."""
    peak_threshold: Positive = 0.003
    """Contrast that a SIFT feature needs; COLMAP's own default, 0.0067, finds too few in dim or blurred rooms."""
    guided_matching: Literal["never", "missing", "always"] = "missing"
    """Whether photos are matched a second time along the epipolar lines that the first match gave, which takes eight
    times as long: "missing" - only where photos find no pose without, and then all over again."""
    min_pose_matches: Count = 15
    """So many points must confirm a photo's pose (COLMAP's own default is 30)."""
    min_start_angle: Angle = 8.0
    """Parallax of the two photos that the model starts from, in degrees (COLMAP's own default is 16)."""
    max_image_side: Count = 1600
    """Features are found in photos scaled down to this longer side, in pixels."""
    camera_model: Literal["SIMPLE_RADIAL", "SIMPLE_PINHOLE"] = "SIMPLE_RADIAL"
    """"SIMPLE_RADIAL" (one focal length, one radial coefficient) or "SIMPLE_PINHOLE", shared by photos of one size."""
    min_registered: Fraction = 0.5
    """The share of photos that must find their pose; below it the step fails."""
    max_point_error: Positive = 2.0
    """Sparse points with a larger mean reprojection error are dropped, in pixels."""
    min_track: Count = 3
    """Sparse points seen in fewer photos are dropped."""


@task(resources=Resources(cores=_MATCHING_THREADS), isolate=True)
def sfm(frames: tuple[Frame, ...], *, params: SfmParams = SfmParams(), seed: int = 0) -> Cameras:
    """Cameras of those frames that COLMAP's largest model registers, in the frames' order (spec S2).

    The unit of length is arbitrary (`metric` is False). Frames without a pose are missing from the result;
    `registered` drops them, and takes out the distortion that `Cameras.radial` states. Mapping runs on one thread with
    fixed seeds, so that two runs agree to the bit.
    Raises InputError when too few frames register.
    """
    if len(frames) < 3:
        raise InputError(
            f"poses cannot be found from {len(frames)} photo(s); at least 3 overlapping photos are needed."
        )
    pycolmap = _load_pycolmap()
    with tempfile.TemporaryDirectory(prefix="ss-flow-sfm-") as folder, _quiet(pycolmap):
        root = Path(folder)
        files = _write_photos(frames, root)
        progress(0, 3, "features")
        _extract(pycolmap, root, files, params)
        best = None
        for guided in {"never": (False,), "always": (True,), "missing": (False, True)}[params.guided_matching]:
            if best is not None and best.num_reg_images() == len(frames):
                break
            progress(1, 3, "guided matches" if guided else "matches")
            _match(pycolmap, root, len(frames), params, guided, seed)
            progress(2, 3, "mapping")
            found = _largest(pycolmap, root, f"guided-{guided}", params, seed)
            if best is None or (found is not None and found.num_reg_images() > best.num_reg_images()):
                best = found
        if best is None:
            raise InputError(_too_few(0, len(frames)))
        result = _cameras(best, frames, files, params)
    progress(3, 3, f"{len(result)} of {len(frames)} photos have a pose")
    if len(result) < max(3, params.min_registered * len(frames)):
        raise InputError(_too_few(len(result), len(frames)))
    return result


@task(name="capture.registered")
def registered(frames: tuple[Frame, ...], cameras: Cameras) -> tuple[Frame, ...]:
    """The frames that have a camera, in the cameras' order, as a pinhole would have taken them.

    Pixels that the lens does not reach after undistortion become invalid.
    """
    import cv2

    frame_of = {frame.name: frame for frame in frames}
    placed = set(cameras.names)
    warn_of_skipped(tuple(frame.name for frame in frames if frame.name not in placed), "for which no pose was found")
    result = []
    for i, name in enumerate(cameras.names):
        frame = frame_of[name]
        if cameras.radial.size and cameras.radial[i] != 0:
            fx, fy, cx, cy = (float(x) for x in cameras.intrinsics[i])
            lens = Lens(frame.width, frame.height, fx, fy, cx, cy, (float(cameras.radial[i]), 0.0, 0.0, 0.0))
            source = undistortion_map(lens)
            image = cv2.remap(decode_rgb(frame), source, None, cv2.INTER_LINEAR)
            keep = cv2.remap(decode_valid(frame).astype(np.uint8), source, None, cv2.INTER_NEAREST) > 0
            keep &= inside_source(source)
            valid = np.zeros(0, np.uint8) if keep.all() else encode_png(keep.astype(np.uint8) * 255)
            frame = replace(frame, encoded=encode_png(image), valid=valid)
        result.append(frame)
        progress(i + 1, len(cameras), name)
    return tuple(result)


def _too_few(found: int, total: int) -> str:
    return (
        f"only {found} of {total} photos found their pose; photos that overlap by two thirds, sharp, of a scene with "
        "texture and taken from different places help, or give poses (COLMAP, nerfstudio)."
    )


def _load_pycolmap() -> ModuleType:
    import zlib  # noqa: F401 - pycolmap brings a zlib of its own, which breaks Python's when loaded before it

    import pycolmap

    return pycolmap


@contextmanager
def _quiet(pycolmap: ModuleType) -> Iterator[None]:
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 2
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _write_photos(frames: tuple[Frame, ...], root: Path) -> list[str]:
    """Write photos in one folder for each size, so that COLMAP shares a camera among photos of one size."""
    files = []
    for i, frame in enumerate(frames):
        file = f"{frame.width}x{frame.height}/{i:06d}.{suffix_of(frame)}"
        photo, mask = root / "photos" / file, root / "valid" / f"{file}.png"
        photo.parent.mkdir(parents=True, exist_ok=True)
        mask.parent.mkdir(parents=True, exist_ok=True)
        photo.write_bytes(frame.encoded.tobytes())
        if frame.valid.size:
            mask.write_bytes(frame.valid.tobytes())
        files.append(file)
    return files


def _extract(pycolmap: ModuleType, root: Path, files: list[str], params: SfmParams) -> None:
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = params.camera_model
    if any((root / "valid").rglob("*.png")):
        reader.mask_path = root / "valid"
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    # Images are numbered as they are finished, and everything after depends on their numbers.
    options.num_threads = 1
    options.max_image_size = params.max_image_side
    options.sift.max_num_features = params.max_features
    options.sift.peak_threshold = params.peak_threshold
    pycolmap.extract_features(
        root / "database.db",
        root / "photos",
        image_names=sorted(files),
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        reader_options=reader,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def _largest(pycolmap: ModuleType, root: Path, name: str, params: SfmParams, seed: int) -> Any | None:
    """The model with the most photos that mapping gives, if one is possible."""
    models = pycolmap.incremental_mapping(
        root / "database.db", root / "photos", root / name, _mapping_options(pycolmap, params, seed)
    )
    plausible = [(model.num_reg_images(), model.num_points3D(), -number, model) for number, model in models.items()]
    return max((row for row in plausible if _plausible(row[-1])), key=lambda row: row[:3], default=(None,))[-1]


def _match(pycolmap: ModuleType, root: Path, count: int, params: SfmParams, guided: bool, seed: int) -> None:
    """Match all pairs of photos anew."""
    with pycolmap.Database.open(root / "database.db") as database:
        database.clear_matches()
        database.clear_two_view_geometries()
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = _MATCHING_THREADS
    options.guided_matching = guided
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    common = {
        "matching_options": options,
        "verification_options": verification,
        "device": pycolmap.Device.cpu,
    }
    if params.matching == "sequential" or (params.matching == "auto" and count > params.exhaustive_limit):
        pairs = pycolmap.SequentialPairingOptions()
        pairs.overlap = params.overlap
        pycolmap.match_sequential(root / "database.db", pairing_options=pairs, **common)
    else:
        pycolmap.match_exhaustive(root / "database.db", **common)


def _mapping_options(pycolmap: ModuleType, params: SfmParams, seed: int) -> Any:
    pycolmap.set_random_seed(seed)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.num_threads = 1
    options.mapper.random_seed = seed
    options.mapper.abs_pose_min_num_inliers = params.min_pose_matches
    options.mapper.init_min_tri_angle = params.min_start_angle
    options.triangulation.random_seed = seed
    options.min_model_size = 3
    options.extract_colors = False
    return options


def _plausible(model: Any) -> bool:
    """Whether a model's lenses are possible; small models of little parallax run off to endless focal lengths."""
    return all(
        0.2 < camera.params[0] / max(camera.width, camera.height) < 10 and np.abs(camera.params[3:]).max(initial=0) < 1
        for camera in model.cameras.values()
        if any(image.camera_id == camera.camera_id for image in model.images.values() if image.has_pose)
    )


def _cameras(model: Any, frames: tuple[Frame, ...], files: list[str], params: SfmParams) -> Cameras:
    image_of = {image.name: image for image in model.images.values() if image.has_pose}
    kept = [(frame, image_of[file]) for frame, file in zip(frames, files, strict=True) if file in image_of]
    intrinsics, radial, poses = [], [], []
    for _, image in kept:
        camera = model.cameras[image.camera_id]
        focal, cx, cy, *coefficients = (float(x) for x in camera.params)
        intrinsics.append((focal, focal, cx, cy))
        radial.append(coefficients[0] if coefficients else 0.0)
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        poses.append(pose)
    points = [
        point.xyz
        for _, point in sorted(model.points3D.items())
        if point.error <= params.max_point_error and point.track.length() >= params.min_track
    ]
    return Cameras(
        names=tuple(frame.name for frame, _ in kept),
        sizes=np.array([(frame.width, frame.height) for frame, _ in kept], np.int32),
        intrinsics=np.array(intrinsics, np.float64),
        world_to_camera=np.array(poses, np.float64),
        metric=False,
        sparse_points=np.array(points, np.float32).reshape(-1, 3),
        radial=np.array(radial, np.float64) if any(radial) else np.zeros(0, np.float64),
    )
