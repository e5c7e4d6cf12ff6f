"""Views that are left out, told by name, and what a stride makes of them."""

from pathlib import Path

import capture_folders as made
import numpy as np
import pytest
from capture_folders import WORLD_TO_CAMERA

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.capture import ingest
from ss_flow.tasks.capture.scene import open_scene


@pytest.mark.parametrize("lost", [-np.inf, np.nan, "one number"])
def test_scannet_views_whose_tracking_was_lost_are_skipped(tmp_path, lost):
    made.scannet(tmp_path)
    pose = np.full((4, 4), lost) if lost != "one number" else made.pose(0)
    if lost == "one number":
        pose[0, 3] = np.nan
    np.savetxt(tmp_path / "pose" / "10.txt", pose)
    scene = open_scene(tmp_path)
    assert scene.names == ("2", "11") and scene.skipped == ("10",)
    assert len(scene.depths) == len(scene.ground_truth) == len(scene.valid) == 2


def test_photos_that_a_colmap_model_lacks_or_that_are_not_read_are_skipped(tmp_path):
    made.colmap(tmp_path / "colmap", binary=True)
    assert open_scene(tmp_path / "colmap").skipped == ()
    (tmp_path / "colmap/images/12.png").write_bytes((tmp_path / "colmap/images/2.png").read_bytes())
    assert open_scene(tmp_path / "colmap").skipped == ("12",)
    loose = made.photos(tmp_path / "loose")
    (next(loose.rglob("2.*")).parent / "IMG_3.DNG").write_bytes(b"")
    assert open_scene(loose).skipped == ("IMG_3.DNG",)
    whys = [open_scene(place).why_skipped for place in (tmp_path / "colmap", loose)]
    assert whys == ["which the model did not register", "whose format is not read"]


def test_every_second_view_keeps_everything_aligned(tmp_path):
    scene = open_scene(made.scannet(tmp_path)).every(2)
    assert scene.names == ("2", "11")
    assert [p.stem for p in (*scene.photos, *scene.depths, *scene.valid, *scene.ground_truth)] == ["2", "11"] * 4
    np.testing.assert_allclose(scene.world_to_camera, WORLD_TO_CAMERA[[0, 2]], atol=1e-9)


@pytest.mark.parametrize("layout", ["scannet", "nerfstudio", "tum", "colmap", "sens", "photos"])
def test_views_that_are_left_out_count_among_every_so_many(tmp_path, layout):
    if layout == "sens":  # whose second frame is lost
        place, names = made.sens(tmp_path / "a.sens", count=5), [f"frame-{i:06d}" for i in range(5)]
    else:
        place, names = getattr(made, layout)(tmp_path), ["2", "10", "11"]
    if layout == "scannet":
        np.savetxt(tmp_path / "pose" / "10.txt", np.full((4, 4), -np.inf))
    elif layout == "nerfstudio":
        (tmp_path / "images" / "10.png").unlink()
    elif layout == "tum":
        (tmp_path / "depth.txt").write_text((tmp_path / "depth.txt").read_text().replace("101.01", "101.03"))
    elif layout == "colmap":
        (tmp_path / "images" / "1.png").write_bytes((tmp_path / "images" / "2.png").read_bytes())
        names = ["1", *names]
    elif layout == "photos":
        (tmp_path / "10.jpg").rename(tmp_path / "10.dng")
    whole = open_scene(place)
    (lost,) = whole.skipped
    place_of_lost = names.index(Path(lost).stem)
    assert [Path(name).stem for name in whole.all_names] == names
    assert whole.every(1) == whole
    for stride in (2, 3):
        part = whole.every(stride)
        assert part.names == tuple(name for name in names[::stride] if name != Path(lost).stem)
        assert part.skipped == ((lost,) if place_of_lost % stride == 0 else ())


def test_a_stride_that_meets_lost_views_only_is_refused(tmp_path):
    made.scannet(tmp_path)
    for name in ("2", "11"):
        np.savetxt(tmp_path / "pose" / f"{name}.txt", np.full((4, 4), -np.inf))
    with pytest.raises(InputError, match=r"has no view that can be used .*capture\.stride.*; take another"):
        open_scene(tmp_path).every(2)


def test_a_raw_file_beside_its_photo_is_no_view_that_is_left_out(tmp_path):
    made.photos(tmp_path)
    (tmp_path / "10.dng").write_bytes(b"")
    assert open_scene(tmp_path).skipped == ()


@pytest.mark.parametrize("suffix", ["rw2", "orf", "jxl", "gif"])
def test_photos_of_formats_that_are_not_read_are_left_out_by_name(tmp_path, suffix):
    made.photos(tmp_path)
    (tmp_path / f"12.{suffix}").write_bytes(b"")
    assert open_scene(tmp_path).skipped == (f"12.{suffix}",)


def test_frames_of_a_transforms_json_whose_photo_is_missing_are_left_out_with_a_warning(tmp_path):
    made.nerfstudio(tmp_path)
    whole = open_scene(tmp_path)
    (tmp_path / "images" / "10.png").unlink()
    scene = open_scene(tmp_path)
    assert scene.skipped == ("10",) and scene.names == tuple(name for name in whole.names if name != "10")
    files = tuple(FileRef(photo, "") for photo in scene.photos)
    with pytest.warns(UserWarning, match="1 view is left out, whose photo is not there: 10."):
        ingest.frames(
            names=scene.names,
            photos=files,
            lenses=scene.lenses,
            skipped=scene.skipped,
            why_skipped=scene.why_skipped,
        )


def test_photos_that_a_colmap_model_did_not_register_are_skipped_by_name(tmp_path):
    assert open_scene(made.colmap(tmp_path / "all")).skipped == ()
    scene = open_scene(made.colmap(tmp_path / "some", registered=2))
    assert scene.names == tuple(made.NAMES[:2])
    assert scene.skipped == tuple(made.NAMES[2:])


def test_photos_of_a_folder_of_which_a_colmap_model_registered_none_are_skipped_by_name_too(tmp_path):
    made.colmap(tmp_path)
    for name in ("b/2", "b/3", "c/deep/4"):
        made.write(tmp_path / f"images/{name}.png", made.photo())
    scene = open_scene(tmp_path)
    assert scene.names == made.NAMES and scene.skipped == ("b_2", "3", "4")
