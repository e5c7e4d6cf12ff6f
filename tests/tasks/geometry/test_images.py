"""Photos that are decoded once for many, and pixels under pixels of another size."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Frame
from ss_flow.tasks.geometry import images
from ss_flow.tasks.geometry.images import decode_rgb, encode_png, pixels_under, shared_rgb, shared_valid


def frame(seed: int) -> Frame:
    photo = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    return Frame(f"v{seed}", 8, 6, encode_png(photo), np.zeros(0, np.uint8), 8, 6)


@pytest.fixture
def decoded(monkeypatch):
    """The frames that were decoded, with room for three photos."""
    calls: list[str] = []

    def counted(one: Frame) -> np.ndarray:
        calls.append(one.name)
        return decode_rgb(one)

    monkeypatch.setattr(images, "decode_rgb", counted)
    monkeypatch.setattr(images, "_decoded", images._Decoded(3 * 6 * 8 * 3))
    return calls


def test_a_photo_is_decoded_once_and_nobody_may_write_on_it(decoded):
    one = frame(0)
    photo = shared_rgb(one)
    np.testing.assert_array_equal(photo, decode_rgb(one))
    assert shared_rgb(one) is photo and decoded == ["v0"]
    assert not photo.flags.writeable and decode_rgb(one).flags.writeable


def test_the_valid_pixels_are_decoded_once_too():
    keep = np.random.default_rng(0).random((6, 8)) < 0.5
    one = replace(frame(0), valid=encode_png(keep.astype(np.uint8) * 255))
    np.testing.assert_array_equal(shared_valid(one), keep)
    assert shared_valid(one) is shared_valid(one) and shared_valid(frame(0)).all()
    np.testing.assert_array_equal(shared_rgb(one), decode_rgb(one))


def test_what_was_asked_for_least_recently_is_forgotten_first(decoded):
    frames = [frame(seed) for seed in range(4)]
    for asked in (0, 1, 2, 0, 3, 0, 2, 1):
        shared_rgb(frames[asked])
    assert decoded == ["v0", "v1", "v2", "v3", "v1"]


def test_photos_larger_than_the_room_come_back_all_the_same(decoded, monkeypatch):
    monkeypatch.setattr(images, "_decoded", images._Decoded(10))
    one = frame(0)
    np.testing.assert_array_equal(shared_rgb(one), decode_rgb(one))
    np.testing.assert_array_equal(shared_rgb(one), decode_rgb(one))
    assert decoded == ["v0", "v0"]


def test_photos_that_come_and_go_are_never_taken_for_each_other(decoded):
    def right(seed: int) -> bool:
        one = frame(seed % 40)  # a new array each time, often where one lay that is gone
        return bool((shared_rgb(one) == decode_rgb(one)).all())

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(right, range(400)))


@given(st.integers(1, 5000), st.integers(1, 5000))
def test_the_pixel_under_a_centre_is_the_one_that_whole_numbers_give(count, size):
    assert pixels_under(count, size).tolist() == [(2 * k + 1) * size // (2 * count) for k in range(count)]
