"""The three protocols on labelled frames, on a scene whose renderings are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.flows.evaluate import LabelledScene, labels_of
from ss_flow.running import Surroundings, running
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Cameras, Descriptors, Frame, Gaussians, LabelMap
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.evaluate.lerf import Labels, _found_2d, langsplat_2d, oracle, strict
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.semantics.query import QueryParams, Similarity, chosen, similarity

WIDTH, HEIGHT = 80, 60
NAMES = ("a", "b")
FRAMES = tuple(
    Frame(n, WIDTH, HEIGHT, encode_png(np.zeros((HEIGHT, WIDTH, 3), np.uint8)), np.zeros(0, np.uint8), WIDTH, HEIGHT)
    for n in NAMES
)
CAMERAS = Cameras(
    NAMES,
    np.full((2, 2), (WIDTH, HEIGHT), np.int32),
    np.tile([50.0, 50.0, WIDTH / 2, HEIGHT / 2], (2, 1)),
    np.tile(np.eye(4), (2, 1, 1)),
    True,
)
BOXES = {1: (16, 12, 36, 42), 2: (48, 18, 66, 46)}
"""Pixels x0, y0, x1, y1 of the two instances: red and blue."""


def _wall(instance: int) -> Gaussians:
    """One Gaussian a pixel of the instance's box, at depth 1, opaque and hardly wider than the pixel."""
    x0, y0, x1, y1 = BOXES[instance]
    y, x = np.mgrid[y0:y1, x0:x1] + 0.5
    means = np.stack([(x - WIDTH / 2) / 50, (y - HEIGHT / 2) / 50, np.ones_like(x)], axis=-1).reshape(-1, 3)
    n = len(means)
    return Gaussians(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.full((n, 3), np.log(0.01), np.float32),
        np.full(n, 6, np.float32),
        np.zeros((n, 1, 3), np.float32),
        np.full(n, instance, np.int32),
        np.ones(n, np.float32),
        np.zeros(n, np.int32),
    )


