"""Photos -> instance masks of single views: the capture's own, the segmenter's, or of clicked objects (Sec. 3.1.1)."""

from __future__ import annotations

from ss_flow.errors import InputError
from ss_flow.flows.capture import Capture
from ss_flow.flows.params import SplitParams
from ss_flow.graph import each
from ss_flow.tasks.artifacts import Clicks, MaskSet, PointCloud, PointLabels, PromptedMasks, Visibility
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.sam import EmbeddedPhoto, Embedding
from ss_flow.tasks.split import hints
from ss_flow.tasks.split.close_ups import close_ups
from ss_flow.tasks.split.segment import segment
from ss_flow.tasks.split.segment_rgbd import segment_rgbd


def masks_of_views(
    capture: Capture,
    embeddings: tuple[Embedding, ...],
    points: PointCloud,
    seen: tuple[Visibility, ...],
    segmenter: Model | None,
    params: SplitParams,
) -> tuple[tuple[MaskSet, ...], PointLabels | None]:
    """The masks of all views (M_k; Sec. 3.1.1): the capture's own, those of clicked objects, or the segmenter's; and
    the points labelled by the objects that were clicked, where some were."""
    if capture.masks is not None:
        return capture.masks, None
    if capture.clicks is not None:
        return _of_hints(capture, capture.clicks, embeddings, points, seen, segmenter, params)
    return _segmented(capture, embeddings, segmenter, params), None


def _segmented(
    capture: Capture, embeddings: tuple[Embedding, ...], segmenter: Model | None, params: SplitParams
) -> tuple[MaskSet, ...]:
    """The masks of all views, from the segmenter, or without one from colour, depth and normals."""
    if segmenter is None:
        return each(
            capture.frames,
            capture.depths,
            capture.by_view,
            names=capture.names,
            build=lambda frame, depth, camera: segment_rgbd(frame, depth, camera, params=params.rgbd),
        )
    segmenting = params.segment.in_use()
    masks = each(
        capture.frames,
        embeddings,
        names=capture.names,
        build=lambda frame, embedding: segment(frame, embedding, params=segmenting, model=segmenter),
    )
    if not params.close_ups.side:
        return masks
    return each(
        capture.frames,
        masks,
        names=capture.names,
        build=lambda frame, whole: close_ups(
            frame,
            whole,
            params=params.close_ups,
            segmenting=segmenting,
            model=segmenter,
            turns=capture.turns,
            noise=params.noise,
        ),
    )


def _of_hints(
    capture: Capture,
    clicks: tuple[Clicks, ...],
    embeddings: tuple[Embedding, ...],
    points: PointCloud,
    seen: tuple[Visibility, ...],
    segmenter: Model | None,
    params: SplitParams,
) -> tuple[tuple[MaskSet, ...], PointLabels]:
    """The masks of all views from points clicked in a few, and the points labelled by the clicked objects."""
    if segmenter is None:
        raise InputError(
            "hints need a segmenter to be prompted with, and there is none; `ss-flow models list` names some."
        )
    clicked = clicked_masks(capture, clicks, embeddings, segmenter, params)
    hinted = labelled(points, seen, clicked, params)
    masks = each(
        capture.frames,
        embeddings,
        seen,
        clicked,
        names=capture.names,
        build=lambda frame, embedding, visible, own: hints.spread(
            EmbeddedPhoto(frame, embedding),
            visible,
            own,
            hinted,
            params=params.reprompt,
            contained=params.segment.contained,
            model=segmenter,
        ),
    )
    return masks, hinted


def clicked_masks(
    capture: Capture,
    clicks: tuple[Clicks, ...],
    embeddings: tuple[Embedding, ...],
    segmenter: Model,
    params: SplitParams,
    *,
    apart: bool = False,
) -> tuple[PromptedMasks, ...]:
    """The masks that clicks ask for in their own views. apart: whether no clicked object is part of another."""
    return each(
        capture.frames,
        embeddings,
        clicks,
        names=capture.names,
        build=lambda frame, embedding, own: hints.clicked(
            EmbeddedPhoto(frame, embedding), own, speckle=params.reprompt.speckle, model=segmenter, apart=apart
        ),
    )


def labelled(
    points: PointCloud, seen: tuple[Visibility, ...], clicked: tuple[PromptedMasks, ...], params: SplitParams
) -> PointLabels:
    """The points by what was clicked."""
    return hints.label(points, seen, clicked, erosion=params.observe.erosion, tau_label=params.propagate.tau_label)
