from math import inf, nextafter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.ranges import Range


@pytest.mark.parametrize(
    ("limit", "inside", "outside", "words"),
    [
        (Range(0, 1), [0, 0.5, 1], [nextafter(0, -1), nextafter(1, 2)], "between 0 and 1"),
        (Range(0, inf), [0, 1e300], [-1], "at least 0"),
        (Range(0, inf, open_below=True), [5e-324], [0, -1], "greater than 0"),
        (Range(0, 180, open_below=True), [1, 180], [0, 181], "greater than 0 and at most 180"),
        (Range(0, 0.5, open_above=True), [0, 0.49], [0.5], "at least 0 and less than 0.5"),
        (Range(0, 1, open_below=True, open_above=True), [0.5], [0, 1], "greater than 0 and less than 1"),
    ],
)
def test_a_range_holds_what_its_words_say(limit, inside, outside, words):
    assert all(value in limit for value in inside)
    assert not any(value in limit for value in outside)
    assert str(limit) == words


@given(st.booleans(), st.booleans())
def test_no_range_holds_what_is_not_a_number(open_below, open_above):
    assert float("nan") not in Range(0, 1, open_below, open_above)
