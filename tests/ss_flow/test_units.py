"""Sizes and durations as people write them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.units import parse_bytes, parse_seconds


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("500", 500),
        ("7b", 7),
        ("500MB", 500_000_000),
        ("8GB", 8_000_000_000),
        ("8 g", 8_000_000_000),
        ("1.5 GiB", 1_610_612_736),
        (" 2TiB ", 2 << 40),
        (".5k", 500),
        ("0", 0),
    ],
)
def test_a_size_is_a_number_and_a_unit(text, size):
    assert parse_bytes(text) == size


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("45", 45), ("90s", 90), ("10 min", 600), ("1.5h", 5400), ("30d", 2_592_000), ("2 Weeks", 1_209_600), ("0", 0)],
)
def test_a_duration_is_a_number_and_a_unit(text, seconds):
    assert parse_seconds(text) == seconds


@pytest.mark.parametrize("text", ["", "GB", "-1GB", "8 XB", "1e9", "inf", "nan", "8GB!", "1,5GB", "8 G B", "٣GB"])
def test_what_is_no_size_is_told_in_one_sentence_with_an_example(text):
    with pytest.raises(ValueError, match=r"is not a size; write .* such as 500MB, 8GB or 1\.5TiB\.$"):
        parse_bytes(text)


@pytest.mark.parametrize("text", ["", "d", "-1d", "3 fortnights", "1:30", "1h30m", "9" * 400])
def test_what_is_no_duration_is_told_in_one_sentence_with_an_example(text):
    with pytest.raises(ValueError, match=r"is not a duration; write .* such as 90s, 10min, 12h, 30d or 2w\.$"):
        parse_seconds(text)


@given(st.integers(0, 10**6), st.sampled_from("kmgt"))
def test_binary_units_are_larger_than_decimal_ones_and_case_counts_for_nothing(number, letter):
    decimal, binary = parse_bytes(f"{number}{letter}B"), parse_bytes(f"{number}{letter}iB")
    assert decimal <= binary <= 1.1 * decimal
    assert parse_bytes(f"{number}{letter.upper()}b") == decimal
