"""Images of ids: masks that were made elsewhere, and annotations."""

import capture_folders as made
import numpy as np
import pytest
from capture_folders import ingested, refs
from PIL import Image

from ss_flow.errors import InputError
from ss_flow.tasks.capture.id_images import ground_truth, ready_masks
from ss_flow.tasks.capture.scene import open_scene


def test_ready_masks_become_one_mask_an_id_at_the_frames_size(tmp_path):
    made.photos(tmp_path)
    ids = np.zeros((24, 32), np.uint16)
    ids[:12, :16], ids[12:, 16:] = 700, 2
    for name in made.NAMES:
        made.write(tmp_path / "instance_masks" / f"{name}.png", ids if name != "11" else ids * 0)
    scene = open_scene(tmp_path)
    views = ingested(scene, max_side=16)
    first, _, empty = ready_masks(views, made.cameras_of(views), names=scene.names, files=refs(scene.ready_masks))
    assert first.dense().shape == (2, 12, 16)
    assert first.dense()[0, 6:, 8:].all() and first.dense()[0].sum() == 48
    assert first.dense()[1, :6, :8].all() and first.dense()[1].sum() == 48
    assert first.parent.tolist() == [-1, -1] and len(empty) == 0 and empty.dense().shape == (0, 12, 16)


@pytest.mark.parametrize(("colours", "bits"), [(3, 2), (200, 8)])
def test_ids_may_be_the_numbers_of_a_palettes_colours(tmp_path, colours, bits):
    made.photos(tmp_path)
    rng = np.random.default_rng(0)
    ids = rng.integers(0, colours, (24, 32), dtype=np.uint8)
    image = Image.fromarray(ids)
    image.putpalette(rng.integers(0, 256, 3 * colours, dtype=np.uint8).tobytes())
    (tmp_path / "instance").mkdir()
    image.save(tmp_path / "instance/2.png", transparency=0)
    assert (tmp_path / "instance/2.png").read_bytes()[24:26] == bytes([bits, 3])
    scene = open_scene(tmp_path)
    views = ingested(scene)
    (found,) = ground_truth(views, made.cameras_of(views), names=scene.names, files=refs(scene.ground_truth))
    np.testing.assert_array_equal(found.ids, ids)


def test_masks_of_photos_lose_the_distortion_that_structure_from_motion_found(tmp_path):
    """A square at a distorted place lands where the pinhole sees it; by hand: r' = r (1 + k r^2), focal length 101."""
    ids = np.zeros((101, 101), np.uint16)
    column = int(np.floor(50.5 + 0.3 * (1 + 0.5 * 0.3**2) * 101))
    ids[49:52, column - 1 : column + 2] = 7
    made.write(tmp_path / "a.png", made.photo(width=101, height=101))
    made.write(tmp_path / "instance_masks" / "a.png", ids)
    scene = open_scene(tmp_path)
    views = ingested(scene)
    given = made.cameras_of(views, radial=0.5), made.cameras_of(views)
    moved, kept = (ready_masks(views, c, names=scene.names, files=refs(scene.ready_masks))[0] for c in given)
    assert (np.argwhere(moved.dense()[0]) + 0.5).mean(axis=0) == pytest.approx([50.5, 50.5 + 0.3 * 101], abs=0.6)
    np.testing.assert_array_equal(kept.dense()[0], ids == 7)


def test_ground_truth_covers_the_annotated_views_only(tmp_path):
    scene = open_scene(made.scannet(tmp_path))
    (tmp_path / "instance" / "10.png").unlink()
    scene = open_scene(tmp_path)
    views = ingested(scene)
    maps = ground_truth(views, made.cameras_of(views), names=scene.names, files=refs(scene.ground_truth))
    assert [m.name for m in maps] == ["2", "11"]
    assert maps[0].ids.dtype == np.uint16 and (maps[0].ids == 3).all()


def test_ground_truth_without_an_instance_in_the_views_that_are_used_is_refused_before_all_else(tmp_path):
    made.scannet(tmp_path)
    for name in ("10", "11"):
        (tmp_path / "instance" / f"{name}.png").unlink()
    annotated = open_scene(tmp_path)
    made.write(tmp_path / "instance" / "2.png", np.zeros((made.HEIGHT, made.WIDTH), np.uint16))
    for scene in (annotated.pick([1, 2]), open_scene(tmp_path)):
        views = ingested(scene)
        with pytest.raises(InputError, match=rf"instance/ holds no instance in any of the {len(views)} views"):
            ground_truth(views, made.cameras_of(views), names=scene.names, files=refs(scene.ground_truth))
