"""What a text means in a finished run: what `ss-flow query` adds to a flow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ss_flow.graph import each
from ss_flow.tasks.artifacts import PartDescriptors, PartMasks
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.colour_words import ColourWords, words_ignored
from ss_flow.tasks.semantics.describe import DescribeParams, describe_part
from ss_flow.tasks.semantics.part_masks import part_masks
from ss_flow.tasks.semantics.query import QueryResult

NEEDED = ("ingest", "cameras", "scene", "masks")
"""The results of a run that its parts are found in."""


def described_parts(
    nodes: Mapping[str, Any], encoder: Model | None, params: DescribeParams, turns: int
) -> tuple[tuple[PartMasks, ...], tuple[PartDescriptors, ...]]:
    """Where the parts of all instances are seen, and what the encoder says of each.

    nodes: the results of a run by name. turns: as the run had it.
    """
    params, turns = params.in_use(encoder), turns if encoder is not None else 0
    parts = part_masks(nodes["cameras"], nodes["scene"], nodes["masks"])
    return parts, each(
        parts,
        build=lambda part: describe_part(nodes["ingest"], part, encoder=encoder, params=params, turns=turns),
    )


def words_left_out(found: QueryResult) -> str:
    """What is to be said of words that were not understood; "" where all were."""
    if found.encoder != ColourWords.name or not (ignored := words_ignored(found.text)):
        return ""
    without = ", ".join(f'"{word}"' for word in ignored)
    return f"Only colour words were understood, not {without}; `ss-flow models list` shows what reads more."
