"""Instances -> labels of a scene that was trained elsewhere: what takes the place of Splat with `--scene`."""

from __future__ import annotations

from typing import Any

from ss_flow.flows.capture import Capture
from ss_flow.flows.params import Params
from ss_flow.flows.splat import described, final_masks
from ss_flow.flows.split import Networks, Split
from ss_flow.graph import each, labelled
from ss_flow.tasks.artifacts import Gaussians, LabelMap
from ss_flow.tasks.splat.label import label, own_gaussians, vote


def label_given(
    capture: Capture,
    found: Split,
    masks_split: tuple[LabelMap, ...],
    networks: Networks,
    params: Params,
) -> dict[str, Any]:
    """The results of Splat, by the same names where there is such a step, for the Gaussians that came with the capture.

    The masks of Split vote on the Gaussians, all views on all of them; then the masks that the labelled scene shows,
    which have learnt from all views, vote once more. No instance is reconstructed, so no mask is compared with the
    segmenter's second answer (Split&Splat, Sec. 3.2.2).
    """
    given, settings = capture.given, params.splat
    assert given is not None

    def voted(shown: tuple[LabelMap, ...]) -> Gaussians:
        votes = each(
            capture.frames,
            capture.by_view,
            shown,
            names=capture.names,
            build=lambda frame, camera, own: vote(given, frame, camera, own),
        )
        return label(given, votes, found.points, found.labels, found.parts, params=settings.label)

    masks = masks_split
    for number in range(settings.label.rounds):
        with labelled(str(number)):
            scene = voted(masks)
            masks = final_masks(capture, scene, masks, params)
    return {
        "refine": found.instances,
        "scene": scene,
        "masks": masks,
        "describe": described(
            capture,
            found,
            networks,
            params,
            found.instances.__getitem__,
            lambda row: own_gaussians(scene, found.instances[row]),
        ),
    }
