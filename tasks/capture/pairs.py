"""Which photos are matched in full: pairs grow with the square of the photos, overlaps do not.

Every photo chooses among those before it. So what a photo chooses depends on no later one, and a capture that grows at
its end matches only the pairs that are new.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Int32, UInt8
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.matches import descriptor_matches
from ss_flow.tasks.ranges import Count, Natural

_FIRST, _LIKELY = 4, 4
"""A quarter of the features of the first look, which takes an eighth of the time, tells which photos may be similar:
four times as many as are wanted. This is all that grows with the square of the photos."""


@dataclass(frozen=True)
class PairParams:
    """Which photos are compared."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which photos are matched in full: "exhaustive" (all pairs), "sequential" (neighbours in the order of the names),
    or "auto": the `partners` most similar ones, and in a numbered series or a video the neighbours too."""
    exhaustive_limit: Natural = 30
    """In "auto", so many photos are matched with all the others of them, however similar."""
    partners: Count = 12
    """To how many photos before it a photo is matched in full."""
    overlap: Natural = 6
    """How many neighbours on either side of a photo in a series are matched in full, whether similar or not."""
    look_features: Count = 384
    """With so many of their largest features photos are compared to find the similar ones."""
    min_similar: Natural = 4
    """Photos with fewer matches at this first look are not similar."""


@dataclass(frozen=True)
class Look:
    """The largest features of a photo."""

    name: str
    descriptors: UInt8
    """[N, 128] as those of `Features`."""


@dataclass(frozen=True)
class Partners:
    """The photos that one is matched with."""

    row: Int32
    """[P] ascending rows of the photos that it could choose from."""


@task(name="capture.look")
def look(photo: Features, *, count: int) -> Look:
    """The first `count` features of a photo."""
    return Look(photo.name, photo.descriptors[:count])


@task(name="capture.partners")
def partners(photo: Look, others: Sequence[Look], *, place: int, params: PairParams = PairParams()) -> Partners:
    """Those of some photos, in order, with which one is matched in full.

    place: where it stands among them: as many come before it.
    """
    count = len(others)
    if params.matching == "exhaustive" or (params.matching == "auto" and count < params.exhaustive_limit):
        return Partners(np.arange(count, dtype=np.int32))
    near = range(max(0, place - params.overlap), min(count, place + params.overlap))
    if params.matching == "sequential":
        return Partners(np.array(near, np.int32))
    looks = [others[row] for row in range(count)]
    first = _similar(photo, looks, params.look_features // _FIRST)
    likely = np.sort(np.argsort(-first, kind="stable")[: _LIKELY * params.partners])
    similar = np.zeros(count, np.int32)
    similar[likely] = _similar(photo, [looks[row] for row in likely], params.look_features)
    nearest = np.argsort(-similar, kind="stable")[: params.partners]
    beside = [row for row in near if in_series(looks[row].name, photo.name)]
    chosen = {*nearest[similar[nearest] >= params.min_similar].tolist(), *beside}
    return Partners(np.array(sorted(chosen or nearest.tolist()), np.int32))


def _similar(photo: Look, others: Sequence[Look], count: int) -> Int32:
    """[len(others)] how many of the first `count` features of a photo match those of each other one."""
    own = photo.descriptors[:count].astype(np.float32)
    found = [len(descriptor_matches(own, other.descriptors[:count].astype(np.float32))) for other in others]
    return np.array(found, np.int32)


def in_series(a: str, b: str) -> bool:
    """Whether two names differ in one number only, as those of a video's frames or of a camera's photos do."""
    parts = [re.split(r"([0-9]+)", name) for name in (a, b)]
    if len(parts[0]) != len(parts[1]):
        return False
    different = [i for i, (x, y) in enumerate(zip(*parts, strict=True)) if x != y]
    return len(different) == 1 and different[0] % 2 == 1
