from __future__ import annotations

import enum
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.cache.canonical import digest, digest_file

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)


@given(plain)
def test_a_value_has_one_digest(value):
    assert digest(value) == digest(value)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (1, 1.0),
        (1, True),
        (0, None),
        ("1", 1),
        ("ab", ["a", "b"]),
        (["ab", "c"], ["a", "bc"]),
        ([[], []], [[[]]]),
        ({"a": 1}, [["a", 1]]),
        (b"x", "x"),
        (np.zeros(2), np.zeros((2, 1))),
        (np.zeros(2, np.float32), np.zeros(2, np.int32)),
        (0.0, -0.0),
        (np.array(5.0), np.array([5.0])),
        (np.array([complex(np.nan, 1)]), np.array([complex(np.nan, 2)])),
    ],
)
def test_values_that_differ_in_type_or_shape_differ_in_digest(a, b):
    assert digest(a) != digest(b)


def test_byte_order_memory_order_and_the_kind_of_nan_do_not_count():
    array = np.arange(6, dtype="<f4").reshape(2, 3)
    assert digest(array) == digest(array.astype(">f4")) == digest(np.asfortranarray(array))
    quiet, other = np.array([0x7FC00000, 0x7FC00001], np.uint32).view(np.float32)
    assert digest(np.array([quiet])) == digest(np.array([other]))
    assert digest(float("nan")) == digest(-float("nan"))


def test_the_order_of_a_mapping_does_not_count():
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})


class Level(int, enum.Enum):
    LOW = 1


def test_a_member_of_an_enumeration_counts_as_its_number():
    assert digest(Level.LOW) == digest(1)


@dataclass(frozen=True)
class Place:
    where: str = field(metadata={"key": False})
    what: str = ""


def test_a_field_declared_outside_the_key_does_not_count():
    assert digest(Place("here", "x")) == digest(Place("there", "x")) != digest(Place("here", "y"))


@pytest.mark.parametrize(
    "value",
    [
        *(object(), {1: 2}, Path("x"), {1, 2}, np.array([None])),
        np.ma.masked_array([1.0, 2.0], [0, 1]),
        np.zeros(2, [("x", "f4"), ("y", "i4")]),
    ],
    ids=["object", "number as key", "path", "set", "objects", "masked", "records"],
)
def test_an_unknown_type_is_refused(value):
    with pytest.raises(TypeError, match="cannot digest"):
        digest(value)


def test_a_file_counts_by_content(tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 3_000_000)
    (tmp_path / "b").write_bytes(b"x" * 3_000_000)
    (tmp_path / "c").write_bytes(b"x" * 2_999_999)
    assert digest_file(tmp_path / "a") == digest_file(tmp_path / "b") != digest_file(tmp_path / "c")
