"""Pictures and films of a finished run."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from tiny_runs import bytes_of, ss_flow


def render(tiny, *more):
    return ss_flow("render", tiny.out, "--cache", tiny.store, *more)


def test_the_input_views_come_out_as_pictures_with_their_cameras(tiny, tmp_path):
    answer = render(tiny, "--frames", "0", "--out", tmp_path / "a", "--json")
    assert answer.code == 0, answer.err
    photos = sorted((tiny.scene / "color").iterdir())
    assert answer.document()["frames"] == len(photos)
    similar = [
        np.corrcoef(cv2.imread(str(a)).ravel(), cv2.imread(str(b)).ravel())[0, 1]
        for a, b in zip(photos, sorted((tmp_path / "a").glob("*.png")), strict=True)
    ]
    assert min(similar) > 0.8
    cameras = json.loads((tmp_path / "a" / "transforms.json").read_text())
    assert [frame["w"] for frame in cameras["frames"]] == [96] * len(photos)


def test_the_cameras_of_pictures_can_be_given_and_show_the_same(tiny, tmp_path):
    one = str(json.loads((tiny.out / "instances.json").read_text())["instances"][0]["id"])
    orbit = ["--path", "orbit", "--instance", one, "--frames", "3", "--width", "64"]
    assert render(tiny, *orbit, "--out", tmp_path / "a").code == 0
    again = ["--path", tmp_path / "a/transforms.json", "--instance", one]
    assert render(tiny, *again, "--out", tmp_path / "b").code == 0
    assert bytes_of(tmp_path / "a").keys() == bytes_of(tmp_path / "b").keys()
    for name in ("00000.png", "00002.png"):
        a, b = (cv2.imread(str(tmp_path / folder / name)).astype(int) for folder in "ab")
        assert np.abs(a - b).max() <= 1


def test_depth_pictures_tell_their_unit(tiny, tmp_path):
    assert render(tiny, "--frames", "2", "--what", "depth", "--out", tmp_path / "a").code == 0
    unit = json.loads((tmp_path / "a/transforms.json").read_text())["depth_unit_scale_factor"]
    ours = cv2.imread(str(tmp_path / "a/00000.png"), cv2.IMREAD_UNCHANGED) * unit
    truth = cv2.imread(str(sorted((tiny.scene / "depth").iterdir())[0]), cv2.IMREAD_UNCHANGED) / 1000
    assert abs(np.median(ours[ours > 0]) / np.median(truth[truth > 0]) - 1) < 0.2


def test_surroundings_show_more_than_the_instance(tiny, tmp_path):
    one = str(json.loads((tiny.out / "instances.json").read_text())["instances"][0]["id"])
    asked = ["--path", "orbit", "--instance", one, "--frames", "1", "--what", "alpha", "--width", "64"]
    render(tiny, *asked, "--out", tmp_path / "alone")
    render(tiny, *asked, "--surroundings", "--out", tmp_path / "whole")
    alone, whole = (cv2.imread(str(tmp_path / name / "00000.png"), 0).mean() for name in ("alone", "whole"))
    assert 0 < alone < whole


def test_a_film_is_one_file_and_is_made_once(tiny, tmp_path):
    asked = ["--path", "orbit", "--frames", "3", "--what", "labels", "--out", tmp_path / "a.mp4"]
    assert render(tiny, *asked).code == 0
    first = (tmp_path / "a.mp4").read_bytes()
    again = render(tiny, *asked)
    assert again.code == 0 and "done" not in again.out + again.err
    assert (tmp_path / "a.mp4").read_bytes() == first and b"ftyp" in first[:16]


def test_an_edit_is_shown_beside_what_it_was_before(tiny, tmp_path):
    one = next(e["id"] for e in json.loads((tiny.out / "instances.json").read_text())["instances"] if e["file"])
    (tmp_path / "script.json").write_text(
        json.dumps({"version": 1, "operations": [{"op": "remove", "instances": one}]})
    )
    edited = ss_flow("edit", tiny.out, tmp_path / "script.json", "--out", tmp_path / "edited", "--cache", tiny.store)
    assert edited.code == 0, edited.err
    views = ["--frames", "0", "--what", "labels"]

    def pictures(folder, result, *more):
        assert ss_flow("render", result, "--cache", tiny.store, *views, *more, "--out", tmp_path / folder).code == 0
        found = sorted((tmp_path / folder).glob("*.png"))
        return [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in found]

    both = pictures("both", tmp_path / "edited", "--before")
    left, right = pictures("left", tiny.out), pictures("right", tmp_path / "edited")
    for pair, before, after in zip(both, left, right, strict=True):
        np.testing.assert_array_equal(pair, np.concatenate([before, after], axis=1))
    assert any((image == one).any() for image in left) and not any((image == one).any() for image in right)
    # Cameras are those of one half.
    cameras = [json.loads((tmp_path / folder / "transforms.json").read_text()) for folder in ("both", "left")]
    assert cameras[0] == cameras[1]
    film = ["--frames", "2", "--before", "--out", tmp_path / "a.mp4"]
    assert ss_flow("render", tmp_path / "edited", "--cache", tiny.store, *film).code == 0


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--before"], "is not an edited run"),
        (["--path", "nowhere.json"], "is neither input nor orbit"),
        (["--path", "orbit", "--frames", "0"], "--frames 0 is out of range"),
        (["--fps", "0"], "--fps 0 is out of range"),
        (["--width", "3"], "--width 3 is out of range"),
        (["--instance", "no such"], "is no instance of"),
    ],
)
def test_bad_usage_gets_one_sentence(tiny, tmp_path, more, said):
    answer = render(tiny, *more, "--out", tmp_path / "a")
    assert answer.code == 2 and said in answer.err
    assert not list(tmp_path.iterdir())


def test_a_damaged_file_of_cameras_is_said_to_be_damaged(tiny, tmp_path):
    (tmp_path / "transforms.json").write_text('{"frames": [{"file_path": "a.png", "w": 9, "h": 9, "fl_x": 9}]}')
    answer = render(tiny, "--path", tmp_path / "transforms.json", "--out", tmp_path / "a")
    assert answer.code == 2 and "has no transform_matrix" in answer.err


def test_a_folder_of_something_else_stays_as_it_is(tiny, tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"x")
    answer = render(tiny, "--frames", "1", "--out", tmp_path)
    assert answer.code == 2 and "holds something else than earlier pictures" in answer.err


def test_a_capture_that_has_a_file_of_cameras_too_stays_as_it_is(tiny, tmp_path):
    capture, pictures = tmp_path / "capture", tmp_path / "pictures"
    assert ss_flow("export", tiny.out, "--cache", tiny.store, "--format", "nerfstudio", "--out", capture).code == 0
    (capture / "export.json").unlink()
    before = bytes_of(capture)
    answer = render(tiny, "--frames", "1", "--out", capture)
    assert answer.code == 2 and "it has no render.json; name another folder with --out, or move this" in answer.err
    assert bytes_of(capture) == before
    for frames in ("2", "1"):
        assert render(tiny, "--frames", frames, "--out", pictures).code == 0
    assert sorted(bytes_of(pictures)) == ["00000.png", "render.json", "transforms.json"]
