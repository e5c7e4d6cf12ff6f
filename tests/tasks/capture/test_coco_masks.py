"""Ready-made masks from a COCO file."""

from __future__ import annotations

import json
import re
import unicodedata
from pathlib import Path

import capture_folders as made
import cv2
import numpy as np
import pytest
from capture_folders import ref, refs
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.errors import InputError
from ss_flow.tasks.capture.coco_masks import coco_masks, fill_polygon, unpack_counts
from ss_flow.tasks.capture.id_images import ready_masks
from ss_flow.tasks.capture.ingest import IngestParams, frames
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.scene import open_scene

HEIGHT, WIDTH = made.HEIGHT, made.WIDTH
REFERENCE = {
    "<": (3, 4, []),
    "0<": (3, 4, [1] * 12),
    "11103011LO20O00031MOO33N0OM10000": (
        7,
        9,
        "010100001000001101000100100100000110010111100001100001011011011",
    ),
}
"""What COCO's own library packs: the string, height and width, and the pixels column by column."""


def counts(mask: np.ndarray) -> list[int]:
    """The run lengths of a mask, column by column, the first one outside."""
    lengths, inside = [0], False
    for pixel in mask.T.ravel():
        if bool(pixel) != inside:
            lengths.append(0)
            inside = not inside
        lengths[-1] += 1
    return lengths


def packed(lengths: list[int]) -> str:
    """COCO's compressed string of run lengths, one character after the other."""
    text = ""
    for place, length in enumerate(lengths):
        number = length - lengths[place - 2] if place > 2 else length
        while True:
            chunk, number = number & 31, number >> 5
            more = number != (-1 if chunk & 16 else 0)
            text += chr(48 + chunk + 32 * more)
            if not more:
                break
    return text


def run_lengths(mask: np.ndarray, *, compressed: bool = False) -> dict:
    lengths = counts(mask)
    return {"size": list(mask.shape), "counts": packed(lengths) if compressed else lengths}


def rectangle(x0: float, y0: float, x1: float, y1: float) -> list[list[float]]:
    return [[x0, y0, x1, y0, x1, y1, x0, y1]]


def square(rows: slice, columns: slice) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[rows, columns] = True
    return mask


def coco(views: dict[str, list]) -> dict:
    """A document with these segmentations, or whole annotations, by the file names of the images."""
    images = [{"id": i + 1, "file_name": name, "width": WIDTH, "height": HEIGHT} for i, name in enumerate(views)]
    annotations = []
    for image, given_masks in zip(images, views.values(), strict=True):
        for one in given_masks:
            whole = one if isinstance(one, dict) and "counts" not in one else {"segmentation": one}
            annotations.append({"id": len(annotations) + 1, "image_id": image["id"], "category_id": 1, **whole})
    return {"images": images, "annotations": annotations}


def read(root: Path, document, lenses=None, radial: float = 0.0, **changes):
    """The masks of the photos below `root`, from a document written beside them."""
    (root / "instance_masks.json").write_text(document if isinstance(document, str) else json.dumps(document))
    scene = open_scene(root)
    views = frames(names=scene.names, photos=refs(scene.photos), lenses=lenses, params=IngestParams(**changes))
    cameras = made.cameras_of(views, radial)
    return coco_masks(views, cameras, names=scene.names, file=ref(scene.coco_masks), lenses=lenses)


@pytest.mark.parametrize("text", REFERENCE)
def test_packed_run_lengths_are_read_as_cocos_library_writes_them(text):
    height, width, pixels = REFERENCE[text]
    lengths = unpack_counts(text)
    assert lengths.sum() == height * width
    unpacked = np.repeat(np.arange(len(lengths)) % 2, lengths).tolist()
    assert unpacked == ([int(p) for p in pixels] or [0] * (height * width))


@given(st.lists(st.integers(0, 1 << 30), min_size=1))
def test_packing_and_unpacking_gives_any_run_lengths_back(lengths):
    assert unpack_counts(packed(lengths)).tolist() == lengths


def test_a_polygon_holds_the_pixels_whose_centres_it_holds():
    filled = fill_polygon(np.array([[1, 1], [4, 1], [4, 3], [1, 3]], float), 5, 6)
    assert np.argwhere(filled).tolist() == [[r, c] for r in (1, 2) for c in (1, 2, 3)]
    almost = fill_polygon(np.array([[1.6, 1.6], [4.4, 1.6], [4.4, 3.4], [1.6, 3.4]]), 5, 6)
    assert np.argwhere(almost).tolist() == [[2, 2], [2, 3]]
    beyond = fill_polygon(np.array([[-9, -9], [2, -9], [2, 99], [-9, 99]], float), 5, 6)
    np.testing.assert_array_equal(beyond, np.arange(6)[None].repeat(5, axis=0) < 2)


