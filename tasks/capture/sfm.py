"""Structure from motion: matched features -> cameras and sparse points, by COLMAP's incremental mapper."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress, warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, Frame, Int32
from ss_flow.tasks.capture.colmap import SEED, load_pycolmap
from ss_flow.tasks.capture.colmap_database import fill_database
from ss_flow.tasks.capture.contradicted import contradicted
from ss_flow.tasks.capture.features import FeatureParams, Features
from ss_flow.tasks.capture.ingest import warn_of_skipped
from ss_flow.tasks.capture.lens import found_lens, without_distortion
from ss_flow.tasks.capture.matches import FIRST_FOCAL, Matches
from ss_flow.tasks.capture.pairs import Look, PairParams
from ss_flow.tasks.capture.pose_fit import matches_that_fit, pairs_that_fit
from ss_flow.tasks.capture.turning import refuse_turning
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, encode_png, encode_valid
from ss_flow.tasks.ranges import Angle, Count, Fraction, Positive

_BENT = 0.1
"""A found lens that moves the corners of its photos by more, as a share of their distance from the middle, is doubted:
ordinary lenses bend by a few hundredths, and in few photos with little parallax distortion stands in for depth."""
_MUCH = 1.02
"""So many times the matches must fit such a lens for it to be believed."""
_CONSISTENT = 0.94
"""The share of the matches that fit right poses: .96 to .98 did in seven captures, .65 to .92 under wrong ones. Where
things repeat, fewer fit right ones, too: .94 of every third photo of a wall with printed roses, .71 of a room whose
walls are alike."""


@dataclass(frozen=True)
class MappingParams:
    """How cameras are found from matches."""

    mapper: Literal["incremental", "global"] = "incremental"
    """COLMAP's mapper: "incremental" places one photo after the other, "global" all at once (GLOMAP): as exactly
    on 50 photos, in twice the time."""
    min_pose_matches: Count = 15
    """So many points must confirm a photo's pose (COLMAP's own default is 30)."""
    min_start_angle: Angle = 16.0
    """Parallax of the two photos that a model starts from, in degrees; further models start from half and a quarter of
    it, where photos have no place yet."""
    camera_model: Literal["SIMPLE_RADIAL", "SIMPLE_PINHOLE"] = "SIMPLE_RADIAL"
    """"SIMPLE_RADIAL" (one focal length, one radial coefficient) or "SIMPLE_PINHOLE", shared by photos of one
    size and of one focal length in EXIF."""
    max_point_error: Positive = 2.0
    """Sparse points with a larger mean reprojection error are dropped, in pixels."""
    min_track: Count = 3
    """Sparse points seen in fewer photos are dropped."""


@dataclass(frozen=True)
class SfmParams:
    """How poses are found from photos alone."""

    features: FeatureParams = field(default_factory=FeatureParams)
    pairs: PairParams = field(default_factory=PairParams)
    guided_matching: Literal["never", "missing"] = "missing"
    """Whether photos are matched a second time along the epipolar lines that the first match gave: "missing" - those
    that find no pose without, and with twice as many partners."""
    mapping: MappingParams = field(default_factory=MappingParams)
    min_registered: Fraction = 0.5
    """The share of photos that must find their pose; below it the step fails."""

    def straight(self) -> SfmParams:
        """For photos whose distortion was taken out: a second one would be known to nothing that knows the first."""
        return replace(self, mapping=replace(self.mapping, camera_model="SIMPLE_PINHOLE"))


@dataclass(frozen=True)
class Unregistered:
    """The photos that have no pose yet."""

    row: Int32
    """[U] ascending rows of the photos."""
    total: int
    """How many photos there are."""


@task(isolate=True)
def sfm(
    photos: Sequence[Features],
    matches: tuple[Matches, ...],
    again: tuple[Matches, ...],
    *,
    params: MappingParams = MappingParams(),
) -> Cameras:
    """Cameras of those photos that COLMAP's best model registers, in the photos' order (spec S2).

    Of the models with at least half as many photos as the largest it is the one that most matches fit; one that too
    many contradict comes after all others. again: guided matches, which count in the place of those of the same pairs
    before, but not for what is best. A lens that bends photos much is believed only where clearly more matches fit it
    than a straight one.
    The unit of length is arbitrary (`metric` is False). Photos without a pose are missing from the result, which may be
    all; `registered` drops them, and takes out the distortion that `Cameras.radial` states. Mapping runs on one thread
    with fixed seeds, so that two runs agree to the bit. Raises InputError where photos were taken from one place.
    """
    refuse_turning(photos, matches)
    best = _mapped(photos, matches, again, params)
    if _bend(best) <= _BENT:
        return best
    straight = _mapped(photos, matches, again, replace(params, camera_model="SIMPLE_PINHOLE"))
    without, bent = (matches_that_fit(model, photos, matches)[0] for model in (straight, best))
    return best if bent > _MUCH * without else straight


def _bend(cameras: Cameras) -> float:
    """How far the lenses move the corners of their photos, as a share of their distance from the middle; the most."""
    if not len(cameras.radial):
        return 0.0
    focal, middle = cameras.intrinsics[:, :2], cameras.intrinsics[:, 2:]
    corner = np.maximum(middle, cameras.sizes - middle) / focal
    return float(np.abs(cameras.radial * (corner**2).sum(axis=1)).max())


def _mapped(
    photos: Sequence[Features], matches: tuple[Matches, ...], again: tuple[Matches, ...], params: MappingParams
) -> Cameras:
    """What `sfm` returns, under one model of the lens."""
    pycolmap = load_pycolmap()
    model = getattr(pycolmap.CameraModelId, params.camera_model)

    def lens(photo: Features, _: int) -> tuple[tuple[int, int, float], Any]:
        size = (photo.width, photo.height)
        return (*size, photo.focal), pycolmap.Camera.create_from_model_id(1, model, FIRST_FOCAL * max(size), *size)

    database, kept = fill_database(photos, (*matches, *again), lens)
    manager = pycolmap.ReconstructionManager()
    if params.mapper == "global":
        pipeline = pycolmap.GlobalPipeline(_global_options(pycolmap), database, manager)
        step, start = pycolmap.GlobalPipelineCallback.MODEL_UPDATE_CALLBACK, 0
    else:
        pipeline = pycolmap.IncrementalPipeline(_incremental_options(pycolmap, params), database, manager)
        step, start = pycolmap.IncrementalPipelineCallback.NEXT_IMAGE_REG_CALLBACK, 2
    steps = itertools.count(start)

    def told() -> None:
        progress(min(next(steps), len(photos)), len(photos), "photos placed")

    pipeline.add_callback(int(step.value), told)
    pipeline.run()
    sizes = [(photo.name, photo.width, photo.height) for photo in kept]

    def cameras(number: int) -> Cameras:
        return _cameras(manager.get(number), sizes, params)

    models = {number: cameras(number) for number in range(manager.size()) if _plausible(manager.get(number))}
    large = [number for number, model in models.items() if 2 * len(model) >= max(map(len, models.values()))]
    if not large:
        return _cameras(None, sizes, params)
    best = max(large, key=lambda number: _worth(models[number], kept, matches))
    wrong = contradicted(models[best], kept, matches)
    if not wrong:
        return models[best]
    for number in reversed(range(manager.size())):
        if number != best:
            manager.delete(number)
    _without_pose(manager.get(0), wrong)
    pycolmap.IncrementalPipeline(_incremental_options(pycolmap, params), database, manager).run()
    _without_pose(manager.get(0), contradicted(cameras(0), kept, matches))
    return cameras(0)


def _without_pose(model: Any, names: Sequence[str]) -> None:
    """Take the poses of some photos out of one of COLMAP's models, and the points that hang on them."""
    for image in [image for image in model.images.values() if image.name in names]:
        model.deregister_frame(image.frame_id)


