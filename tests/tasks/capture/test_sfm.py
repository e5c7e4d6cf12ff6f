from dataclasses import replace

import numpy as np
import pytest
from found_poses import cameras_of, find_poses
from generated_views import jittered, views

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Cameras, Frame
from ss_flow.tasks.capture import sfm
from ss_flow.tasks.capture.features import features
from ss_flow.tasks.capture.matches import match
from ss_flow.tasks.capture.sfm import MappingParams, SfmParams, Unregistered, accepted, registered
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, encode_png

EYES = [(x, y, 0.1 * x) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.3, 0.3)]


@pytest.fixture(scope="module")
def scene():
    return views(EYES, width=320, height=240, focal=300.0)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="module")
def found(scene, store):
    return cameras_of(find_poses(scene[0], store), store)


def noise(name, seed, width=320, height=240):
    """A photo of nothing."""
    pixels = np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return Frame(name, width, height, encode_png(pixels), np.zeros(0, np.uint8), width, height)


def aligned_centers(estimated: Cameras, true: Cameras) -> tuple[np.ndarray, np.ndarray, float]:
    """Camera centres of both in the true frame after the best similarity (Umeyama 1991), and its scale."""

    def centers(poses):
        return -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])

    a, b = centers(estimated.world_to_camera), centers(true.world_to_camera)
    a0, b0 = a - a.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(b0.T @ a0)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ sign) / (a0**2).sum()
    return scale * a0 @ (u @ sign @ vt).T, b0, float(scale)


def test_poses_of_a_generated_scene_are_found_up_to_a_similarity(scene, found):
    _, true, _ = scene
    estimated, expected, _ = aligned_centers(found, true)
    assert found.names == true.names
    assert not found.metric
    assert np.linalg.norm(estimated - expected, axis=1).max() < 0.02
    assert found.intrinsics[:, :2] == pytest.approx(300.0, rel=0.02)
    assert len(found.sparse_points) > 100


def test_photos_of_one_size_that_were_taken_through_two_lenses_have_two_focal_lengths(scene, store):
    through = {26.0: scene[0], 39.0: views(EYES, width=320, height=240, focal=450.0)[0]}
    chosen = [(26.0, row) for row in range(8)] + [(39.0, row) for row in (2, 3, 4, 5)]
    frames = tuple(replace(through[focal][row], name=f"{i:02d}", focal=focal) for i, (focal, row) in enumerate(chosen))
    cameras = cameras_of(find_poses(frames, store), store)
    assert len(cameras) == 12
    assert cameras.intrinsics[:8, 0] == pytest.approx(300.0, rel=0.03)
    assert cameras.intrinsics[8:, 0] == pytest.approx(450.0, rel=0.03)


@pytest.mark.parametrize("options", [{"jobs": 2}, {"executor": "processes"}])
def test_other_workers_find_the_same_to_the_bit(scene, found, tmp_path, options):
    store = Store(tmp_path)
    again = cameras_of(find_poses(scene[0], store, **options), store)
    for field in ("intrinsics", "world_to_camera", "sparse_points", "radial"):
        np.testing.assert_array_equal(getattr(again, field), getattr(found, field))


def test_the_global_mapper_finds_the_same_cameras(scene, found, store):
    params = SfmParams(mapping=MappingParams(mapper="global"))
    cameras = cameras_of(find_poses(scene[0], store, params), store)
    estimated, expected, _ = aligned_centers(cameras, scene[1])
    assert cameras.names == found.names
    assert np.linalg.norm(estimated - expected, axis=1).max() < 0.02
    assert not np.array_equal(cameras.world_to_camera, found.world_to_camera)


def test_a_photo_more_costs_its_own_features_and_pairs(scene, tmp_path):
    frames, store = scene[0], Store(tmp_path)
    find_poses(frames[:7], store)
    nodes = find_poses(frames, store).nodes
    computed = sorted(node["label"] for node in nodes if node["event"] == "finished")
    # The flow has no names for what comes out of `each`: "7" is the eighth photo.
    own = [f"capture.{step}[7]" for step in ("features", "look", "match", "partners")]
    assert computed == sorted([*own, "capture.accepted", "capture.sfm", "capture.unregistered"])


