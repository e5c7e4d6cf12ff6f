"""Clicked points: the file that holds them, and where they lie in the frames."""

from __future__ import annotations

import json
import re
import unicodedata
from pathlib import Path

import capture_folders as made
import cv2
import numpy as np
import pytest
from capture_folders import refs

from ss_flow.errors import InputError
from ss_flow.tasks.capture.hints import clicks
from ss_flow.tasks.capture.ingest import IngestParams, frames
from ss_flow.tasks.capture.lens import Lens, undistorted, undistortion_map
from ss_flow.tasks.capture.scene import open_scene

GOOD = {
    "10": {"red mug": [[3, 4], [5.5, 6]], "sofa": {"in": [[20, 10]], "out": [[1, 1], [2, 2]]}},
    "2": {"sofa": [[7, 8]]},
}


def read(root: Path, document, lenses=None, radial: float = 0.0, **changes):
    """The clicks of the photos below `root`, from a document written beside them."""
    (root / "hints.json").write_text(document if isinstance(document, str) else json.dumps(document))
    scene = open_scene(root)
    views = frames(names=scene.names, photos=refs(scene.photos), lenses=lenses, params=IngestParams(**changes))
    return clicks(views, made.cameras_of(views, radial), names=scene.names, hints=scene.hints, lenses=lenses)


def test_each_view_gets_its_own_points_and_objects_are_numbered_as_they_come(tmp_path):
    two, ten, eleven = read(made.photos(tmp_path), GOOD)
    assert open_scene(tmp_path).hints.objects == ("red mug", "sofa")
    assert (two.name, two.label.tolist(), two.points.tolist(), two.inside.tolist()) == ("2", [2], [[7, 8]], [1])
    assert ten.label.tolist() == [1, 1, 2, 2, 2] and ten.inside.tolist() == [1, 1, 1, 0, 0]
    assert ten.points.tolist() == [[3, 4], [5.5, 6], [20, 10], [1, 1], [2, 2]]
    assert eleven.points.shape == (0, 2) and len(eleven.label) == len(eleven.inside) == 0


def test_a_view_is_known_whichever_way_its_name_writes_an_accent(tmp_path):
    composed, apart = (unicodedata.normalize(form, "Küche") for form in ("NFC", "NFD"))
    for name in (composed, apart):
        folder = tmp_path / name.encode().hex()
        made.write(folder / f"{name}.jpg", np.zeros((24, 32, 3), np.uint8))
        for written in (composed, apart):
            (kitchen,) = read(folder, {written: {"sofa": [[3, 4]]}})
            assert (kitchen.name, kitchen.points.tolist()) == (name, [[3, 4]])


def test_points_follow_a_photo_that_is_scaled_down(tmp_path):
    assert read(made.photos(tmp_path), GOOD, max_side=16)[1].points[:2].tolist() == [[1.5, 2], [2.75, 3]]


@pytest.mark.parametrize(
    "lens",
    [
        Lens(320, 240, 300, 310, 161, 118, (0.3, -0.1, 0.002, 0.001)),
        Lens(320, 240, 300, 310, 161, 118, (0.2, 0.1, 0.0, 0.0), fisheye=True),
    ],
    ids=["lens", "fisheye"],
)
def test_undistorting_a_point_undoes_what_the_map_of_an_image_does(lens):
    pixels = np.array([[20, 30], [160, 120], [250, 200]])
    in_photo = undistortion_map(lens)[pixels[:, 1], pixels[:, 0]].astype(np.float64) + 0.5
    np.testing.assert_allclose(undistorted(in_photo, lens), pixels + 0.5, atol=1e-3)


def test_a_click_stays_on_what_was_clicked_when_distortion_is_taken_out(tmp_path):
    """A dot is painted at the clicked place; in the frame the click lies on the dot."""
    image = np.zeros((101, 101, 3), np.uint8)
    image[19:22, 79:82] = 255
    made.write(tmp_path / "a.png", image)
    lens = Lens(101, 101, 100, 100, 50.5, 50.5, (0.5, 0.0, 0.0, 0.0))
    found = read(tmp_path, {"a": {"dot": [[80.5, 20.5]]}}, lenses=(lens,))[0]
    frame = frames(names=("a",), photos=refs([tmp_path / "a.png"]), lenses=(lens,))[0]
    bright = np.argwhere(cv2.imdecode(frame.encoded, cv2.IMREAD_GRAYSCALE) > 128)[:, ::-1] + 0.5
    assert found.points[0] == pytest.approx(bright.mean(axis=0), abs=0.5)
    assert np.abs(found.points[0] - (80.5, 20.5)).min() > 2
    by_motion = read(tmp_path, {"a": {"dot": [[80.5, 20.5]]}}, radial=0.5)[0]
    assert by_motion.points[0] == pytest.approx(found.points[0], abs=0.2)