@task(name="capture.unregistered")
def unregistered(photos: Sequence[Look], cameras: Cameras) -> Unregistered:
    """Which photos found no pose."""
    placed = set(cameras.names)
    rows = [row for row in range(len(photos)) if photos[row].name not in placed]
    return Unregistered(np.array(rows, np.int32), len(photos))


@task(name="capture.accepted")
def accepted(
    found: tuple[Cameras, ...],
    missing: Unregistered,
    photos: Sequence[Features],
    matches: Sequence[Matches],
    *,
    min_registered: float,
) -> Cameras:
    """Of several tries that place enough photos the one that most matches fit; the first of equals.

    missing: from the first try. matches: those of the first try, since guided ones have been bent to a geometry.
    A try that too many matches contradict comes after all others, and is warned of. Raises InputError when too few
    photos are placed.
    """
    if missing.total < 3:
        raise InputError(
            f"poses cannot be found from {missing.total} photo(s); at least 3 overlapping photos are needed."
        )
    enough = [tried for tried in found if len(tried) >= max(3, min_registered * missing.total)]
    if not enough:
        most = max(map(len, found))
        raise InputError(
            f"only {most} of {missing.total} photos found their pose; photos that overlap by two thirds, sharp, of a "
            "scene with texture and taken from different places help, or give poses (COLMAP, nerfstudio)."
        )
    worths = [_worth(tried, photos, matches) for tried in enough]
    best = max(range(len(enough)), key=worths.__getitem__)
    if not worths[best][0]:
        pairs = list(pairs_that_fit(enough[best], photos, matches))
        off = [int(np.count_nonzero(~fits)) for *_, fits in pairs]
        one, other, *_ = pairs[int(np.argmax(off))]
        warn(
            f"The poses that were found may be wrong: {sum(off) / sum(len(fits) for *_, fits in pairs):.0%} of the "
            f"matches between photos do not fit them, where 3 % is usual, most of {one} and {other}. Where these show "
            "two things that look alike, poses may be right all the same; things that move, two lenses or a zoom, "
            "photos that were cropped, and photos from nearly one place mislead. More photos from other places help, "
            "or give poses (COLMAP, nerfstudio)."
        )
    return enough[best]


