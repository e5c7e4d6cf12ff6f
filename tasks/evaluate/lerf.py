"""A finished scene on frames labelled as LERF-OVS labels them, by three protocols (spec 2.2).

`strict` and `langsplat_2d` look for things by text alone; `oracle` lets the ground truth choose among what the text
admits, as the code of the paper's authors does. Their figures must not stand in one column. All compare in the pixels
of the label files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ss_flow.cache.plain_json import read_json
from ss_flow.errors import InputError
from ss_flow.running import progress, warn
from ss_flow.task import FileRef, Resources, task
from ss_flow.tasks.artifacts import Bool, Cameras, Descriptors, Float32, Float64, Frame, Gaussians, LabelMap, Metrics
from ss_flow.tasks.capture.lens import Lens, photo_lens
from ss_flow.tasks.capture.photo_pixels import T, on_photo, photo_pixels
from ss_flow.tasks.evaluate.openvocab import (
    LabelledFrame,
    labelled_frame,
    oracle_ious,
    oracle_scores,
    strict_ious,
    strict_scores,
    strict_targets,
)
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.masks.overlap import iou
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.semantics.encoders import encoder_of
from ss_flow.tasks.semantics.query import QueryResult, Similarity, relevancy_of

SILHOUETTE = 0.7
"""Accumulated alpha from which a pixel belongs to a silhouette (OpenGaussian)."""
_MEAN_FILTER = 30
_CUT_2D = 0.4
_MAJORITY = 7
"""Pixels across the window whose majority decides, in LangSplat's protocol."""
_LABELS_AT_ONCE = 16


@dataclass(frozen=True)
class Labels:
    """The label files of a scene, and how its photos were taken."""

    views: tuple[str, ...]
    """The labelled views."""
    files: tuple[FileRef, ...]
    """The label file of each."""
    photos: tuple[str, ...] = ()
    """The views of which the capture states the lens."""
    lenses: tuple[Lens, ...] = ()
    """The lens of each of these."""


