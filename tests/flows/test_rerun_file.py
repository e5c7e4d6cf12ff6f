"""A run as a recording of Rerun, read back with Rerun's own reader."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.flows.results import open_finished
from ss_flow.flows.view import rerun_file
from ss_flow.tasks.geometry.cameras import camera_of

needs_rerun = pytest.mark.skipif(
    rerun_file.find_spec("rerun") is None, reason="needs the extra `rerun` (pip install 'ss-flow[rerun]')"
)


@pytest.fixture(scope="module")
def run(tiny):
    return open_finished(tiny.out)


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory) -> dict[tuple[str, str], list]:
    """What the recording holds: by entity and component, the values in order."""
    from rerun.chunk import RrdReader

    file = tmp_path_factory.mktemp("recording") / "room.rrd"
    rerun_file.write_recording(file, run)
    assert [one.name for one in file.parent.iterdir()] == ["room.rrd"]
    found: dict[tuple[str, str], list] = {}
    for chunk in RrdReader(file).stream():
        batch = chunk.to_record_batch()
        for name in (name for name in batch.schema.names if name != "log_time"):
            found.setdefault((chunk.entity_path, name.rpartition(":")[2]), []).extend(batch.column(name).to_pylist())
    return found


@needs_rerun
def test_every_view_has_its_camera_photo_masks_and_depth(recorded, run):
    cameras = run.artifact("cameras")
    for view, frame in enumerate(run.artifact("ingest")):
        place = f"/world/views/{frame.name}"
        (translation,) = recorded[place, "translation"]
        np.testing.assert_allclose(translation[0], camera_of(cameras, view).center, rtol=1e-5, atol=1e-6)
        (rotation,) = recorded[place, "mat3x3"]  # column by column
        np.testing.assert_allclose(rotation[0][6:], cameras.world_to_camera[view, 2, :3], atol=1e-6)
        assert bytes(recorded[f"{place}/photo", "blob"][0][0]) == frame.encoded.tobytes()
        for name in ("masks", "masks_split"):
            ids = run.artifact(name)[view].ids
            buffer = bytes(recorded[f"{place}/photo/{name}", "buffer"][0][0])
            assert (np.frombuffer(buffer, np.uint16).reshape(ids.shape) == ids).all()
        assert len(bytes(recorded[f"{place}/depth", "buffer"][0][0])) == run.artifact("depth")[view].depth.nbytes


@needs_rerun
def test_points_and_solid_gaussians_are_there_with_their_objects(recorded, run):
    np.testing.assert_array_equal(recorded["/world/dense/photo", "positions"][0], run.artifact("dense").points)
    scene = run.artifact("scene")
    solid = scene.opacities >= 0.5
    np.testing.assert_array_equal(recorded["/world/gaussians", "positions"][0], scene.means[solid])
    np.testing.assert_array_equal(recorded["/world/gaussians", "class_ids"][0], scene.instance_id[solid])


@needs_rerun
@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace to watch for connections")
def test_writing_a_recording_opens_no_connection(run, tmp_path):
    code = (
        "import sys; from pathlib import Path; from ss_flow.flows.results import open_finished\n"
        "from ss_flow.flows.view.rerun_file import write_recording\n"
        "write_recording(Path(sys.argv[1]), open_finished(sys.argv[2]))"
    )
    calls, file = tmp_path / "calls", tmp_path / "room.rrd"
    traced = ["strace", "-f", "-e", "trace=%network", "-o", calls, sys.executable, "-c", code, file, run.folder]
    done = subprocess.run(traced, capture_output=True, text=True)
    if not file.exists():
        pytest.skip(f"strace cannot watch here: {done.stderr[-200:]}")
    assert not [line for line in calls.read_text().splitlines() if "AF_INET" in line]


def test_without_rerun_one_sentence_says_what_to_install(monkeypatch, tmp_path: Path):
    monkeypatch.setattr(rerun_file, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'ss-flow\[rerun\]'"):
        rerun_file.write_recording(tmp_path / "it.rrd", None)
