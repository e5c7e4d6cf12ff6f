"""Frames out of a video: which are taken, and what spoilt ones say."""

import struct
import warnings

import capture_folders as made
import cv2
import numpy as np
import pytest
from capture_folders import ref

from ss_flow.tasks.capture.video import VideoParams, video_frames
from ss_flow.tasks.geometry.images import decode_rgb

WALL = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (96, 1000, 3)).astype(np.uint8), (0, 0), 1.5)
DIAGONAL = np.hypot(128, 96)


def along_a_wall(path, places):
    """A video of a camera that stands before a wall at these places, in pixels."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (128, 96))
    for x in places:
        writer.write(np.ascontiguousarray(WALL[:, int(x) : int(x) + 128]))
    writer.release()
    return ref(path)


def taken(video, **params):
    return [int(f.name.removeprefix("frame-")) for f in video_frames(video=video, params=VideoParams(**params))]


def test_a_frame_is_taken_whenever_the_picture_has_moved_on(tmp_path):
    still, moving = np.zeros(50), 2.0 * np.arange(150)
    video = along_a_wall(tmp_path / "a.avi", np.concatenate([still, moving]))
    frames = taken(video, motion=4 / DIAGONAL)
    assert sum(frame > 50 for frame in frames) == pytest.approx(2 * 150 / 4, abs=3)
    assert sum(frame < 50 for frame in frames) <= 1
    assert np.diff([frame for frame in frames if frame > 55]).max() <= 3  # two on the way, and the sharpest around
    every_second = video_frames(video=video, params=VideoParams(motion=4 / DIAGONAL).every(2))
    assert len(every_second) == pytest.approx(len(frames) / 2, abs=1)


def test_a_still_video_gives_frames_by_its_length(tmp_path):
    assert len(taken(along_a_wall(tmp_path / "a.avi", np.zeros(200)))) == 20
    assert len(taken(along_a_wall(tmp_path / "b.avi", np.zeros(7)))) == 7


def test_a_video_of_a_few_rows_is_read(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (320, 16))
    for i in range(30):
        writer.write(np.ascontiguousarray(WALL[:16, i : i + 320]))
    writer.release()
    assert 1 < len(taken(ref(tmp_path / "a.avi"))) <= 30


def test_a_video_that_moves_too_far_for_its_frames_is_followed_evenly_with_a_word(tmp_path):
    video = along_a_wall(tmp_path / "a.avi", np.linspace(0, 800, 200))
    with pytest.warns(
        UserWarning, match="frames would follow the video's motion, and 10 are taken .* may find no pose"
    ):
        frames = taken(video, motion=8 / DIAGONAL, max_frames=10)
    assert len(frames) == 10
    assert np.abs(np.diff(frames) - 20).max() <= 16


def test_the_sharpest_frame_of_each_stride_is_taken(tmp_path):
    frames = video_frames(
        video=ref(made.video(tmp_path / "a.avi")), params=VideoParams(max_frames=10, motion=0, candidates=4)
    )
    assert [f.name for f in frames] == [f"frame-{i:06d}" for i in range(1, 40, 4)]
    assert decode_rgb(frames[0]).shape == (48, 64, 3)


def test_blurred_frames_are_dropped_where_a_stride_has_no_sharp_one(tmp_path):
    video = ref(made.video(tmp_path / "a.avi"))
    everything = video_frames(video=video, params=VideoParams(stride=2, candidates=2, min_sharpness=0.0))
    with pytest.warns(
        UserWarning, match="10 views are left out, blurred or without detail beside the other frames: frame-"
    ):
        sharp = video_frames(video=video, params=VideoParams(stride=2, candidates=2))
    assert len(everything) == 20
    assert [f.name for f in sharp] == [f"frame-{i:06d}" for i in range(1, 40, 4)]


def test_video_frames_are_few_and_small_when_asked(tmp_path):
    frames = video_frames(video=ref(made.video(tmp_path / "a.avi")), params=VideoParams(max_frames=3, max_side=32))
    assert len(frames) == 3
    assert (frames[0].width, frames[0].height, frames[0].source_width) == (32, 24, 64)


@pytest.mark.parametrize(("turned", "size"), [(False, (128, 48)), (True, (24, 64))])
def test_pixels_of_a_video_that_are_not_square_are_made_so(tmp_path, turned, size):
    file = tmp_path / "a.mp4"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 48))
    for i in range(4):
        writer.write(made.photo(i, 64, 48))
    writer.release()
    data = bytearray(file.read_bytes())
    at = data.index(b"tkhd") + 44  # where it says how to turn what is stored, and then how wide to show it
    if turned:
        data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 48 << 16, 0, 1 << 30)
    assert data[at + 36 : at + 40] == struct.pack(">I", 64 << 16)
    data[at + 36 : at + 40] = struct.pack(">I", 128 << 16)
    file.write_bytes(data)
    frames = video_frames(video=ref(file), params=VideoParams(min_sharpness=0))
    assert {(f.width, f.height, f.source_width, f.source_height) for f in frames} == {2 * size}
    assert decode_rgb(frames[0]).shape[1::-1] == size


def test_a_stride_that_gives_too_many_frames_is_widened_over_the_whole_video_with_a_word(tmp_path):
    video = ref(made.video(tmp_path / "a.avi"))
    with pytest.warns(UserWarning, match="One frame out of 4 is taken instead of one out of 2, since no more than 10"):
        frames = video_frames(video=video, params=VideoParams(max_frames=10, stride=2, candidates=4))
    assert [f.name for f in frames] == [f"frame-{i:06d}" for i in range(1, 40, 4)]


def test_a_video_that_was_cut_is_read_as_far_as_it_goes_with_a_warning(tmp_path):
    video = made.video(tmp_path / "a.avi")
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    with pytest.warns(UserWarning, match=r"a\.avi announces 40 frames, but only (\d+) can be decoded; it may be cut"):
        frames = video_frames(video=ref(video), params=VideoParams(min_sharpness=0))
    assert 10 < len(frames) < 30


@pytest.mark.parametrize("announced", [0, 1, 44])
def test_a_video_that_announces_too_few_frames_or_some_too_many_is_taken_as_whole(tmp_path, announced):
    video = made.video(tmp_path / "a.avi")
    data = bytearray(video.read_bytes())
    for header, place in ((b"avih", 24), (b"strh", 40)):  # where the two count their frames, from their names on
        at = data.index(header) + place
        assert data[at : at + 4] == (40).to_bytes(4, "little")
        data[at : at + 4] = announced.to_bytes(4, "little")
    video.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(video_frames(video=ref(video), params=VideoParams(motion=0, min_sharpness=0))) == 40