def read_label(file: Path) -> LabelledFrame:
    """One label file. Raises InputError when it is none."""
    try:
        document = read_json(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read as JSON ({error}).") from None
    return labelled_frame(document, str(file))


@task(name="evaluate.lerf_strict", resources=Resources(cores=1, gpus=0.1), environment=backend_identity)
def strict(
    frames: Sequence[Frame],
    cameras: Cameras,
    scene: Gaussians,
    answers: tuple[QueryResult, ...],
    *,
    labels: Labels,
    categories: tuple[str, ...],
) -> Metrics:
    """The strict protocol (OpenGaussian): what a text selects is rendered alone, and where its alpha exceeds 0.7 is
    compared with the union of the category's polygons.

    answers: what the text of each of the categories means; a category that is not among them scores 0.
    Returns miou, macc25, macc50 over all (frame, category) pairs, num_targets, num_frames.
    Raises InputError when no labelled frame is a view of the scene.
    """
    selected = {category: answer.matches() for category, answer in zip(categories, answers, strict=True)}
    scores = []
    for view, label, carried in _labelled(frames, cameras, labels):
        camera = camera_of(cameras, view)
        silhouettes = {}
        for category in strict_targets(label):
            ids = selected.get(category, [])
            if ids:
                alone = select(scene, np.isin(scene.instance_id, ids))
                silhouettes[category] = carried(render(alone, camera).alpha) > SILHOUETTE
        scores.append(strict_ious(label, silhouettes))
    return Metrics({**strict_scores(scores), **_counts(scores)})


@task(name="evaluate.lerf_oracle")
def oracle(
    frames: Sequence[Frame],
    cameras: Cameras,
    maps: Sequence[LabelMap],
    found: tuple[Similarity, ...],
    *,
    labels: Labels,
    categories: tuple[str, ...],
    tau_corr: float,
) -> Metrics:
    """The protocol of the paper's authors: ground truth chooses among the instances whose score is within `tau_corr` of
    the best one's.

    maps: ids of all views, one a pixel. found: how well the text of each of the categories fits each instance.
    Returns miou, macc25, macc50 (means of the frames' means, hits at >=), share (mean over the categories of the share
    of the instances that are candidates), num_targets, num_frames. Raises InputError as `strict`.
    """
    candidates = {name: _candidates(one, tau_corr) for name, one in zip(categories, found, strict=True)}
    scores = []
    for view, label, carried in _labelled(frames, cameras, labels):
        scores.append(oracle_ious(label, carried(maps[view].ids), candidates))
    shares = [len(candidates[name]) / max(len(one.instance_id), 1) for name, one in zip(categories, found, strict=True)]
    return Metrics({**oracle_scores(scores), "share": float(np.mean(shares)) if shares else 0.0, **_counts(scores)})


@task(
    name="evaluate.lerf_2d",
    resources=Resources(cores=1, gpus=0.1),
    environment=lambda: backend_identity() | network_identity(),
)
def langsplat_2d(
    frames: Sequence[Frame],
    cameras: Cameras,
    scene: Gaussians,
    descriptors: tuple[Descriptors, ...],
    *,
    labels: Labels,
    texts: tuple[tuple[str, str], ...],
    encoder: Model | None = None,
) -> Metrics:
    """LangSplat's protocol on rendered features: every Gaussian carries the descriptor of its instance.

    A category's relevancy map is half raw and half a 30 x 30 mean, stretched from its least to its largest value over
    -1..1; a pixel belongs to it above 0.4, by the majority of the 7 x 7 pixels around it (`smooth` in LangSplat's
    `eval/utils.py`). It is localised when the largest mean lies in the box of one of its polygons.
    texts: (category, what the encoder reads). Returns miou, macc25, macc50 as `strict`, localised (share of the pairs),
    num_targets, num_frames. Raises InputError as `strict`.
    """
    model = encoder_of(encoder)
    words = {category: model.encode_texts([text, *model.negatives(text)]) for category, text in texts}
    own = {d.instance_id: d.embedding for d in descriptors}
    labelled, hits = [], []
    for view, label, carried in _labelled(frames, cameras, labels):
        weights, ids = _weights(scene, cameras, view)
        features = np.array([own.get(int(i), np.zeros(model.dimension)) for i in ids], np.float32)
        features = features.reshape(len(ids), model.dimension)
        square = np.einsum("lp,lp->p", weights, (features @ features.T) @ weights)
        length = np.sqrt(np.maximum(square, 1e-12))
        scores = {}
        for category, target in strict_targets(label).items():
            if category not in words:
                scores[category] = 0.0
                hits.append(False)
                continue
            cosines = ((words[category] @ features.T) @ weights).T / length[:, None]
            raw = relevancy_of(cosines[:, 0], cosines[:, 1:]).reshape(frames[view].height, frames[view].width)
            mask, peak = _found_2d(carried(raw.astype(np.float32)))
            scores[category] = iou(mask, target)
            hits.append(_in_a_box(label, category, peak))
        labelled.append(scores)
    return Metrics({**strict_scores(labelled), "localised": float(np.mean(hits)), **_counts(labelled)})


class _Carried:
    """Brings what a frame's pixels hold to the pixels of its label."""

    def __init__(self, frame: Frame, lens: Lens | None, label: LabelledFrame) -> None:
        self._frame, self._size = frame, (label.width, label.height)
        self._pixels = None if lens is None else photo_pixels(frame, lens)

    def __call__(self, image: NDArray[T]) -> NDArray[T]:
        import cv2

        on = on_photo(image, self._frame, self._pixels)
        if on.shape[::-1] == self._size:
            return on
        return np.asarray(cv2.resize(on, self._size, interpolation=cv2.INTER_NEAREST_EXACT), image.dtype)


def _labelled(
    frames: Sequence[Frame], cameras: Cameras, labels: Labels
) -> Iterator[tuple[int, LabelledFrame, _Carried]]:
    """The labelled views: row of the frame, its label, and what brings images of the frame to the label's pixels."""
    rows = cameras.row_of()
    stated = dict(zip(labels.photos, labels.lenses, strict=True))
    present = [(view, file) for view, file in zip(labels.views, labels.files, strict=True) if view in rows]
    if not present:
        raise InputError("None of the labelled frames is a view of this run; labels are files named like the views.")
    if lacking := [view for view in labels.views if view not in rows]:
        warn(f"{len(lacking)} labelled frames are no view of this run and do not count, {lacking[0]} among them.")
    for done, (view, file) in enumerate(present):
        label, frame = read_label(file.path), frames[rows[view]]
        if abs(label.width * frame.source_height / (label.height * frame.source_width) - 1) > 0.01:
            raise InputError(
                f"{file.path} labels {label.width} x {label.height} pixels and photo {view} has "
                f"{frame.source_width} x {frame.source_height}; both must show the same."
            )
        yield rows[view], label, _Carried(frame, photo_lens(frame, stated.get(view), cameras), label)
        progress(done + 1, len(present), view)


def _candidates(found: Similarity, tau_corr: float) -> frozenset[int]:
    near = found.score >= found.score.max(initial=-1.0) - tau_corr
    return frozenset(found.instance_id[near & (found.score > -1)].tolist())


def _counts(scores: Sequence[Mapping[str, float] | Sequence[float]]) -> dict[str, float]:
    return {"num_targets": float(sum(map(len, scores))), "num_frames": float(len(scores))}


def _weights(scene: Gaussians, cameras: Cameras, view: int) -> tuple[Float32, list[int]]:
    """[L, H * W] what each instance makes up of each pixel, and the instances, the background among them."""
    camera = camera_of(cameras, view)
    ids = np.unique(scene.instance_id).tolist()
    parts = [
        render(scene, camera, label_ids=ids[start : start + _LABELS_AT_ONCE]).label_masks
        for start in range(0, len(ids), _LABELS_AT_ONCE)
    ]
    nothing = np.zeros((0, camera.height, camera.width), np.float32)
    return np.concatenate([nothing, *parts]).reshape(len(ids), -1), ids


def _found_2d(relevancy: Float32) -> tuple[Bool, tuple[int, int]]:
    """The mask of a relevancy map, and the place (x, y) of the largest mean."""
    import cv2

    mean = cv2.blur(relevancy, (_MEAN_FILTER, _MEAN_FILTER))
    both: Float64 = (relevancy.astype(np.float64) + mean) / 2
    spread = both.max() - both.min()
    stretched = np.clip(2 * (both - both.min()) / (spread if spread > 0 else 1) - 1, 0, 1)
    above = (stretched > _CUT_2D).astype(np.float32)
    # Of a window that reaches over the border, the part inside the image decides.
    counts, areas = (
        cv2.boxFilter(a, -1, (_MAJORITY, _MAJORITY), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for a in (above, np.ones_like(above))
    )
    row, column = np.unravel_index(int(mean.argmax()), mean.shape)
    return 2 * counts > areas, (int(column), int(row))


def _in_a_box(label: LabelledFrame, category: str, place: tuple[int, int]) -> bool:
    corners = [polygon for name, polygon in label.polygons if name == category]
    return any(bool(((c.min(axis=0) <= place) & (place <= c.max(axis=0))).all()) for c in corners)
