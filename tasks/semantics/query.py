"""Which instances a text means (Split&Splat, Sec. 4.2 and 4.4.4; spec row 41, A29)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import Descriptors, Float32, Int32, UInt8
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.ranges import Fraction, Positive
from ss_flow.tasks.semantics.encoders import encoder_of

_TEMPERATURE = 10.0
_HALF = 0.5


@dataclass(frozen=True)
class QueryParams:
    """Which instances a text means."""

    tau_corr: Positive = 0.02
    """How much further than the best an instance's descriptor may be from the text and still match."""
    min_relevancy: Fraction = 0.5
    """Relevancy above which a text fits an instance: above 0.5 it fits better than every negative of the encoder; 0
    leaves out the test, as in the paper. Colour words keep to 0.5."""
    prompt: str = "{text}"
    """What the encoder reads, with the text in the place of {text}; "an image of a {text}" in the code of the paper's
    authors."""


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
    """Whether the best instance fits at all; otherwise nothing in the scene matches."""

    def matches(self) -> list[int]:
        """The ids that the text means, the best first."""
        return [int(i) for i in self.instance_id[self.matched > 0]]


@task(environment=network_identity)
def query(
    descriptors: tuple[Descriptors, ...],
    *,
    text: str,
    params: QueryParams = QueryParams(),
    encoder: Model | None = None,
    background: bool = False,
) -> QueryResult:
    """Rank the instances against a text; an instance matches when the text fits it and delta < tau_corr.

    The text fits where relevancy > `min_relevancy`: the smallest, over the encoder's negatives n, of the softmax share
    exp(10 s) / (exp(10 s) + exp(10 s_n)) (Kerr et al., "LERF", Sec. 3.4).

    With colour words the negatives are the other colours, so a text fits the objects of which its colour is the most
    common; being red is no matter of degree between objects, and all of these match, whatever their delta.

    background: whether the background (id 0) is ranked too. It is no object: a text that fits it best, "wall" or
    "grey", would otherwise leave the objects further than tau_corr behind.

    Raises InputError for an empty text, a text that the encoder cannot read, descriptors of another encoder, a
    tau_corr that is not positive, and a prompt without {text}.
    """
    model = encoder_of(encoder)
    if not text.strip():
        raise InputError('The query is empty; ask for something, for example "the red mug".')
    if not params.tau_corr > 0:
        raise InputError(f"tau_corr is {params.tau_corr}; it must be above 0 (0.02 is usual).")
    if "{text}" not in params.prompt:
        raise InputError(f"The prompt {params.prompt!r} has no {{text}} in it; one is 'an image of a {{text}}'.")
    foreign = sorted({d.encoder for d in descriptors} - {model.name})
    if foreign:
        raise InputError(
            f"The descriptors were made by {foreign[0]} and the query would be read by {model.name}; both must be one "
            "encoder."
        )
    ranked = [d for d in descriptors if background or d.instance_id != 0]
    texts = [params.prompt.replace("{text}", phrase) for phrase in (text, *model.negatives(text))]
    words = model.encode_texts(texts)
    ids = np.array([d.instance_id for d in ranked], np.int32)
    vectors = np.array([d.embedding for d in ranked], np.float32).reshape(len(ids), model.dimension)
    seen = np.linalg.norm(vectors, axis=1) > 0
    cosines = np.einsum("ld,td->lt", vectors, words)
    cosines[~seen] = -1
    order = np.lexsort((ids, -cosines[:, 0]))
    cosines, seen = cosines[order], seen[order]
    score = cosines[:, 0]
    delta = score[:1] - score
    relevancy = _relevancy(score, cosines[:, 1:]) * seen
    fits = relevancy > (_HALF if model.absolute else params.min_relevancy)
    matched = fits if model.absolute else fits & (delta < params.tau_corr)
    return QueryResult(
        text=text,
        encoder=model.name,
        instance_id=ids[order],
        score=score,
        margin=score - np.append(score[1:], score[-1:]),
        delta=delta,
        relevancy=relevancy.astype(np.float32),
        matched=matched.astype(np.uint8),
        accepted=bool(fits[:1].any()),
    )


def _relevancy(score: Float32, negatives: Float32) -> Float32:
    """[L] the smallest softmax share against one negative; 1 where there are none. negatives: [L, N] cosines."""
    shares = 1 / (1 + np.exp(_TEMPERATURE * (negatives - score[:, None])))
    return shares.min(axis=1, initial=1.0)
