"""Which instances, or parts of them, a text means (Split&Splat, Sec. 5.2 and 5.4.4; spec row 41, A29)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import Descriptors, Float32, Int32, PartDescriptors, UInt8
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.ranges import Count, Fraction, NonNegative, Positive
from ss_flow.tasks.semantics.encoders import encoder_of
from ss_flow.tasks.semantics.sides import sides

_TEMPERATURE = 10.0
_HALF = 0.5
_NOT = re.compile(r"(?<![\w-])(?:but\s+)?not(?![\w-])", re.IGNORECASE)
"""The word by itself; in "forget-me-not" it is none."""


def _check_prompt(prompt: str) -> None:
    if "{text}" not in prompt:
        raise InputError(f"The prompt {prompt!r} has no {{text}} in it; one is 'an image of a {{text}}'.")


@dataclass(frozen=True)
class QueryParams:
    """Which instances a text means."""

    select: Literal["delta", "topk"] = "delta"
    """Of the instances that the text fits: "delta" takes those near the best, "topk" the best few."""
    tau_corr: Positive = 0.02
    """With delta: how much further than the best an instance's descriptor may be from the text and still match."""
    top_k: Count = 1
    """With topk: how many match at most."""
    min_relevancy: Fraction = 0.5
    """Relevancy above which a text fits an instance: above 0.5 it fits better than every negative of the encoder; 0
    leaves out the test, as in the paper. Colour words keep to 0.5."""
    tau_view: NonNegative = 0.0
    """Cosine distance above which two views of an object show different sides of it, as the cover and the back of a
    book; a text then fits as well as it fits the mean or the side that it fits best. 0 takes the mean alone."""
    prompt: str = "{text}"
    """What the encoder reads, with the text in the place of {text}; "an image of a {text}" in the code of the paper's
    authors."""

    def __post_init__(self) -> None:
        _check_prompt(self.prompt)


@dataclass(frozen=True)
class Similarity:
    """How well a text fits each instance."""

    text: str
    encoder: str
    """Name of the text-image encoder."""
    absolute: bool
    """Whether a text fits an instance or not, whatever the others are like (`TextImageEncoder.absolute`)."""
    instance_id: Int32
    """[L] in the order of the descriptors."""
    score: Float32
    """[L] cosine of the instance's descriptor and the text, of several terms the least; -1 without a descriptor. Of a
    text that only says what is not meant, 1 less the largest cosine."""
    relevancy: Float32
    """[L] 0..1, above 0.5 where every term fits better than every negative; 0 for an instance without a descriptor."""
    part_id: Int32
    """[L] the part of the instance that is meant, 0 = the whole."""


@dataclass(frozen=True)
class QueryResult:
    """The instances, the best first, and which of them the text means."""

    text: str
    encoder: str
    """Name of the text-image encoder that answered."""
    instance_id: Int32
    """[L]."""
    score: Float32
    """[L] cosine of the instance's descriptor and the text; -1 for an instance without a descriptor."""
    margin: Float32
    """[L] score less that of the next instance; 0 for the last."""
    delta: Float32
    """[L] d - min d, with the distance d = 1 - score."""
    relevancy: Float32
    """[L] 0..1, above 0.5 where the text fits better than every negative; 0 for an instance without a descriptor."""
    matched: UInt8
    """[L] 1 for the instances that the text means."""
    accepted: bool
    """Whether the text means any instance; otherwise nothing in the scene matches."""
    part_id: Int32
    """[L] the part of the instance that is meant, 0 = the whole."""

    def matches(self) -> list[int]:
        """The ids that the text means, the best first."""
        return [int(i) for i in self.instance_id[self.matched > 0]]


