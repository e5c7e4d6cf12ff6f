"""Labels from votes in the order of the views (Split&Splat, Algorithm 1, repaired; spec S4).

Repaired where the printed algorithm cannot be meant: the first view votes like all others, before an empty virtual
image; that image has the labels of all views before, not of the last one alone (spec A3); and all points of a mask vote
for the label that the mask took, a number of its own if it took none. Masks of one view do not see each other's votes
(spec A5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ss_flow.running import progress
from ss_flow.tasks.artifacts import BORDER, Float64, Int32, Observation, Visibility
from ss_flow.tasks.geometry.zbuffer import paint
from ss_flow.tasks.ranges import Count, Fraction, Natural, NonNegative, Range
from ss_flow.tasks.split.votes.votes import Votes


@dataclass(frozen=True)
class SequentialParams:
    """How masks become labels, view after view."""

    passes: Count = 1
    """How often all views vote; each further pass matches every view against the labels of the pass before."""
    lambda_init: Annotated[float, Range(0.0, 1.0, open_below=True, open_above=True)] = 0.25
    """What the first vote of a point weighs more than later ones, between 0 and 1."""
    contested_vote: Fraction = 0.0
    """Weight of a vote from a mask that touched several labels; 0 = the share of the label it went to."""
    contested_first_vote: NonNegative = 0.0
    """The same of a vote that is the point's first; 0 = the product of both weights. 1 in the code of the paper's
    authors."""
    min_overlap: Natural = 3
    """Painted pixels under a mask below which it is a new object."""
    min_overlap_share: Fraction = 0.1
    """The same as a share of the pixels under the mask where points fall; the larger of the two counts."""
    min_new_points: Natural = 10
    """Points under a mask below which it founds no object."""


@dataclass(frozen=True)
class Matches:
    """All matched masks of all views, in the order in which they voted."""

    view: list[int]
    mask: list[int]
    label: list[int]


def vote_in_turn(
    num_points: int,
    visibility: Sequence[Visibility],
    observations: Sequence[Observation],
    tau_label: float,
    params: SequentialParams,
) -> tuple[Votes, Matches]:
    """The votes of all points after all views, and what each mask voted for.

    visibility, observations: one of each per view, in the order of the views. View by view, the labels so far are
    painted into the view; every mask takes the label it overlaps most, or founds a new one; then its points vote for
    it. The order of the masks of a view does not matter.
    """
    given = np.zeros(num_points, np.int32)
    num_labels = 0
    for turn in range(params.passes):
        votes = Votes(num_points)
        matched = Matches([], [], [])
        for k, (view, seen) in enumerate(zip(visibility, observations, strict=True)):
            progress(turn * len(visibility) + k, params.passes * len(visibility), view.name)
            virtual = _virtual_labels(view, given, votes, tau_label)
            # Two phases: no mask of a view sees the votes of another mask of the same view (spec A5).
            found = [_match(j, view, seen, virtual, num_labels, params) for j in range(len(seen.mask))]
            for j, (label, purity) in enumerate(found):
                points = seen.inside(j)
                if not label:
                    if len(points) < params.min_new_points:
                        continue
                    num_labels += 1
                    label = num_labels
                _vote(votes, points, label, purity, params)
                matched.view.append(k)
                matched.mask.append(int(seen.mask[j]))
                matched.label.append(label)
        leader, share = votes.leaders()
        given = np.where(share >= tau_label, leader, 0).astype(np.int32)
    return votes, matched


def _virtual_labels(view: Visibility, given: Int32, votes: Votes, tau_label: float) -> Int32:
    """The labels so far, painted into a view: flat image, 0 = none (Split&Splat, M*_k; spec S4.1).

    Given labels go first; points without one show what they were voted into in this pass.
    """
    voted, share = votes.leaders(view.point_index)
    label = np.where(share >= tau_label, voted, 0)
    label = np.where(given[view.point_index] > 0, given[view.point_index], label)
    sure = label > 0
    return paint(label[sure], view.pixel[sure], view.depth[sure], view.height * view.width)


def _match(
    mask: int, view: Visibility, seen: Observation, virtual: Int32, num_labels: int, params: SequentialParams
) -> tuple[int, float]:
    """The label that a mask overlaps most, 0 when it hardly overlaps any; and the share of the painted pixels under the
    mask that carry the label (spec S4.2)."""
    row, standing = seen.under(mask)
    pixels = np.unique(view.pixel[row[standing != BORDER]])
    overlap = np.bincount(virtual[pixels], minlength=num_labels + 1)[1:]
    total = int(overlap.sum())
    if total < max(params.min_overlap, params.min_overlap_share * len(pixels), 1):
        return 0, 1.0
    best = int(overlap.argmax())
    return best + 1, float(overlap[best] / total)


def _vote(votes: Votes, points: Int32, label: int, purity: float, params: SequentialParams) -> None:
    """Let the points under a mask vote for its label (spec S4.3)."""
    fresh = votes.fresh(points)
    weight: Float64 = np.where(fresh, 1.0 + params.lambda_init, 1.0)
    if purity < 1:
        weight *= params.contested_vote or purity
        if params.contested_first_vote:
            weight[fresh] = params.contested_first_vote
    votes.add(points, label, weight)
