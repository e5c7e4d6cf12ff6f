import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.errors import InputError
from ss_flow.tasks.models.tokenizer import CONTEXT_LENGTH, ClipTokenizer, byte_characters

MERGES = [("c", "a"), ("ca", "t</w>"), ("t", "h"), ("th", "e</w>"), ("a", "t</w>")]
START, END = "<|startoftext|>", "<|endoftext|>"


def small_vocabulary() -> dict[str, int]:
    alphabet = [*byte_characters(), *(c + "</w>" for c in byte_characters())]
    tokens = [*alphabet, *("".join(pair) for pair in MERGES), START, END]
    return {token: i for i, token in enumerate(tokens)}


VOCABULARY = small_vocabulary()
TOKENIZER = ClipTokenizer(VOCABULARY, MERGES)


def tokens_of(text: str) -> list[str]:
    names = {i: token for token, i in VOCABULARY.items()}
    return [names[i] for i in TOKENIZER.tokens(text)]


def test_each_byte_has_its_own_printable_character():
    characters = byte_characters()
    assert len(set(characters)) == 256
    assert all(c.isprintable() and not c.isspace() for c in characters)
    assert characters[ord("a")] == "a" and characters[ord("~")] == "~"


def test_bytes_that_do_not_print_take_the_characters_from_u0100_in_order():
    characters = byte_characters()
    assert characters[0] == "Ā" and characters[ord(" ")] == "Ġ" and characters[ord("\n")] == "Ċ"
    assert characters[0xAD] == chr(256 + 67)


@pytest.mark.parametrize(
    "text, expected",
    [
        ("cat", ["cat</w>"]),
        ("The CAT", ["the</w>", "cat</w>"]),
        ("at", ["at</w>"]),
        ("cats", ["ca", "t", "s</w>"]),
        ("the  \n cat ", ["the</w>", "cat</w>"]),
        ("cat's", ["cat</w>", "'", "s</w>"]),
        ("12", ["1</w>", "2</w>"]),
        ("cat, the!?", ["cat</w>", ",</w>", "the</w>", "!", "?</w>"]),
        ("&amp;amp;", ["&</w>"]),
        ("é", ["Ã", "©</w>"]),
        ("", []),
    ],
)
def test_text_is_cut_and_joined_as_worked_out_by_hand(text, expected):
    assert tokens_of(text) == expected


PUBLISHED = {
    19: "t o</w>",
    24: "a t</w>",
    27: "o f</w>",
    47: "r a",
    58: "d i",
    90: "a g",
    94: "h o",
    127: "d o",
    304: "p ho",
    613: "pho to</w>",
    1417: "do g</w>",
    1495: "ra m</w>",
    1856: "c at</w>",
    1935: "ag ram</w>",
    22185: "di agram</w>",
}
"""Those of CLIP's 48,894 merges that the texts below need, by their rank."""


@pytest.mark.parametrize(
    "text, expected",
    [("a photo of a cat", [320, 1125, 539, 320, 2368]), ("a diagram", [320, 22697]), ("A dog", [320, 1929])],
)
def test_texts_have_the_ids_that_are_published_for_clip(text, expected):
    """CLIP numbers first the 256 bytes, those that print before the others, then these at the end of a word, then the
    merges in their order, then start and end."""
    characters = byte_characters()
    alphabet = sorted(characters, key=lambda c: (characters.index(c) != ord(c), characters.index(c)))
    vocabulary = {token: i for i, token in enumerate([*alphabet, *(c + "</w>" for c in alphabet)])}
    vocabulary |= {pair.replace(" ", ""): 512 + rank for rank, pair in PUBLISHED.items()}
    vocabulary |= {START: 49406, END: 49407}
    tokenizer = ClipTokenizer(vocabulary, [tuple(pair.split()) for pair in PUBLISHED.values()])
    assert tokenizer.tokens(text) == expected
    assert tokenizer([text])[0, : len(expected) + 2].tolist() == [49406, *expected, 49407]


def test_of_two_learnt_pairs_the_one_learnt_first_is_joined():
    vocabulary = {**VOCABULARY, "ab": 900, "bc</w>": 901}
    assert ClipTokenizer(vocabulary, [("a", "b"), ("b", "c</w>")]).tokens("abc") == [900, VOCABULARY["c</w>"]]
    assert ClipTokenizer(vocabulary, [("b", "c</w>"), ("a", "b")]).tokens("abc") == [VOCABULARY["a"], 901]