def terms(text: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What a text asks for, and what it does not mean: "red mug, not the lamp" -> ("red mug",), ("the lamp",).

    Terms stand between commas; what follows the word "not" (or "but not") in a term is not meant.
    Raises InputError for a text without a term, and a "not" that nothing follows.
    """
    wanted, unwanted = [], []
    for term in text.split(","):
        first, *others = (part.strip() for part in _NOT.split(term))
        wanted += [first] if first else []
        if not all(others):
            raise InputError(f'In the query {text!r} nothing follows "not"; ask for something like "red, not the mug".')
        unwanted += others
    if not wanted and not unwanted:
        raise InputError('The query is empty; ask for something, for example "the red mug".')
    return tuple(wanted), tuple(unwanted)


def query(
    descriptors: tuple[Descriptors, ...],
    *,
    text: str,
    params: QueryParams = QueryParams(),
    encoder: Model | None = None,
    background: bool = False,
) -> QueryResult:
    """Rank the instances against a text; in a flow, two nodes. See `similarity` and `chosen`."""
    found = similarity(
        descriptors,
        text=text,
        prompt=params.prompt,
        encoder=encoder,
        background=background,
        tau_view=params.tau_view,
    )
    return chosen(found, params=params)


@task(name="semantics.similarity", environment=network_identity)
def similarity(
    descriptors: tuple[Descriptors, ...],
    *,
    text: str,
    prompt: str = QueryParams.prompt,
    encoder: Model | None = None,
    background: bool = False,
    tau_view: NonNegative = QueryParams.tau_view,
) -> Similarity:
    """How well a text fits each instance.

    A term fits where relevancy > 0.5: the smallest, over the encoder's negatives n, of the softmax share
    exp(10 s) / (exp(10 s) + exp(10 s_n)) (Kerr et al., "LERF", Sec. 3.4). Of several terms (see `terms`) all must fit;
    those that are not meant are further negatives of each. A text that only says what is not meant fits where none of
    these terms does.

    With colour words the negatives are the other colours, so a text fits the objects of which its colour is the most
    common.

    With `tau_view` above 0 an object has several `sides`, and fits a term as its best side does; a term that is not
    meant counts for all of them, whichever side it fits.

    background: whether the background (id 0) is ranked too. It is no object: a text that fits it best, "wall" or
    "grey", would otherwise leave the objects further than tau_corr behind.

    Raises InputError for an empty text, a text that the encoder cannot read, descriptors of another encoder, and a
    prompt without {text}.
    """
    model = encoder_of(encoder)
    wanted, unwanted = terms(text)
    _check_prompt(prompt)
    foreign = sorted({d.encoder for d in descriptors} - {model.name})
    if foreign:
        raise InputError(
            f"The descriptors were made by {foreign[0]} and the query would be read by {model.name}; both must be one "
            "encoder."
        )
    ranked = [d for d in descriptors if background or d.instance_id != 0]
    seen = np.array([d.embedding.any() for d in ranked], bool)
    looks = [sides(d, tau_view) for d in ranked]
    vectors = np.concatenate([np.zeros((0, model.dimension), np.float32), *looks])
    owner = np.repeat(np.arange(len(looks)), [len(each) for each in looks])
    first = np.searchsorted(owner, np.arange(len(looks)))

    def cosines(phrases: tuple[str, ...]) -> Float32:
        words = model.encode_texts([prompt.replace("{text}", phrase) for phrase in phrases])
        return np.einsum("sd,td->st", vectors, words)

    def best(of_sides: Float32) -> Float32:
        return np.maximum.reduceat(of_sides, first) if len(first) else of_sides

    refused = best(cosines(unwanted))[owner] if wanted and unwanted else vectors[:, :0]
    fits = [cosines((term, *model.negatives(term))) for term in wanted or unwanted]
    scores = np.stack([best(found[:, 0]) for found in fits], axis=1)
    against = [np.concatenate([found[:, 1:], refused], axis=1) for found in fits]
    shares = [relevancy_of(found[:, 0], others) for found, others in zip(fits, against, strict=True)]
    relevancies = np.stack([best(share) for share in shares], axis=1)
    score, relevancy = (
        (scores.min(axis=1), relevancies.min(axis=1))
        if wanted
        else (1 - scores.max(axis=1), 1 - relevancies.max(axis=1))
    )
    return Similarity(
        text=text,
        encoder=model.name,
        absolute=model.absolute or not wanted,
        instance_id=np.array([d.instance_id for d in ranked], np.int32),
        score=np.where(seen, score, -1).astype(np.float32),
        relevancy=(relevancy * seen).astype(np.float32),
        part_id=np.array([d.part_id if isinstance(d, PartDescriptors) else 0 for d in ranked], np.int32),
    )


@task(name="semantics.query")
def chosen(found: Similarity, *, params: QueryParams = QueryParams()) -> QueryResult:
    """The instances, the best first; one matches when the text fits it and, by `select`, delta < tau_corr or it is
    among the first `top_k`.

    With colour words being red is no matter of degree between objects: with "delta" all that the text fits match.

    Raises InputError for a tau_corr that is not positive.
    """
    if not params.tau_corr > 0:
        raise InputError(f"tau_corr is {params.tau_corr}; it must be above 0 (0.02 is usual).")
    order = np.lexsort((found.part_id, found.instance_id, -found.score))
    score, relevancy = found.score[order], found.relevancy[order]
    delta = score[:1] - score
    fits = relevancy > (_HALF if found.absolute else params.min_relevancy)
    by_delta = (delta < params.tau_corr) | found.absolute
    matched = fits & (np.cumsum(fits) <= params.top_k if params.select == "topk" else by_delta)
    return QueryResult(
        text=found.text,
        encoder=found.encoder,
        instance_id=found.instance_id[order],
        score=score,
        margin=score - np.append(score[1:], score[-1:]),
        delta=delta,
        relevancy=relevancy,
        matched=matched.astype(np.uint8),
        accepted=bool(matched.any()),
        part_id=found.part_id[order],
    )


def relevancy_of(score: Float32, negatives: Float32) -> Float32:
    """[L] the smallest softmax share against one negative; 1 where there are none. negatives: [L, N] cosines."""
    shares = 1 / (1 + np.exp(_TEMPERATURE * (negatives - score[:, None])))
    return shares.min(axis=1, initial=1.0)