def _both() -> Gaussians:
    parts = [vars(_wall(1)), vars(_wall(2))]
    return Gaussians(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


SCENE = _both()
TERM_VECTORS = np.eye(11, dtype=np.float32)
DESCRIPTORS = tuple(
    Descriptors(i, TERM_VECTORS[term], NAMES, np.ones(2, np.float32), "colour words", TERM_VECTORS[[term, term]])
    for i, term in ((1, 2), (2, 5))
)
"""Red, and blue, of the eleven terms."""


def _square(box: tuple[int, int, int, int]) -> list[list[int]]:
    x0, y0, x1, y1 = box
    return [[x0, y0], [x1 - 1, y0], [x1 - 1, y1 - 1], [x0, y1 - 1]]


def _labels(folder: Path, scale: int = 1, **views: list[tuple[str, tuple[int, int, int, int]]]) -> Labels:
    for view, objects in views.items():
        document = {
            "info": {"name": f"{view}.jpg", "width": scale * WIDTH, "height": scale * HEIGHT},
            "objects": [
                {"category": name, "segmentation": _square(tuple(scale * side for side in box))}
                for name, box in objects
            ],
        }
        (folder / f"{view}.json").write_text(json.dumps(document))
    return Labels(tuple(views), tuple(FileRef(folder / f"{view}.json", view) for view in views))


def _similar(*texts: str) -> tuple[Similarity, ...]:
    return tuple(similarity(DESCRIPTORS, text=text) for text in texts)


def _strict(labels: Labels, *texts: str) -> dict[str, float]:
    answers = tuple(chosen(found, params=QueryParams()) for found in _similar(*texts))
    return strict(FRAMES, CAMERAS, SCENE, answers, labels=labels, categories=texts).values


MUG_AND_BOX = [("red mug", BOXES[1]), ("blue box", BOXES[2])]


def test_what_texts_select_is_rendered_and_compared_pair_by_pair(tmp_path: Path) -> None:
    labels = _labels(tmp_path, a=MUG_AND_BOX, b=[("red mug", BOXES[2])])
    values = _strict(labels, "red mug", "blue box")
    assert values["num_targets"] == 3 and values["num_frames"] == 2
    assert values["miou"] == pytest.approx(2 / 3, abs=0.05), "in b the polygon lies on the blue one"
    assert values["macc25"] == values["macc50"] == pytest.approx(2 / 3)
    assert _strict(labels, "blue box")["macc25"] == pytest.approx(1 / 3), "a category without an answer scores 0"


@pytest.mark.parametrize("scale", [1, 2])
def test_labels_of_another_size_than_the_frame_are_met_in_their_own_pixels(tmp_path: Path, scale: int) -> None:
    values = _strict(_labels(tmp_path, scale, a=MUG_AND_BOX), "red mug", "blue box")
    assert values["miou"] > 0.9


def test_a_lenss_distortion_is_put_back_before_labels_are_met(tmp_path: Path) -> None:
    labels = _labels(tmp_path, a=MUG_AND_BOX)
    lens = Lens(WIDTH, HEIGHT, 50, 50, WIDTH / 2, HEIGHT / 2, (0.4, 0.0, 0.0, 0.0))
    bent = Labels(labels.views, labels.files, ("a",), (lens,))
    answers = tuple(chosen(found, params=QueryParams()) for found in _similar("red mug", "blue box"))
    categories = ("red mug", "blue box")
    straight, curved = (
        strict(FRAMES, CAMERAS, SCENE, answers, labels=given, categories=categories).values["miou"]
        for given in (labels, bent)
    )
    assert curved < straight - 0.1


def _maps(*ids: int) -> tuple[LabelMap, ...]:
    image = np.zeros((HEIGHT, WIDTH), np.uint16)
    for i in ids:
        x0, y0, x1, y1 = BOXES[i]
        image[y0:y1, x0:x1] = i
    return tuple(LabelMap(name, image) for name in NAMES)


def test_ground_truth_chooses_among_what_is_near_the_best(tmp_path: Path) -> None:
    labels = _labels(tmp_path, a=[("red mug", BOXES[2])])
    found = _similar("red mug")

    def scored(tau: float) -> dict[str, float]:
        kwargs = {"labels": labels, "categories": ("red mug",), "tau_corr": tau}
        return oracle(FRAMES, CAMERAS, _maps(1, 2), found, **kwargs).values

    # The text is that of instance 1, the polygon lies on 2, whose cosine is 1 less.
    assert scored(0.02) == {
        **{"miou": 0, "macc25": 0, "macc50": 0, "share": 0.5},
        **{"num_targets": 1, "num_frames": 1},
    }
    assert scored(1.0)["miou"] == 1 and scored(1.0)["share"] == 1


def test_rendered_features_find_and_localise(tmp_path: Path) -> None:
    labels = _labels(tmp_path, a=MUG_AND_BOX)
    texts = (("red mug", "red mug"), ("blue box", "blue box"))
    values = langsplat_2d(FRAMES, CAMERAS, SCENE, DESCRIPTORS, labels=labels, texts=texts).values
    assert values["localised"] == 1 and values["macc25"] == 1
    swapped = (("red mug", "blue"), ("blue box", "red"))
    values = langsplat_2d(FRAMES, CAMERAS, SCENE, DESCRIPTORS, labels=labels, texts=swapped).values
    assert values["localised"] == 0 and values["macc25"] == 0
    one = langsplat_2d(FRAMES, CAMERAS, SCENE, DESCRIPTORS, labels=labels, texts=texts[:1]).values
    assert one["localised"] == one["macc25"] == 0.5, "a category without a text scores 0"


@pytest.mark.parametrize("content", ["{", "[" * 100_000])
def test_a_label_file_that_is_damaged_is_named(tmp_path: Path, content: str) -> None:
    labels = _labels(tmp_path, a=MUG_AND_BOX)
    labels.files[0].path.write_text(content)
    with pytest.raises(InputError, match=r"a\.json cannot be read as JSON"):
        _strict(labels, "red mug")


@pytest.mark.parametrize(("columns", "found"), [((20, 24), (20, 24)), ((20, 23), (0, 0)), ((0, 3), (0, 2))])
def test_of_the_seven_by_seven_pixels_around_one_most_must_be_relevant(columns, found) -> None:
    relevancy, mask = np.zeros((40, 60), np.float32), np.zeros((40, 60), bool)
    relevancy[:, slice(*columns)] = 1
    mask[:, slice(*found)] = True
    # 4 of 7 columns are most, 3 are not. At the border a window has 4, 5, 6, 7 columns: 3 are most of 4 and of 5.
    np.testing.assert_array_equal(_found_2d(relevancy)[0], mask)


def test_frames_that_are_no_view_are_told_and_none_at_all_is_refused(tmp_path: Path) -> None:
    heard: list[str] = []
    with running(Surroundings(warned=heard)):
        assert _strict(_labels(tmp_path, a=MUG_AND_BOX, z=MUG_AND_BOX), "red mug")["num_frames"] == 1
    assert len(heard) == 1 and "1 labelled frames" in heard[0] and "z" in heard[0]
    with pytest.raises(InputError, match="None of the labelled frames"):
        _strict(_labels(tmp_path, z=MUG_AND_BOX), "red mug")
    document = json.loads((tmp_path / "a.json").read_text())
    document["info"]["height"] = 3 * HEIGHT
    (tmp_path / "a.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="both must show the same"):
        _strict(Labels(("a",), (FileRef(tmp_path / "a.json", "a"),)), "red mug")


LERF_COUNTS = {
    "figurines": ((17, 13, 11, 15), 57),
    "ramen": ((10, 8, 8, 11, 12, 8, 14), 80),
    "teatime": ((11, 11, 10, 11, 7, 9), 62),
    "waldo_kitchen": ((6, 4, 3, 5, 4), 30),
}
"""Categories of each labelled frame of LERF-OVS, and polygons in all of them (spec 2.2)."""


@pytest.mark.parametrize(
    ("scene", "pooled"), [("figurines", 56), ("ramen", 71), ("teatime", 59), ("waldo_kitchen", 22)]
)
def test_the_pairs_of_lerfs_scenes_are_counted_as_published(tmp_path: Path, scene: str, pooled: int) -> None:
    per_frame, polygons = LERF_COUNTS[scene]
    names = tuple(f"frame_{i:05d}" for i in range(len(per_frame)))
    extra = polygons - sum(per_frame)
    views = {
        name: [(f"red thing {i}", BOXES[1]) for i in range(n)]
        + ([("red thing 0", BOXES[2])] * extra if not row else [])
        for row, (name, n) in enumerate(zip(names, per_frame, strict=True))
    }
    labels = _labels(tmp_path, **views)
    n = len(names)
    frames = tuple(replace(FRAMES[0], name=name) for name in names)
    first = (np.repeat(x[:1], n, axis=0) for x in (CAMERAS.sizes, CAMERAS.intrinsics, CAMERAS.world_to_camera))
    cameras = Cameras(names, *first, True)
    maps = tuple(LabelMap(name, _maps(1, 2)[0].ids) for name in names)
    assert strict(frames, cameras, SCENE, (), labels=labels, categories=()).values["num_targets"] == pooled
    found = oracle(frames, cameras, maps, (), labels=labels, categories=(), tau_corr=0.02).values
    assert found["num_targets"] == polygons and found["num_frames"] == n


def test_a_scenes_labels_are_found_in_it_or_beside_it_as_in_lerf_ovs(tmp_path: Path) -> None:
    scene = SceneFiles("colmap", tmp_path / "lerf_ovs" / "figurines", names=("a",))
    scene.root.mkdir(parents=True)
    with pytest.raises(InputError, match="name their folder with --truth"):
        labels_of(scene)
    beside = tmp_path / "lerf_ovs" / "label" / "figurines"
    beside.mkdir(parents=True)
    assert labels_of(scene) == beside.resolve()
    _labels(beside, a=[("red mug", BOXES[1]), ("sheep", BOXES[2])])

    def opened(texts: dict[str, str] | None) -> LabelledScene:
        rules = {"encoder": None, "query": QueryParams(), "texts": texts}
        return LabelledScene.of(beside, scene, lambda p: FileRef(p, p.name), **rules)

    assert opened(None).texts == {"red mug": "red mug"} and opened(None).unread == ("sheep",)
    assert opened({"sheep": "the white one"}).texts["sheep"] == "the white one"
    with pytest.raises(InputError, match="names a colour"):
        opened({"red mug": "mug"})