def test_another_click_in_one_view_leaves_the_others_as_they_are(tmp_path):
    before = read(made.photos(tmp_path), GOOD)
    after = read(tmp_path, {**GOOD, "11": {"lamp": [[1, 1]]}})
    assert all(np.array_equal(vars(a)[k], vars(b)[k]) for a, b in zip(before[:2], after, strict=False) for k in vars(a))
    assert after[2].label.tolist() == [3]


def hint(value) -> dict:
    return {"2": {"mug": value}}


BAD = {
    "no JSON": ("{", "is not valid JSON"),
    "a view that stands twice": ('{"2": {"a": [[1, 1]]}, "2": {"b": [[2, 2]]}}', "'2' stands twice in one object"),
    "a list": ([], r"holds no hints; an object of the form \{view: \{object:"),
    "points without an object": ({"2": [[3, 4]]}, "holds no hints; an object of the form"),
    "no views": ({}, "holds no hints; at least one point"),
    "a view without objects": ({"2": {}}, "holds no hints; at least one point"),
    "a view by its file": (
        {"2.jpg": {"mug": [[3, 4]]}},
        "hints for '2.jpg', which is no view of the scene; '2' is one",
    ),
    "an object without a name": ({"2": {" ": [[3, 4]]}}, "names no object"),
    "an object without points": (hint([]), "the hint for 'mug' in view '2' of .* has no points"),
    "points outside only": (hint({"out": [[3, 4]]}), "has no points; .* under `in`"),
    "a key nobody knows": (hint({"in": [[3, 4]], "box": [1, 2, 3, 4]}), "has no points"),
    "a word for points": (hint("left"), "has no points"),
    "one point without its list": (hint([3, 4]), r"are not of the form \[x, y\]"),
    "a point of three numbers": (hint([[3, 4, 5]]), r"are not of the form \[x, y\]"),
    "a point of words": (hint([["3", "4"]]), r"are not of the form \[x, y\]"),
    "a point with NaN": (hint([[float("nan"), 4]]), r"are not of the form \[x, y\]"),
    "points outside that are none": (hint({"in": [[3, 4]], "out": 7}), r"are not of the form \[x, y\]"),
    "a point beyond the photo": (
        hint([[3, 4], [32, 4]]),
        r"the point \(32, 4\) for 'mug' in view '2', which lies outside of the photo; it has 32x24 pixels",
    ),
    "a point outside the object and the photo": (
        hint({"in": [[3, 4]], "out": [[3, -1]]}),
        r"the point \(3, -1\) for 'mug'",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_hints_are_refused_with_one_sentence_that_names_the_file(name, tmp_path):
    document, says = BAD[name]
    made.photos(tmp_path)
    with pytest.raises(InputError, match=says) as refused:
        read(tmp_path, document)
    message = str(refused.value)
    assert "hints.json" in message
    assert "\n" not in message and re.search(r"[.?]$", message)


def test_a_point_that_only_the_distorted_photo_shows_is_refused(tmp_path):
    lens = Lens(made.WIDTH, made.HEIGHT, 30, 30, 16, 12, (-0.3, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="outside of the photo once its lens's distortion is taken out"):
        read(made.photos(tmp_path), hint([[0.5, 0.5]]), lenses=(lens,) * 3)


def test_hints_for_a_view_that_is_left_out_are_warned_of(tmp_path):
    made.photos(tmp_path)
    (tmp_path / "hints.json").write_text(json.dumps({"2": {"mug": [[3, 4]]}, "10": {"mug": [[3, 4]]}}))
    scene = open_scene(tmp_path).every(2)
    views = frames(names=scene.names, photos=refs(scene.photos))
    with pytest.warns(UserWarning, match=r"hints.json in views that are left out do not count: 10\."):
        clicks(views, made.cameras_of(views), names=scene.names, hints=scene.hints)


def test_hints_for_views_that_are_all_left_out_are_refused(tmp_path):
    made.photos(tmp_path)
    (tmp_path / "hints.json").write_text(json.dumps({"10": {"mug": [[3, 4]]}}))
    scene = open_scene(tmp_path).every(2)
    views = frames(names=scene.names, photos=refs(scene.photos))
    with pytest.raises(InputError, match="has hints for none of the 2 views that are used"):
        clicks(views, made.cameras_of(views), names=scene.names, hints=scene.hints)


def test_hints_that_are_named_go_before_masks_in_the_scene_but_not_with_others_that_are_named(tmp_path):
    made.photos(tmp_path)
    for name in made.NAMES:
        made.write(tmp_path / "instance_masks" / f"{name}.png", np.zeros((made.HEIGHT, made.WIDTH), np.uint16))
    (tmp_path / "clicked.json").write_text(json.dumps(GOOD))
    scene = open_scene(tmp_path, hints=tmp_path / "clicked.json")
    assert scene.hints and not scene.has_masks
    with pytest.raises(InputError, match=r"instance_masks and .*clicked\.json cannot be used together"):
        open_scene(tmp_path, masks=tmp_path / "instance_masks", hints=tmp_path / "clicked.json")
    with pytest.raises(InputError, match=r"nowhere\.json is missing"):
        open_scene(tmp_path, hints=tmp_path / "nowhere.json")
