"""CLIP's tokenizer: byte-level byte-pair encoding of lower-cased text ("Learning Transferable Visual Models From
Natural Language Supervision", Sec. 2.4; byte pairs: Sennrich et al., "Neural Machine Translation of Rare Words with
Subword Units").

A text is cut into words, numerals and runs of signs; the UTF-8 bytes of each piece are written as printable
characters, the last one marked as the end of a word; then the neighbouring pair that was learnt first is joined, over
and over, until no learnt pair is left.
"""

from __future__ import annotations

import functools
import html
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ss_flow.cache.plain_json import read_json
from ss_flow.errors import InputError

CONTEXT_LENGTH = 77
"""Tokens that CLIP's text model takes, the start and end tokens among them."""

_START, _END = "<|startoftext|>", "<|endoftext|>"
_END_OF_WORD = "</w>"
_PIECES = r"<\|startoftext\|>|<\|endoftext\|>|'(?:s|t|re|ve|m|ll|d)|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+"


@functools.cache
def byte_characters() -> tuple[str, ...]:
    """The printable character that stands for each of the 256 bytes.

    A byte that Latin-1 prints stands for itself; the others, in order, take the characters from U+0100 on.
    """
    printable = {*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)}
    spare = iter(range(256, 512))
    return tuple(chr(byte) if byte in printable else chr(next(spare)) for byte in range(256))


class ClipTokenizer:
    """Texts to token ids.

    vocabulary: token -> id. merges: the pairs in the order in which they were learnt.
    """

    def __init__(self, vocabulary: Mapping[str, int], merges: Sequence[tuple[str, str]]) -> None:
        import regex

        missing = {_START, _END} - vocabulary.keys()
        if missing:
            raise InputError(
                f"The tokenizer's vocabulary lacks {', '.join(sorted(missing))}; it must be that of a CLIP text model."
            )
        self._vocabulary = vocabulary
        self._rank = {pair: rank for rank, pair in enumerate(merges)}
        self._pieces = regex.compile(_PIECES, regex.IGNORECASE)

    @classmethod
    def from_files(cls, *files: Path) -> ClipTokenizer:
        """Read `tokenizer.json`, or `vocab.json` and `merges.txt`, in any order.

        Raises InputError when the files are not those of a byte-pair tokenizer.
        """
        vocabulary = lines = None
        for file in files:
            try:
                text = file.read_text(encoding="utf-8")
                document = read_json(text) if text.lstrip().startswith("{") else None
            except ValueError as error:
                raise InputError(
                    f"{file.name} is not valid JSON or UTF-8 ({error}); fetch the model's files again."
                ) from error
            if document is None:
                lines = text.splitlines()
            elif isinstance(model := document.get("model"), dict):  # "model" may also be a token of vocab.json
                vocabulary, lines = model.get("vocab"), model.get("merges")
            else:
                vocabulary = document
        merges = _merges_of(lines) if isinstance(lines, list) else []
        if not isinstance(vocabulary, dict) or not merges:
            names = ", ".join(file.name for file in files) or "no file"
            raise InputError(f"{names}: a tokenizer needs tokenizer.json, or vocab.json together with merges.txt.")
        return cls(vocabulary, merges)

    def tokens(self, text: str) -> list[int]:
        """The ids of one text, without start and end."""
        cleaned = " ".join(html.unescape(html.unescape(text)).split()).lower()
        ids = []
        for piece in self._pieces.findall(cleaned):
            if piece in (_START, _END):
                ids.append(self._vocabulary[piece])
                continue
            symbols = [byte_characters()[byte] for byte in piece.encode("utf-8", errors="replace")]
            symbols[-1] += _END_OF_WORD
            ids += [self._vocabulary.get(symbol, self._vocabulary[_END]) for symbol in self._join(symbols)]
        return ids

    def __call__(self, texts: Sequence[str]) -> NDArray[np.int64]:
        """Token ids of texts: [n, 77]; what is too long is cut, what is short is filled with the end token.

        (CLIP's text models read their result at the first end token, so the filling does not matter.)
        """
        ids = np.full((len(texts), CONTEXT_LENGTH), self._vocabulary[_END], np.int64)
        for row, text in zip(ids, texts, strict=True):
            tokens = [self._vocabulary[_START], *self.tokens(text)[: CONTEXT_LENGTH - 2]]
            row[: len(tokens)] = tokens
        return ids

    def _join(self, symbols: list[str]) -> list[str]:
        while len(symbols) > 1:
            rank, pair = min((self._rank.get(pair, len(self._rank)), pair) for pair in itertools.pairwise(symbols))
            if rank == len(self._rank):
                break
            joined: list[str] = []
            position = 0
            while position < len(symbols):
                if tuple(symbols[position : position + 2]) == pair:
                    joined.append(pair[0] + pair[1])
                    position += 2
                else:
                    joined.append(symbols[position])
                    position += 1
            symbols = joined
        return symbols


def _merges_of(lines: Sequence[str | Sequence[str]]) -> list[tuple[str, str]]:
    pairs = (line.split() if isinstance(line, str) else line for line in lines if line and line[:9] != "#version:")
    return [(pair[0], pair[1]) for pair in pairs if len(pair) == 2]