def test_rows_start_end_and_are_filled_to_the_context_length():
    ids = TOKENIZER(["the cat", ""])
    assert ids.shape == (2, CONTEXT_LENGTH) and ids.dtype == np.int64
    assert ids[0, :4].tolist() == [VOCABULARY[t] for t in (START, "the</w>", "cat</w>", END)]
    assert (ids[0, 4:] == VOCABULARY[END]).all()
    assert ids[1, 0] == VOCABULARY[START] and (ids[1, 1:] == VOCABULARY[END]).all()


def test_a_text_that_is_too_long_is_cut_and_still_ends():
    ids = TOKENIZER(["cat " * 200])[0]
    assert (ids[1:-1] == VOCABULARY["cat</w>"]).all() and ids[-1] == VOCABULARY[END]


@given(st.text(alphabet=st.characters(exclude_characters="<&", exclude_categories=["Cs"]), max_size=40))
def test_the_bytes_of_the_text_survive_but_for_case_and_space(text):
    spelled = "".join(token.removesuffix("</w>") for token in tokens_of(text))
    value = {c: i for i, c in enumerate(byte_characters())}
    assert bytes(value[c] for c in spelled).decode() == "".join(text.lower().split())


def test_both_forms_of_the_files_give_the_same_tokens(tmp_path: Path):
    (tmp_path / "vocab.json").write_text(json.dumps(VOCABULARY))
    lines = ["#version: 0.2", *(" ".join(pair) for pair in MERGES), ""]
    (tmp_path / "merges.txt").write_text("\n".join(lines), encoding="utf-8")
    whole = {"version": "1.0", "model": {"type": "BPE", "vocab": VOCABULARY, "merges": [" ".join(m) for m in MERGES]}}
    (tmp_path / "tokenizer.json").write_text(json.dumps(whole))
    newer = {"model": {"vocab": VOCABULARY, "merges": MERGES}}
    (tmp_path / "newer.json").write_text(json.dumps(newer))
    text = "The cats' cat, 3 at!"
    for files in (["vocab.json", "merges.txt"], ["merges.txt", "vocab.json"], ["tokenizer.json"], ["newer.json"]):
        read = ClipTokenizer.from_files(*(tmp_path / file for file in files))
        assert read.tokens(text) == TOKENIZER.tokens(text)


def test_a_vocabulary_without_its_merges_is_refused(tmp_path: Path):
    (tmp_path / "vocab.json").write_text(json.dumps(VOCABULARY))
    with pytest.raises(InputError, match=r"vocab\.json.*merges\.txt"):
        ClipTokenizer.from_files(tmp_path / "vocab.json")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b'{"model": {', r"tokenizer\.json is not valid JSON"),
        (b'{"model":' * 100_000, r"tokenizer\.json is not valid JSON"),
        (b"\xff\xfe\x00", r"tokenizer\.json is not valid JSON or UTF-8"),
        (b'{"model": null}', r"tokenizer\.json: a tokenizer needs"),
        (b'{"model": {"vocab": [["a", 0.5]], "merges": ["a b"]}}', r"tokenizer\.json: a tokenizer needs"),
        (b'{"model": {"vocab": {"a": 0}, "merges": null}}', r"tokenizer\.json: a tokenizer needs"),
        (b"", r"tokenizer\.json: a tokenizer needs"),
    ],
)
def test_a_damaged_file_is_refused_by_name(content: bytes, says: str, tmp_path: Path):
    (tmp_path / "tokenizer.json").write_bytes(content)
    with pytest.raises(InputError, match=says):
        ClipTokenizer.from_files(tmp_path / "tokenizer.json")


def test_a_vocabulary_may_have_the_token_model(tmp_path: Path):
    (tmp_path / "vocab.json").write_text(json.dumps(VOCABULARY | {"model": 900}))
    (tmp_path / "merges.txt").write_text("\n".join(" ".join(pair) for pair in MERGES), encoding="utf-8")
    read = ClipTokenizer.from_files(tmp_path / "vocab.json", tmp_path / "merges.txt")
    assert read.tokens("the cat") == TOKENIZER.tokens("the cat")


def test_a_vocabulary_of_another_model_is_refused():
    with pytest.raises(InputError, match="startoftext"):
        ClipTokenizer({"a": 0}, MERGES)
