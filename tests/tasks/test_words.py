"""Words of the sentences that people are told."""

import pytest

from ss_flow.tasks.words import first_of, size_in_words


@pytest.mark.parametrize(
    ("size", "told"),
    [
        *((0, "0 B"), (999, "999 B"), (1000, "1 kB"), (2_340_000, "2.34 MB"), (12_345_678, "12.3 MB")),
        *((999_499, "999 kB"), (999_500, "1 MB"), (999_999_999_999, "1 TB"), (10**15, "1 PB")),
    ],
)
def test_a_size_is_told_in_three_digits_of_the_unit_that_fits(size, told):
    assert size_in_words(size) == told


def test_of_many_names_the_first_are_told_and_the_others_counted():
    assert first_of(["a", "b"]) == first_of(["a", "b"], 2) == "a, b"
    assert first_of([*"abcd"], 2) == "a, b and 2 more"
