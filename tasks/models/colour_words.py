"""Colour words: the text-image encoder that needs no weights.

It knows the eleven basic colour terms (Berlin and Kay, "Basic Color Terms", 1969) and nothing else. A picture is the
distribution of its pixels over the terms, a text is the even distribution over the colours it names; both are kept as
square roots, which have unit length, so that their cosine is the Bhattacharyya coefficient of the two distributions.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Bool, Float32, Float64, UInt8

TERMS = ("black", "white", "red", "green", "yellow", "blue", "brown", "purple", "pink", "orange", "grey")

_SHADES = {
    "black": ("000000", "141414", "1c1c22", "303034", "404044"),
    "white": ("ffffff", "f4f4f4", "faf6ee", "d8d8d6", "bebebc"),
    "red": ("ff0000", "c81e1e", "a01218", "7d0a10", "4b0a12", "dc143c", "e0453c"),
    "green": ("00ff00", "1e9632", "0a5a1e", "78c850", "3a6e3a", "556b2f", "98dc96", "20a080", "14503c", "008080"),
    "yellow": ("ffff00", "f0d21e", "ffe678", "c8b414", "fffaa0", "a8942a", "86741c", "60541a"),
    "blue": ("0000ff", "1e50c8", "50a0dc", "00bedc", "a0c8f0", "4682b4", "28466e", "0a1446", "008ca0", "5a7890"),
    "brown": ("7b4a21", "5a3214", "a0693c", "3c2414", "8b4513", "b48c64", "6e503c"),
    "purple": ("800080", "6e32a0", "9650c8", "461464", "b47ddc", "5a3c8c", "c800c8"),
    "pink": ("ffc0cb", "ff69b4", "f08ca0", "ff1493", "fab4dc", "c85a82"),
    "orange": ("ff8000", "f0690f", "ffa532", "dc6414", "fab478", "c46a18", "94500f"),
    "grey": ("808080", "969696", "6c6c6c", "5c5c5c", "646870", "9b9488"),
}
"""Shades that people call by each term, as sRGB, in the light and in the shade of a room."""

_SYNONYMS = {
    "black": "ebony jet onyx blackish",
    "white": "snowy ivory whitish",
    "red": "crimson scarlet ruby vermilion cherry maroon burgundy cardinal reddish",
    "green": "lime olive emerald jade mint khaki turquoise teal viridian chartreuse greenish",
    "yellow": "gold golden lemon mustard blond blonde amber yellowish",
    "blue": "navy azure cyan cobalt indigo sapphire aqua ultramarine cerulean bluish",
    "brown": "beige tan chocolate chestnut wooden bronze sepia auburn umber tawny copper brownish",
    "purple": "violet lilac lavender mauve plum magenta aubergine purplish",
    "pink": "rose fuchsia salmon pinkish",
    "orange": "tangerine apricot peach coral orangish",
    "grey": "gray silver silvery ash charcoal slate metallic greyish grayish",
}

_WORD = re.compile(r"[^\W\d_]+")
_LITTLE = frozenset(
    ("a", "an", "the", "and", "or", "but", "not", "one", "ones", "something", "thing", "things", "object", "objects")
)
"""Words beside a colour that ask for nothing more than it."""

_SPREAD = 9.0
"""CIELAB distance over which a pixel's membership in a term falls off."""

_MOST_PIXELS = 40_000
"""A picture with more pixels is read on a regular sub-grid: the shares of the colours hardly change."""


class ColourWords:
    """The encoder; see the module."""

    name = "colour words"
    dimension = len(TERMS)
    sees_masks = True
    absolute = True

    def encode_images(self, images: Sequence[UInt8], masks: Sequence[Bool] | None = None) -> Float32:
        """Square roots of the shares of the eleven terms among the pixels that count: [n, 11].

        images: n times [h, w, 3] RGB. masks: n times [h, w]; without them, all pixels count.
        Raises ValueError when a mask is empty.
        """
        chosen = [None] * len(images) if masks is None else masks
        rows = [
            np.sqrt(shares(image.reshape(-1, 3) if mask is None else image[mask]))
            for image, mask in zip(images, chosen, strict=True)
        ]
        return np.array(rows, np.float32).reshape(-1, len(TERMS))

    def encode_texts(self, texts: Sequence[str]) -> Float32:
        """Square roots of even distributions over the colours that each text names: [n, 11].

        Raises InputError for a text that names no colour.
        """
        rows = np.zeros((len(texts), len(TERMS)), np.float32)
        for row, text in zip(rows, texts, strict=True):
            named = colours_in(text)
            if not named:
                raise InputError(
                    f'"{text}" names no colour, and without a text-image model only colours are understood: ask for '
                    'something like "the red mug", or get a text-image network (`ss-flow models list`) and run again.'
                )
            row[[TERMS.index(term) for term in named]] = len(named) ** -0.5
        return rows

    def negatives(self, text: str) -> tuple[str, ...]:
        """The terms that the text does not name: an object counts as red when no other colour is more its own."""
        named = colours_in(text)
        return tuple(term for term in TERMS if term not in named)


def colours_in(text: str) -> tuple[str, ...]:
    """The basic terms that a text names, itself or by a synonym ("navy" -> "blue"), in the order of `TERMS`."""
    named = {_TERM_OF[word] for word in _WORD.findall(text.lower()) if word in _TERM_OF}
    return tuple(term for term in TERMS if term in named)


def words_ignored(text: str) -> tuple[str, ...]:
    """The words of a text that say nothing to this encoder, in order, each once: "the red mug" -> ("mug",)."""
    words = [word for word in _WORD.findall(text.lower()) if word not in _TERM_OF and word not in _LITTLE]
    return tuple(dict.fromkeys(words))


def shares(pixels: UInt8) -> Float64:
    """Shares of the eleven terms among pixels: [11], sum 1.

    pixels: [n, 3] RGB, n > 0. A pixel belongs to each term by exp(-d² / (2 s²)), d its CIELAB distance to the term's
    nearest shade, normalised over the terms.
    """
    if not len(pixels):
        raise ValueError("no pixel to name the colour of")
    step = -(-len(pixels) // _MOST_PIXELS)
    lab = _lab(pixels[::step])
    nearest = np.stack([nearest_shade(lab, shades) for shades in _shades_lab()], axis=1)
    exponent = (nearest.min(axis=1, keepdims=True) - nearest) / (2 * _SPREAD**2)
    membership = np.exp(exponent)
    return (membership / membership.sum(axis=1, keepdims=True)).mean(axis=0)


_TERM_OF = {word: term for term in TERMS for word in (term, *_SYNONYMS[term].split())}


@functools.cache
def _shades_lab() -> tuple[Float64, ...]:
    return tuple(_lab(np.array([list(bytes.fromhex(code)) for code in _SHADES[term]], np.uint8)) for term in TERMS)


def _lab(pixels: UInt8) -> Float64:
    import cv2

    return cv2.cvtColor(pixels[None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0].astype(np.float64)


def nearest_shade(lab: Float64, shades: Float64) -> Float64:
    """[n] the squared distance of each pixel [n, 3] to the nearest of shades [m, 3].

    Shade by shade, one row a channel: sums over rows of three numbers take six times as long.
    """
    light, red, yellow = np.ascontiguousarray(lab.T)
    nearest = np.full(len(lab), np.inf)
    for shade in shades:
        distance = (light - shade[0]) ** 2
        distance += (red - shade[1]) ** 2
        distance += (yellow - shade[2]) ** 2
        np.minimum(nearest, distance, out=nearest)
    return nearest
