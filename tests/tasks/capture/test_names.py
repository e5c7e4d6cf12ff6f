"""What captures and their views are called, and how names are sorted."""

import unicodedata
from pathlib import Path

import capture_folders as made
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.errors import InputError
from ss_flow.tasks.capture.names import capture_name, natural_key
from ss_flow.tasks.capture.scene import open_scene


@pytest.mark.parametrize("layout", ["photos", "scannet", "nerfstudio", "tum", "colmap"])
def test_a_folder_gives_its_capture_its_whole_name(tmp_path, layout, monkeypatch):
    root = getattr(made, layout)(tmp_path / "room 2024.05.01")
    monkeypatch.chdir(root)
    assert open_scene(root).name == open_scene(Path()).name == capture_name(root) == "room 2024.05.01"


def test_a_file_gives_its_capture_its_stem_and_a_transforms_json_its_folders_name(tmp_path, monkeypatch):
    assert open_scene(made.video(tmp_path / "walk.1.avi", count=2)).name == "walk.1"
    folder = made.nerfstudio(tmp_path / "kitchen")
    monkeypatch.chdir(folder)
    assert open_scene(folder / "transforms.json").name == open_scene(Path("transforms.json")).name == "kitchen"
    assert open_scene(folder).name == "kitchen"


def rig(root):
    """A COLMAP workspace of two cameras, whose photos have the same names in two folders."""
    made.colmap(root, binary=False)
    (root / "images" / "cam1").mkdir()
    (root / "images" / "cam2").mkdir()
    for old, new in (("2", "cam1/1"), ("10", "cam1/2"), ("11", "cam2/1")):
        (root / "images" / f"{old}.png").rename(root / "images" / f"{new}.png")
        for model in ("0", "1"):
            file = root / "sparse" / model / "images.txt"
            file.write_text(file.read_text().replace(f" {old}.png", f" {new}.png"))
    return root


def test_photos_of_one_stem_in_several_folders_are_called_by_their_path(tmp_path):
    scene = open_scene(rig(tmp_path))
    assert scene.names == ("cam1_1", "cam1_2", "cam2_1")
    made.write(tmp_path / "images" / "cam2" / "2.png", made.photo())
    (tmp_path / "valid").mkdir()
    made.write(tmp_path / "valid" / "cam1_2.png", made.photo()[..., 0])
    made.write(tmp_path / "valid" / "cam2" / "1.png", made.photo()[..., 0])
    scene = open_scene(tmp_path)
    assert scene.skipped == ("cam2_2",) and scene.all_names[-1] == "cam2_2"
    assert scene.valid == (None, tmp_path / "valid/cam1_2.png", tmp_path / "valid/cam2/1.png")


def test_photos_of_a_transforms_json_are_called_by_their_path_only_where_stems_clash(tmp_path):
    made.nerfstudio(tmp_path)
    for old, new in (("2", "cam1/1"), ("10", "cam1/2"), ("11", "cam2/3")):
        (tmp_path / "images" / new).parent.mkdir(exist_ok=True)
        (tmp_path / f"images/{old}.png").rename(tmp_path / f"images/{new}.png")
        text = (tmp_path / "transforms.json").read_text().replace(f"images/{old}.png", f"images/{new}.png")
        (tmp_path / "transforms.json").write_text(text)
    assert open_scene(tmp_path).names == ("1", "2", "3")
    (tmp_path / "images/cam2/3.png").rename(tmp_path / "images/cam2/1.png")
    (tmp_path / "transforms.json").write_text(text.replace("cam2/3.png", "cam2/1.png"))
    assert open_scene(tmp_path).names == ("cam1_1", "cam1_2", "cam2_1")


def test_photos_of_one_stem_in_one_folder_are_both_named_when_they_are_refused(tmp_path):
    made.photos(tmp_path)
    made.write(tmp_path / "10.png", made.photo())
    with pytest.raises(InputError) as refused:
        open_scene(tmp_path)
    assert str(refused.value).startswith(f"{tmp_path / '10.jpg'} and {tmp_path / '10.png'} both belong to view 10")


@given(st.lists(st.integers(0, 10**6), min_size=1))
def test_numbers_in_names_sort_by_value(numbers):
    names = [f"frame_{n}.jpg" for n in numbers]
    assert sorted(names, key=natural_key) == [f"frame_{n}.jpg" for n in sorted(numbers)]


def test_names_may_hold_digits_that_are_no_decimals():
    assert sorted(["\u00b22.jpg", "1\u00b212.jpg", "1\u00b22.jpg"], key=natural_key)[:2] == [
        "1\u00b22.jpg",
        "1\u00b212.jpg",
    ]


def test_masks_belong_to_their_photos_whichever_way_their_names_write_an_accent(tmp_path):
    composed, apart = (unicodedata.normalize(form, "Küche") for form in ("NFC", "NFD"))
    made.write(tmp_path / f"{composed}.jpg", np.zeros((24, 32, 3), np.uint8))
    for folder in ("instance", "instance_masks"):
        made.write(tmp_path / folder / f"{apart}.png", np.zeros((24, 32), np.uint16))
    scene = open_scene(tmp_path)
    assert [file.name for file in (*scene.ground_truth, *scene.ready_masks)] == [f"{apart}.png"] * 2
