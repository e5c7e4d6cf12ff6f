from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.cache.plain_json import as_json, reader

SCALARS = st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats(allow_nan=False, allow_infinity=False)
NAMES = st.text(st.characters(codec=None))  # lone surrogates too: names of files that are no text
DOCUMENTS = st.recursive(SCALARS | NAMES, lambda inner: st.lists(inner) | st.dictionaries(NAMES, inner))
read = reader(Any)


@given(DOCUMENTS)
def test_what_is_written_is_what_the_standard_library_reads(value: object):
    line = as_json(value)
    assert b"\n" not in line
    assert json.loads(line) == value
    assert read(line) == value


@given(DOCUMENTS)
def test_what_the_standard_library_writes_is_read(value: object):
    assert read(json.dumps(value).encode()) == value


def test_a_line_is_spaced_as_by_the_standard_library():
    value = {"event": "started", "inputs": {"a": ["b", 1], "c": {}}, "warnings": []}
    assert as_json(value) == json.dumps(value).encode()


def test_infinity_is_read():
    assert read(b'{"limit": Infinity, "least": -Infinity}') == {"limit": float("inf"), "least": float("-inf")}


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b'{"a": 1} more', b"\x00" * 100])
def test_what_is_no_document_is_a_value_error(content: bytes):
    with pytest.raises(ValueError):
        read(content)


@dataclass(frozen=True)
class Reading:
    name: str
    values: tuple[float, ...]
    note: str = ""


read_reading = reader(Reading)


def test_a_document_of_a_kind():
    reading = Reading("depth", (1.5, 2.0))
    assert read_reading(b'{"name": "depth", "values": [1.5, 2]}') == reading
    assert read_reading(json.dumps(vars(reading)).encode()) == reading
    assert read_reading(b'{"name": "depth", "values": [Infinity]}').values == (float("inf"),)


@pytest.mark.parametrize(
    "content", [b'{"name": "depth"}', b'{"name": 1, "values": []}', b"[]", b'{"name": 1, "values": [NaN]}']
)
def test_a_document_of_another_kind_is_a_value_error(content: bytes):
    with pytest.raises(ValueError):
        read_reading(content)
