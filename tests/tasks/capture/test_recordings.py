import capture_folders as made
import cv2
import numpy as np
from capture_folders import ref

from ss_flow.tasks.capture.ingest import cameras
from ss_flow.tasks.capture.recordings import sens_depth, sens_frames
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.geometry.images import decode_rgb


def test_a_sens_file_gives_its_photos_and_depth_by_entry(tmp_path):
    scene = open_scene(made.sens(tmp_path / "a.sens"))
    recording = ref(scene.recording)
    frames = sens_frames(recording=recording, names=scene.names, entries=scene.entries)
    depth = sens_depth(frames, recording=recording, names=scene.names, entries=scene.entries)
    assert [f.name for f in frames] == ["frame-000000", "frame-000002"]
    jpeg = cv2.imencode(".jpg", made.photo(2))[1]
    np.testing.assert_array_equal(decode_rgb(frames[1]), cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[..., ::-1])
    np.testing.assert_allclose(depth[0].depth, np.full((12, 16), 1.0), rtol=1e-6)
    np.testing.assert_allclose(depth[1].depth, np.full((12, 16), 1.002), rtol=1e-6)
    assert len(cameras(frames, names=scene.names, lenses=scene.lenses, poses=scene.poses, metric=True)) == 2