@given(st.integers(3, 9), st.integers(0, 2**32 - 1))
def test_a_polygon_agrees_with_a_test_of_every_centre(corners, seed):
    polygon = np.random.default_rng(seed).uniform(-3, 15, (corners, 2))
    inside = np.zeros((10, 12), bool)
    for row, column in np.ndindex(inside.shape):
        x, y = column + 0.5, row + 0.5
        for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            if (ay <= y) != (by <= y) and x >= ax + (y - ay) * (bx - ax) / (by - ay):
                inside[row, column] ^= True
    np.testing.assert_array_equal(fill_polygon(polygon, 10, 12), inside)


def test_all_forms_of_a_mask_say_the_same(tmp_path):
    made.photos(tmp_path)
    mask = square(slice(4, 20), slice(6, 30))
    forms = [rectangle(6, 4, 30, 20), run_lengths(mask), run_lengths(mask, compressed=True)]
    for found in read(tmp_path, coco({f"{name}.jpg": [form] for name, form in zip(made.NAMES, forms, strict=True)})):
        np.testing.assert_array_equal(found.dense(), mask[None])


def test_the_polygons_of_one_mask_are_united(tmp_path):
    made.photos(tmp_path)
    both = rectangle(0, 0, 8, 8) + rectangle(4, 4, 12, 12)
    found = read(tmp_path, coco({"2.jpg": [both]}))[0]
    assert len(found) == 1 and found.dense().sum() == 64 + 64 - 16


def test_masks_that_overlap_stay_apart_and_know_their_parents(tmp_path):
    made.photos(tmp_path)
    inner, outer = rectangle(2, 2, 6, 6), rectangle(0, 0, 16, 16)
    given_masks = [
        {"segmentation": inner, "score": 0.5},
        {"segmentation": outer, "predicted_iou": 0.75, "score": 0.1},
        {"segmentation": rectangle(10, 0, 32, 16)},
        {"segmentation": rectangle(31.6, 0, 32, 16)},
        {"segmentation": rectangle(0, 0, 32, 24), "iscrowd": 1},
    ]
    found = read(tmp_path, coco({"2.jpg": given_masks}))[0]
    assert found.dense().sum(axis=(1, 2)).tolist() == [22 * 16, 16 * 16, 16]
    np.testing.assert_allclose(found.predicted_iou, [1.0, 0.75, 0.5])
    assert found.parent.tolist() == [-1, -1, 1]
    assert found.source == "ready-made" and found.name == "2"


def test_views_are_known_by_the_stems_of_file_names_and_those_not_listed_have_no_masks(tmp_path):
    made.photos(tmp_path)
    document = coco({"some/where/10.png": [rectangle(0, 0, 8, 8)], "C:\\here\\2.JPG": [], "other.jpg": [[[1, 2]]]})
    with pytest.warns(UserWarning, match=r"does not list 1 of 3 views: 11\."):
        two, ten, eleven = read(tmp_path, document)
    assert [len(found) for found in (two, ten, eleven)] == [0, 1, 0]
    assert (two.dense().shape, two.parent.shape) == ((0, HEIGHT, WIDTH), (0,))


def test_views_that_are_called_by_their_path_are_known_by_it(tmp_path):
    names = ("cam1_1", "cam2_1", "cam2_2")
    views = frames(names=names, photos=refs(made.photos(tmp_path).iterdir()))
    document = coco({"images/cam2/1.png": [], "cam1/1.png": [rectangle(0, 0, 8, 8)], "cam2_2.png": []})
    (tmp_path / "masks.json").write_text(json.dumps(document))
    found = coco_masks(views, made.cameras_of(views), names=names, file=ref(tmp_path / "masks.json"))
    assert [len(masks) for masks in found] == [1, 0, 0]


