"""Captures of phones with LiDAR, as Polycam and Stray Scanner write them."""

import json
from dataclasses import replace

import capture_folders as made
import cv2
import numpy as np
import pytest

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.params import Params
from ss_flow.tasks.capture.ingest import black_border, cameras, frames
from ss_flow.tasks.capture.recordings import recorded_frames
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.sensor_depth import depth
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid

UP, RIGHT = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])


def read(scene):
    """Frames, cameras and depth of an opened capture."""
    if scene.kind == "stray":
        shown = recorded_frames(
            recording=made.ref(scene.recording), names=scene.names, entries=scene.entries, lenses=scene.lenses
        )
    else:
        shown = frames(
            names=scene.names, photos=made.refs(scene.photos), lenses=scene.lenses, black_borders=scene.black_borders
        )
    seen_by = cameras(shown, names=scene.names, lenses=scene.lenses, poses=scene.poses, metric=scene.metric)
    measured = depth(
        shown,
        names=scene.names,
        files=made.refs(scene.depths),
        confidences=made.refs(scene.confidences),
        scale=scene.depth_scale,
        metric=True,
        lenses=scene.lenses,
    )
    return shown, seen_by, measured


def open_made(layout, root, **how):
    return open_scene(getattr(made, layout)(root, **how))


@pytest.mark.parametrize("layout", ["polycam", "stray"])
@pytest.mark.parametrize("turns", range(4))
def test_photos_are_turned_upright_with_their_cameras_and_their_depth(layout, turns, tmp_path):
    scene = open_made(layout, tmp_path, turns=turns)
    assert (scene.kind, scene.metric, scene.skipped) == (layout, True, ())
    shown, seen_by, measured = read(scene)
    for i, frame in enumerate(shown):
        assert (frame.width > frame.height) == (turns % 2 == 0)
        rotation = seen_by.world_to_camera[i, :3, :3]
        np.testing.assert_allclose(rotation @ UP, [0, -1, 0], atol=1e-12)
        np.testing.assert_allclose(rotation @ RIGHT, [1, 0, 0], atol=1e-12)
        np.testing.assert_allclose(-rotation.T @ seen_by.world_to_camera[i, :3, 3], [i, 1.5, 4], atol=1e-12)
        # What the stored depth map has in its first row is where the upright one has it after so many turns.
        assert measured[i].depth.shape == np.rot90(np.empty((12, 16)), turns).shape
        lying = np.rot90(measured[i].depth, -turns)
        assert lying[0, 0] == 0
        np.testing.assert_allclose(lying[1:], 1 + i / 1000, rtol=1e-6)


