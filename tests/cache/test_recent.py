"""Values in memory."""

from __future__ import annotations

import numpy as np
import psutil
from ss_flow_toy import Table

from ss_flow.cache.recent import Recent
from ss_flow.cache.store import MEMORY_BYTES, Store
from ss_flow.tasks.artifacts import LabelMap

SIZE = 5259


def value(number: int, side: int = 50) -> LabelMap:
    """5,000 bytes of labels, 3 of its name in quotes, and 256 that every value counts besides."""
    return LabelMap(str(number), np.full((side, side), number, np.uint16))


def test_what_was_asked_for_longest_ago_goes_first():
    recent = Recent(5 * SIZE)
    values = [value(i) for i in range(6)]
    for i in range(5):
        recent.keep(str(i), values[i])
    assert recent.get("0") is values[0]
    recent.keep("5", values[5])
    assert [number for number in range(6) if recent.get(str(number)) is values[number]] == [0, 2, 3, 4, 5]
    assert recent.get("1") is None and recent.bytes == 5 * SIZE


def test_a_value_that_would_drive_out_most_others_is_not_kept():
    recent = Recent(40_000)
    recent.keep("small", value(1))
    recent.keep("large", value(2, side=80))
    assert recent.get("large") is None and recent.get("small") is not None and recent.bytes == SIZE


def test_plain_data_counts_too():
    recent = Recent(40_000)
    recent.keep("rows", Table({"n": list(range(10_000))}, []))
    recent.keep("few", Table({"n": list(range(100))}, []))
    assert recent.get("rows") is None and recent.get("few") is not None and 100 < recent.bytes < 2_000


def test_what_is_dropped_counts_no_longer():
    recent = Recent(40_000)
    recent.keep("a", value(1))
    recent.drop("a")
    recent.drop("b")
    assert recent.get("a") is None and recent.bytes == 0


def test_a_process_keeps_no_more_than_a_sixteenth_of_the_machines_memory():
    assert 0 < MEMORY_BYTES <= psutil.virtual_memory().total / 16


def test_a_store_gives_the_same_value_again_while_there_is_room_for_it(tmp_path):
    store = Store(tmp_path, memory_bytes=4 * (SIZE + 1))
    digests = [store.put(value(i)) for i in range(20)]
    first = [store.get(digest) for digest in digests]
    assert [store.get(digest) is known for digest, known in zip(digests[-4:], first[-4:], strict=True)] == [True] * 4
    assert store.get(digests[0]) is not first[0]