def test_a_view_is_known_whichever_way_file_names_write_an_accent(tmp_path):
    composed, apart = (unicodedata.normalize(form, "Küche") for form in ("NFC", "NFD"))
    made.write(tmp_path / f"{composed}.jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    (kitchen,) = read(tmp_path, coco({f"{apart}.jpg": [rectangle(0, 0, 8, 8)]}))
    assert (kitchen.name, len(kitchen)) == (composed, 1)


def test_crowd_regions_are_left_out_with_a_warning(tmp_path):
    made.photos(tmp_path)
    document = coco({f"{name}.jpg": [rectangle(0, 0, 8, 8)] for name in ("2", "10", "11")})
    document["annotations"][0]["iscrowd"] = 1
    with pytest.warns(UserWarning, match="1 crowd regions of .* are left out"):
        found = read(tmp_path, document)
    assert [len(masks) for masks in found] == [0, 1, 1]


def masks_both_ways(root: Path, ids: np.ndarray, lenses=None, radial: float = 0.0, **changes):
    """The masks of the first view from an id image, and from run lengths."""
    found = read(root, coco({"2.jpg": [run_lengths(ids == i) for i in (1, 2)]}), lenses, radial, **changes)[0]
    made.write(root / "ids" / "2.png", ids)
    scene = open_scene(root)
    views = frames(names=scene.names, photos=refs(scene.photos), lenses=lenses, params=IngestParams(**changes))[:1]
    same = ready_masks(
        views, made.cameras_of(views, radial), names=scene.names, files=refs([root / "ids" / "2.png"]), lenses=lenses
    )[0]
    return found, same


@pytest.mark.parametrize(
    ("lens", "radial"),
    [
        (None, 0.0),
        (Lens(WIDTH, HEIGHT, 30, 30, 16, 12, (0.4, 0.0, 0.0, 0.0)), 0.0),
        (Lens(WIDTH, HEIGHT, 30, 30, 16, 12, (0.2, 0.1, 0.0, 0.0), fisheye=True), 0.0),
        (None, 0.4),
    ],
    ids=["pinhole", "lens", "fisheye", "lens from structure from motion"],
)
@pytest.mark.parametrize("max_side", [32, 16])
def test_masks_follow_their_photo_as_id_images_do(lens, radial, max_side, tmp_path):
    made.photos(tmp_path)
    ids = (square(slice(1, 13), slice(1, 20)) + 2 * square(slice(13, 24), slice(9, 31))).astype(np.uint16)
    found, same = masks_both_ways(tmp_path, ids, (lens,) * 3 if lens else None, radial, max_side=max_side)
    assert found.dense().shape == (2, max_side * 3 // 4, max_side)
    in_order = same.dense()[np.argsort(-same.dense().sum(axis=(1, 2)))]
    np.testing.assert_array_equal(found.dense(), in_order)
    if lens or radial:
        plain = cv2.resize(ids, (max_side, max_side * 3 // 4), interpolation=cv2.INTER_NEAREST)
        assert (found.dense().any(axis=0) != (plain > 0)).sum() > 10


def one(segmentation=None, **changes) -> dict:
    """A document with one annotation; changes go to it."""
    document = coco({"2.jpg": [segmentation if segmentation is not None else rectangle(0, 0, 8, 8)]})
    document["annotations"][0] |= changes
    return document


def image(**changes) -> dict:
    document = one()
    document["images"][0] |= changes
    return document


WHOLE = HEIGHT * WIDTH
BAD = {
    "no JSON": ("{", "is not valid JSON"),
    "a name that stands twice": ('{"images": [], "images": []}', "'images' stands twice in one object"),
    "a list": ([], "is no COCO instance file; .* `images` and `annotations`"),
    "no annotations": ({"images": []}, "is no COCO instance file"),
    "images that are names": ({"images": ["2.jpg"], "annotations": []}, "is no COCO instance file"),
    "an image without an id": ({"images": [{"file_name": "2.jpg"}], "annotations": []}, "without an `id` or"),
    "an image without a name": ({"images": [{"id": 1}], "annotations": []}, "without an `id` or a `file_name`"),
    "two images of one stem": (coco({"2.jpg": [], "a/2.png": []}), "two images with the id 2 or the stem '2'"),
    "two images of one id": (
        {"images": [{"id": 1, "file_name": "2.jpg"}, {"id": 1, "file_name": "3.jpg"}], "annotations": []},
        "two images with the id 1",
    ),
    "images of another scene": (coco({"kitchen.jpg": []}), "lists no image named after a view; 2.jpg, for one"),
    "an annotation of no image": (one(image_id=9), "annotation 1 of .* has the image_id 9, which is that of no image"),
    "an annotation without image_id": (one(image_id=None), "has the image_id None"),
    "an image of another size": (image(width=64), "a width and height of 64 and 24, but the photo has 32 and 24"),
    "an image without a size": (image(height=None), "a width and height of 32 and None"),
    "no segmentation": (one({}), "annotation 1 of .* has no segmentation"),
    "an empty segmentation": (one([]), "has no segmentation"),
    "a segmentation that is text": (one("all"), "has no segmentation"),
    "a polygon that is flat": (one([0, 0, 8, 0, 8, 8]), "has a polygon that is no list of numbers"),
    "a polygon of two corners": (one([[0, 0, 8, 8]]), "three corners or more"),
    "a polygon with half a corner": (one([[0, 0, 8, 0, 8, 8, 1]]), "has a polygon that is no list of numbers"),
    "a polygon of words": (one([["a", 0, 8, 0, 8, 8]]), "has a polygon that is no list of numbers"),
    "a polygon with NaN": (one([[float("nan"), 0, 8, 0, 8, 8]]), "has a polygon that is no list of numbers"),
    "a polygon with an endless number": (one([[10**400, 0, 8, 0, 8, 8]]), "has a polygon that is no list of numbers"),
    "a polygon of another photo": (one([[0, 0, 900, 0, 900, 700]]), "leaves its photo of 32x24 pixels far behind"),
    "run lengths without a size": (one({"counts": [WHOLE]}), r"of size None; that of its photo, \[24, 32\]"),
    "run lengths turned on their side": (one({"size": [WIDTH, HEIGHT], "counts": [WHOLE]}), r"of size \[32, 24\]"),
    "run lengths that are too few": (one({"size": [HEIGHT, WIDTH], "counts": [5, 9]}), "do not add up to the 768"),
    "run lengths below 0": (one({"size": [HEIGHT, WIDTH], "counts": [-1, WHOLE + 1]}), "`counts` that cannot be read"),
    "run lengths of words": (one({"size": [HEIGHT, WIDTH], "counts": ["a"]}), "a list of whole numbers"),
    "run lengths that are a number": (one({"size": [HEIGHT, WIDTH], "counts": 7}), "a list of whole numbers"),
    "a packed string that is empty": (one({"size": [HEIGHT, WIDTH], "counts": ""}), "`counts` that cannot be read"),
    "a packed string that is cut": (one({"size": [HEIGHT, WIDTH], "counts": "PP"}), "or it is cut short"),
    "a packed string with a blank": (one({"size": [HEIGHT, WIDTH], "counts": "1 1"}), "other characters than"),
    "a packed string with an accent": (one({"size": [HEIGHT, WIDTH], "counts": "1é1"}), "other characters than"),
    "a packed string of another photo": (one({"size": [HEIGHT, WIDTH], "counts": "<"}), "do not add up to the 768"),
    "a packed string with an endless number": (
        one({"size": [HEIGHT, WIDTH], "counts": "o" * 9 + "1"}),
        "more than 35 bits",
    ),
    "a packed string of negative lengths": (
        one({"size": [HEIGHT, WIDTH], "counts": packed([WHOLE + 8, -8])}),
        "do not add up",
    ),
    "crowds only": (one(iscrowd=1), "has iscrowd = 1 in all its 1 annotations, .* set it to 0"),
    "a score that is a word": (one(score="high"), "annotation 1 of .* has the score 'high'; a number is expected"),
    "a score that is NaN": (one(predicted_iou=float("nan")), "has the predicted_iou nan"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_with_one_sentence_that_names_it(name, tmp_path):
    document, says = BAD[name]
    made.photos(tmp_path)
    with pytest.raises(InputError, match=says) as refused:
        read(tmp_path, document)
    message = str(refused.value)
    assert "instance_masks.json" in message
    assert "\n" not in message and re.search(r"[.?]$", message)


def test_an_annotation_without_an_id_is_told_by_its_number(tmp_path):
    made.photos(tmp_path)
    document = one({})
    del document["annotations"][0]["id"]
    with pytest.raises(InputError, match="annotation number 0 of"):
        read(tmp_path, document)


def test_masks_in_two_places_are_refused_unless_one_is_named(tmp_path):
    made.photos(tmp_path)
    (tmp_path / "instance_masks.json").write_text("{}")
    (tmp_path / "hints.json").write_text("{}")
    with pytest.raises(InputError, match=r"holds instance_masks\.json and hints\.json; name the one to use"):
        open_scene(tmp_path)
    scene = open_scene(tmp_path, masks=tmp_path / "instance_masks.json")
    assert scene.coco_masks and scene.has_masks and scene.hints is None and scene.ready_masks is None


@pytest.mark.parametrize("option", ["masks", "hints"])
def test_masks_and_hints_cannot_go_with_a_video(option, tmp_path):
    (tmp_path / "walk.mp4").write_bytes(b"")
    (tmp_path / "some.json").write_text("{}")
    with pytest.raises(InputError, match=r"some\.json cannot go with a video"):
        open_scene(tmp_path / "walk.mp4", **{option: tmp_path / "some.json"})