@pytest.mark.parametrize("turns", range(4))
def test_what_a_stored_pixel_shows_lies_in_the_same_direction_once_it_is_turned(turns, tmp_path):
    scene = open_made("polycam", tmp_path, turns=turns)
    shown, seen_by, _ = read(scene)
    fx, fy, cx, cy = made.lying_lens()
    stored = cv2.cvtColor(cv2.imread(str(scene.photos[0])), cv2.COLOR_BGR2RGB)
    column, row = 25, 5
    toward = made.phone_pose(0, turns)[:3, :3] @ [(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1]
    x, y, z = seen_by.world_to_camera[0, :3, :3] @ toward
    focal_x, focal_y, center_x, center_y = seen_by.intrinsics[0]
    u, v = x / z * focal_x + center_x - 0.5, y / z * focal_y + center_y - 0.5
    assert (u, v) == (pytest.approx(round(u), abs=1e-9), pytest.approx(round(v), abs=1e-9))
    # Of random colours, which JPEG blurs, the turned photo keeps this pixel's within a few dozen of 255.
    difference = decode_rgb(shown[0])[round(v), round(u)].astype(int) - stored[row, column]
    assert np.abs(difference).max() < 40


def test_polycams_corrected_poses_and_photos_are_taken_where_the_app_has_them(tmp_path):
    corrected = open_made("polycam", tmp_path / "a")
    assert {photo.parent.name for photo in corrected.photos} == {"corrected_images"} and corrected.black_borders
    plain = open_made("polycam", tmp_path / "b", corrected=False)
    assert {photo.parent.name for photo in plain.photos} == {"images"} and not plain.black_borders
    np.testing.assert_allclose(plain.world_to_camera, corrected.world_to_camera)
    assert open_scene(tmp_path / "a/keyframes").poses == corrected.poses


def test_depth_of_the_lowest_confidence_is_unknown(tmp_path):
    *_, measured = read(open_made("polycam", tmp_path / "a"))
    np.testing.assert_allclose(measured[0].depth[0, :5], [0, 0, 0, 3, 1], rtol=1e-6)
    scene = open_scene(tmp_path / "a")
    scene.confidences[0].unlink()
    *_, measured = read(open_scene(tmp_path / "a"))
    assert measured[0].depth[0, 0] > 2.9 and measured[1].depth[0, 0] == 0


def test_corrected_cameras_of_newer_versions_tell_no_size_and_it_is_that_of_their_photos(tmp_path):
    scene = open_made("polycam", tmp_path, turns=1)
    for file in tmp_path.glob("keyframes/corrected_cameras/*.json"):
        values = json.loads(file.read_text())
        del values["width"], values["height"]
        file.write_text(json.dumps(values))
    again = open_scene(tmp_path)
    assert again.lenses == scene.lenses and scene.lenses[0].width == made.HEIGHT
    edit(tmp_path, width=made.WIDTH)
    with pytest.raises(InputError, match="has no number `height`"):
        open_scene(tmp_path)


def test_a_view_of_polycams_that_is_not_whole_is_left_out(tmp_path):
    scene = open_made("polycam", tmp_path)
    scene.depths[1].unlink()
    scene.photos[2].unlink()
    left = open_scene(tmp_path)
    assert (left.names, left.skipped, left.all_names) == (scene.names[:1], scene.names[1:], scene.names)
    assert len(left.poses) == len(left.lenses) == len(left.depths) == len(left.confidences) == 1


def test_without_a_sensor_polycams_poses_are_in_metres_all_the_same(tmp_path):
    made.polycam(tmp_path)
    for file in (tmp_path / "keyframes/depth").iterdir():
        file.unlink()
    scene = open_scene(tmp_path)
    assert (scene.depths, scene.confidences, scene.metric) == (None, (), True)


def test_borders_that_undistortion_left_black_do_not_count(tmp_path):
    image = np.full((60, 90, 3), 100, np.uint8)
    image[:2], image[20:30, :2], image[10, 2:60], image[40:44, 40:44] = 3, 0, 0, 0
    border = np.zeros((60, 90), bool)
    border[:2], border[20:30, :2] = True, True
    np.testing.assert_array_equal(black_border(image), border)  # neither the dark line nor the dark patch inside

    scene = open_made("polycam", tmp_path)
    for photo in scene.photos:
        made.write(photo, np.pad(np.full((24, 31, 3), 200, np.uint8), ((0, 0), (1, 0), (0, 0))))
    shown, _, measured = read(scene)
    keep = decode_valid(shown[0])
    assert not keep[:, 0].any() and keep[:, 2:].all()
    assert not measured[0].depth[:, 0].any() or keep[:, 1].any()
    plain = frames(names=scene.names, photos=made.refs(scene.photos), lenses=scene.lenses)
    assert decode_valid(plain[0]).all()


def test_strays_frames_come_out_of_the_video_by_their_place(tmp_path):
    scene = open_made("stray", tmp_path)
    assert scene.names == tuple(f"frame-{i:06d}" for i in range(4))
    shown, *_ = read(replace(scene.pick([1, 3]), valid=()))
    for frame, level in zip(shown, (80, 160), strict=True):
        assert abs(int(decode_rgb(frame)[24, 8, 0]) - level) < 8
        assert decode_rgb(frame)[24, 50].max() < 16


def test_a_video_that_players_are_to_turn_is_read_as_it_is_stored_since_the_lens_is_of_that(tmp_path):
    scene = open_made("stray", tmp_path)
    data = bytearray(scene.recording.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40  # of the track's header, behind its times, number and volume
    quarter = (0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    data[matrix : matrix + 36] = b"".join(number.to_bytes(4, "big", signed=True) for number in quarter)
    scene.recording.write_bytes(data)
    player = cv2.VideoCapture(str(scene.recording))
    assert player.read()[1].shape == (64, 48, 3)
    turned = open_scene(tmp_path)
    assert turned.lenses == scene.lenses
    assert read(replace(turned, valid=()))[0][0].width == 64


def test_strays_rows_may_hold_the_lens(tmp_path):
    common = open_made("stray", tmp_path / "a")
    assert {(lens.fx, lens.cx, lens.width) for lens in common.lenses} == {(60, 32, 64)}
    assert [lens.fx for lens in open_made("stray", tmp_path / "b", lens_of_rows=True).lenses] == [60, 61, 62, 63]


def test_strays_frames_without_depth_and_rows_beyond_the_video_are_left_out(tmp_path):
    scene = open_made("stray", tmp_path)
    scene.depths[0].unlink()
    with (tmp_path / "odometry.csv").open("a") as file:
        file.write("\n101, 000004, 0, 0, 0, 0, 0, 0, 1")
    made.write(tmp_path / "depth/000004.png", made.depth_image(1000, 16, 12))
    left = open_scene(tmp_path)
    assert left.names == scene.names[1:] and left.entries == (1, 2, 3)
    assert left.skipped == (scene.names[0], "frame-000004")


@pytest.mark.parametrize("layout", ["polycam", "stray"])
def test_depth_that_is_not_read_is_not_passed_over(layout, tmp_path):
    scene = open_made(layout, tmp_path)
    for file in scene.depths:
        file.rename(file.with_suffix(".npy"))
    with pytest.raises(InputError, match=r"depth holds no depth map that is read, but \d+\.npy, for one; PNG of 16"):
        open_scene(tmp_path)
    for file in scene.depths:
        file.with_suffix(".npy").unlink()
    (scene.depths[0].parent / ".DS_Store").write_bytes(b"")
    assert open_scene(tmp_path).depths is None


def test_a_long_recording_gives_frames_as_a_video_does(tmp_path):
    scene = open_made("stray", tmp_path, frames=30)
    digests = file_digests(Store(tmp_path / "store"))

    def used(*texts):
        params = settings.apply(Params(), [f"capture.{text}" for text in texts])
        return prepare(scene, params, RunOptions(), digests).scene

    assert used().names == scene.names == used("max_views=5").names
    few = used("video.max_frames=5")
    assert len(few.names) == 5 and "--set capture.video.max_frames=30 uses all" in few.remarks[0]
    assert [file.stem for file in few.depths] == [f"{entry:06d}" for entry in few.entries]
    assert len(used("video.max_frames=8", "stride=2").names) == 4
    assert used("video.stride=3").entries == tuple(range(0, 30, 3)) == used("stride=3").entries


@pytest.mark.parametrize(
    "layout, spoil, message",
    [
        ("polycam", lambda root: edit(root, fx=None), r"2\.json has no number `fx`; a camera as Polycam exports it"),
        ("polycam", lambda root: edit(root, t_00=3.0), r"2\.json is not rigid"),
        ("polycam", lambda root: edit(root, fx=-1.0), r"2\.json have a focal length or size that is not positive"),
        ("stray", lambda root: column(root, "qw", "w"), "odometry.csv has no column `qw` in its first line; timestamp"),
        ("stray", lambda root: column(root, "\n100.0", "\n100.0, one"), "odometry.csv has a row without a number for"),
        ("stray", lambda root: column(root, " 000001,", " nan,"), "odometry.csv has the frame nan; a whole number is"),
        ("stray", lambda root: column(root, " 000001,", " inf,"), "odometry.csv has the frame inf; a whole number is"),
        ("stray", lambda root: column(root, " 000001,", " 0,"), "odometry.csv lists frame 0 2 times; each row is of a"),
        ("stray", lambda root: (root / "odometry.csv").write_text(made.STRAY_HEADER), "odometry.csv lists no frame"),
        ("stray", lambda root: (root / "odometry.csv").write_text(""), "odometry.csv has no column `frame`"),
        ("stray", lambda root: (root / "camera_matrix.csv").unlink(), "camera_matrix.csv is missing"),
        ("stray", lambda root: (root / "camera_matrix.csv").write_text("1 2"), "camera_matrix.csv does not hold a 3x3"),
        (
            "stray",
            lambda root: (root / "camera_matrix.csv").write_text("-1 0 1 0 1 1 0 0 1"),
            "camera_matrix.csv have a focal length or size that is not positive",
        ),
        ("stray", lambda root: (root / "rgb.mp4").write_bytes(b"no"), r"rgb\.mp4 cannot be opened as a video"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_sentence(layout, spoil, message, tmp_path):
    getattr(made, layout)(tmp_path)
    spoil(tmp_path)
    with pytest.raises(InputError, match=message):
        open_scene(tmp_path)


def test_an_archive_is_to_be_unzipped_first(tmp_path):
    (tmp_path / "kitchen.ZIP").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"kitchen.ZIP is an archive; unzip it, and give the folder that comes out"):
        open_scene(tmp_path / "kitchen.ZIP")


def edit(root, **changes):
    file = root / "keyframes/corrected_cameras/2.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def column(root, old, new):
    file = root / "odometry.csv"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_confidence_of_another_size_and_a_video_that_ends_early_are_refused_when_they_are_read(tmp_path):
    scene = open_made("polycam", tmp_path / "a")
    made.write(scene.confidences[1], np.zeros((6, 8), np.uint8))
    with pytest.raises(InputError, match=r"confidence/10.png is 8x6 pixels and the depth .*depth/10.png, 16x12"):
        read(scene)
    recording = open_made("stray", tmp_path / "b")
    with pytest.raises(InputError, match=r"rgb.mp4 ends or is damaged at frame 4 of 10 that are needed"):
        read(replace(recording, entries=(0, 1, 2, 9)))