def test_a_photo_of_something_else_is_tried_once_more_left_out_and_dropped_from_the_frames(scene, store):
    frames = (scene[0][0], noise("stray", 0), *scene[0][1:])
    report = find_poses(frames, store)
    cameras = cameras_of(report, store)
    assert cameras.names == tuple(f.name for f in scene[0])
    with pytest.warns(UserWarning, match="1 view is left out, for which no pose was found: stray"):
        assert tuple(f.name for f in registered(frames, cameras)) == cameras.names
    assert sum(node["step"] == "capture.sfm" for node in report.nodes) == 2
    never = find_poses(frames, store, SfmParams(guided_matching="never"))
    assert sum(node["step"] == "capture.sfm" for node in never.nodes) == 1


def test_photos_that_do_not_overlap_are_refused_with_their_number(store):
    frames = tuple(noise(f"n{i}", i, 160, 120) for i in range(4))
    with pytest.raises(InputError, match="only 0 of 4 photos found their pose") as refusal:
        cameras_of(find_poses(frames, store), store)
    assert "\n" not in str(refusal.value)


def test_of_tries_the_one_counts_that_matches_fit_however_many_another_places(scene, found):
    frames, _, _ = scene
    photos = [features(frame) for frame in frames]
    matches = [match(photos[row], photos[:row]) for row in range(len(photos))]
    missing = Unregistered(np.zeros(0, np.int32), len(frames))
    wrong = jittered(found, 0.1, 5.0)
    rows = list(range(len(found) - 2))
    fewer = replace(
        found,
        names=found.names[:-2],
        **{field: getattr(found, field)[rows] for field in ("sizes", "intrinsics", "world_to_camera", "radial")},
    )
    taken = accepted((wrong, fewer), missing, photos, matches, min_registered=0.5)
    assert taken is fewer
    assert accepted((fewer, found), missing, photos, matches, min_registered=0.5) is found
    with pytest.warns(UserWarning, match=r"may be wrong: [2-9]\d% of .* usual, most of \S+ and \S+\. Where"):
        assert accepted((wrong, fewer), missing, photos, matches, min_registered=0.9) is wrong


def test_two_photos_are_too_few(scene, store):
    with pytest.raises(InputError, match="at least 3"):
        cameras_of(find_poses(scene[0][:2], store), store)


def test_frames_of_a_pinhole_keep_their_bytes_and_others_are_straightened(scene):
    frames, true, _ = scene
    assert registered(frames, true)[0].encoded is frames[0].encoded
    bent = replace(true, radial=np.full(len(true), 0.2))
    straight = registered(frames, bent)[0]
    image, original = decode_rgb(straight), decode_rgb(frames[0])
    # By hand: a pixel 80.5 from the centre shows what lay at 80.5 (1 + 0.2 (80.5 / 300)^2) = 81.66 from it.
    expected = 0.16 * original[120, 242].astype(float) + 0.84 * original[120, 241]
    assert np.abs(image[120, 240] - expected).max() < 3
    assert np.abs(original[120, 240] - expected).max() > 3
    assert (straight.width, straight.height) == (320, 240)
    assert decode_valid(straight)[120, 160]
    assert not decode_valid(straight)[0, 0]


@pytest.mark.parametrize(("fit_bent", "believed"), [(1000, False), (1019, False), (1030, True)])
def test_a_lens_that_bends_photos_much_is_believed_only_where_clearly_more_matches_fit_it(
    found, monkeypatch, fit_bent, believed
):
    bent = replace(found, radial=np.full(len(found), 0.4))
    straight = replace(found, radial=np.zeros(0))
    models = {"SIMPLE_RADIAL": bent, "SIMPLE_PINHOLE": straight}
    monkeypatch.setattr(sfm, "_mapped", lambda *given: models[given[3].camera_model])
    monkeypatch.setattr(sfm, "matches_that_fit", lambda model, *_: (fit_bent if model is bent else 1000, 1100))
    assert sfm.sfm([], (), ()) is (bent if believed else straight)


def test_a_lens_that_bends_photos_little_is_not_doubted(found, monkeypatch):
    slight = replace(found, radial=np.full(len(found), 0.1))
    assert 0 < sfm._bend(slight) < 0.1
    tried = []
    monkeypatch.setattr(sfm, "_mapped", lambda *given: tried.append(given[3].camera_model) or slight)
    assert sfm.sfm([], (), ()) is slight
    assert tried == ["SIMPLE_RADIAL"]