@task(name="capture.registered")
def registered(frames: tuple[Frame, ...], cameras: Cameras) -> tuple[Frame, ...]:
    """The frames that have a camera, in the cameras' order, as a pinhole would have taken them.

    Pixels that the lens does not reach after undistortion become invalid.
    """
    frame_of = {frame.name: frame for frame in frames}
    placed = set(cameras.names)
    warn_of_skipped(tuple(frame.name for frame in frames if frame.name not in placed), "for which no pose was found")
    result = []
    for i, name in enumerate(cameras.names):
        frame = frame_of[name]
        if not (lens := found_lens(cameras, i)).pinhole:
            image, keep = without_distortion(decode_rgb(frame), decode_valid(frame), lens)
            frame = replace(frame, encoded=encode_png(image), valid=encode_valid(keep))
        result.append(frame)
        progress(i + 1, len(cameras), name)
    return tuple(result)


def _incremental_options(pycolmap: Any, params: MappingParams) -> Any:
    pycolmap.set_random_seed(SEED)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = SEED
    options.mapper.num_threads = 1
    options.mapper.random_seed = SEED
    options.mapper.abs_pose_min_num_inliers = params.min_pose_matches
    options.mapper.init_min_tri_angle = params.min_start_angle
    options.triangulation.random_seed = SEED
    options.min_model_size = 3
    options.extract_colors = False
    return options


def _global_options(pycolmap: Any) -> Any:
    pycolmap.set_random_seed(SEED)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = SEED
    options.min_model_size = 3
    return options


def _worth(model: Cameras, photos: Sequence[Features], matches: Sequence[Matches]) -> tuple[bool, int, int, int]:
    """What tells the best of several models: that matches do not contradict it, then by how many fit it, and by its
    photos and points."""
    fit, total = matches_that_fit(model, photos, matches)
    return fit >= _CONSISTENT * total, fit, len(model), len(model.sparse_points)


def _plausible(model: Any) -> bool:
    """Whether a model's lenses are possible; small models of little parallax run off to endless focal lengths."""
    return all(
        0.2 < camera.params[0] / max(camera.width, camera.height) < 10 and np.abs(camera.params[3:]).max(initial=0) < 1
        for camera in model.cameras.values()
        if any(image.camera_id == camera.camera_id for image in model.images.values() if image.has_pose)
    )


def _cameras(model: Any | None, photos: list[tuple[str, int, int]], params: MappingParams) -> Cameras:
    placed = {image.name: image for image in model.images.values() if image.has_pose} if model else {}
    kept = [shape for shape in photos if shape[0] in placed]
    intrinsics, radial, poses = [], [], []
    for name, _, _ in kept:
        focal, cx, cy, *coefficients = (float(x) for x in placed[name].camera.params)
        intrinsics.append((focal, focal, cx, cy))
        radial.append(coefficients[0] if coefficients else 0.0)
        poses.append(np.vstack([placed[name].cam_from_world().matrix(), (0, 0, 0, 1)]))
    points = [
        point.xyz
        for _, point in (sorted(model.points3D.items()) if model else ())
        if point.error <= params.max_point_error and point.track.length() >= params.min_track
    ]
    return Cameras(
        names=tuple(name for name, *_ in kept),
        sizes=np.array([size for _, *size in kept], np.int32).reshape(-1, 2),
        intrinsics=np.array(intrinsics, np.float64).reshape(-1, 4),
        world_to_camera=np.array(poses, np.float64).reshape(-1, 4, 4),
        metric=False,
        sparse_points=np.array(points, np.float32).reshape(-1, 3),
        radial=np.array(radial, np.float64) if any(radial) else np.zeros(0, np.float64),
    )
