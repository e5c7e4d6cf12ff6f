"""`ss-flow run CAPTURE --scene splat.ply`: a scene that was trained elsewhere gets labels and stays as it is."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_gaussians import made_gaussians
from scipy.spatial import cKDTree
from tiny_runs import run_tiny, ss_flow

from ss_flow.cache.store import Store
from ss_flow.flows.depths import depth_source
from ss_flow.flows.params import CaptureParams
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.deliver.ply import write_gaussians
from ss_flow.tasks.gaussians.initialise import initialise, laid_flat, with_sh_degree
from ss_flow.tasks.gaussians.read_ply import read_columns, read_gaussians

GIVEN_STEPS = {"capture.given_scene", "splat.vote", "splat.label"}
LABELS = ["instance_id", "instance_conf", "part_id"]


@pytest.fixture(scope="module")
def splat(tiny, tmp_path_factory) -> Path:
    """A scene that another trainer might have written: of the true surface, with quaternions of any length."""
    points = read_columns(tiny.out / "cloud_labeled.ply")
    places, colors = (np.stack([points[name] for name in names], axis=1) for names in ("xyz", ("red", "green", "blue")))
    made = laid_flat(with_sh_degree(initialise(places, colors, 0, 0.0, opacity=0.95), 2), 0.1)
    rng = np.random.default_rng(0)
    length = rng.uniform(0.2, 5, (len(made), 1)).astype(np.float32)
    file = tmp_path_factory.mktemp("splat") / "point_cloud.ply"
    write_gaussians(file, replace(made, quaternions=made.quaternions * length))
    return file


@pytest.fixture(scope="module")
def labelled(tiny, splat, tmp_path_factory):
    """The tiny run's store and its capture, labelled: the call, the store, the output folder."""
    base = tmp_path_factory.mktemp("labelled")
    shutil.copytree(tiny.store, base / "store")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SS_FLOW_MODELS", "")
        called = run_tiny(tiny.scene, base / "store", "--scene", splat, out=base / "out")
    assert called.code == 0, called.err
    return called, base / "store", base / "out"


def test_the_folder_is_that_of_a_run_and_every_value_of_the_given_scene_is_in_it(tiny, splat, labelled):
    *_, out = labelled
    assert sorted(p.name for p in out.iterdir()) == sorted(p.name for p in tiny.out.iterdir())
    given, scene = read_columns(splat), read_columns(out / "scene.ply")
    assert given.dtype == scene.dtype
    assert given.tobytes() == scene.tobytes()
    rows = read_columns(out / "scene_labeled.ply")
    assert list(rows.dtype.names) == [*given.dtype.names, *LABELS]
    assert rows[list(given.dtype.names)].tolist() == given.tolist()


@pytest.mark.parametrize(
    ("given", "sensor", "source"),
    [(True, True, "sensor"), (True, False, "rendered"), (False, True, "sensor"), (False, False, "mvs")],
)
def test_depth_is_the_sensors_where_there_is_one_then_the_given_scenes(given, sensor, source):
    scene = SceneFiles("scannet", Path(), given_scene=Path("a.ply") if given else None, depths=() if sensor else None)
    assert depth_source(scene, CaptureParams()) == source


def test_nothing_is_trained(labelled):
    called, *_ = labelled
    steps = {node["step"] for node in called.document()["nodes"]}
    assert steps >= GIVEN_STEPS
    assert not steps & {"splat.reconstruct", "splat.retrain", "splat.merge_pair", "splat.global_pass"}


def test_depth_of_the_given_scene_gives_the_dense_points(tiny, splat, labelled, tmp_path):
    rendered = ("--set", "capture.depth=rendered", "--until", "dense")
    called = run_tiny(tiny.scene, labelled[1], "--scene", splat, *rendered, out=tmp_path / "out")
    assert called.code == 0, called.err
    steps = {node["step"] for node in called.document()["nodes"]}
    assert steps >= {"capture.rendered_depth", "capture.agree"} and not steps & {
        "capture.sensor_depth",
        "capture.sweep",
    }
    points = Store(labelled[1]).get(called.results()["dense"]).points
    true = np.stack([read_columns(tiny.out / "cloud_labeled.ply")[name] for name in "xyz"], axis=1)
    away, _ = cKDTree(true).query(points)
    # These discs are wide, so that those in front reach over what lies behind them.
    width = float(np.median(np.exp(read_gaussians(splat).log_scales.max(axis=1))))
    assert len(points) > 500 and np.median(away) < 2 * width


def test_the_objects_keep_their_pixels(tiny, labelled):
    *_, out = labelled
    kept = []
    for name in sorted(p.name for p in (out / "masks").iterdir()):
        truth = cv2.imread(str(tiny.scene / "instance" / name), cv2.IMREAD_UNCHANGED)
        ids = cv2.imread(str(out / "masks" / name), cv2.IMREAD_UNCHANGED)
        for number in np.unique(truth[truth > 0]):
            own, count = np.unique(ids[truth == number], return_counts=True)
            kept.append(count.max() / count.sum() if own[count.argmax()] else 0)
    assert np.mean(kept) > 0.8
    scene = read_gaussians(out / "scene_labeled.ply")
    assert len(np.unique(scene.instance_id)) >= 4
    assert ((scene.instance_conf > 0).mean() > 0.5) and scene.instance_conf.max() <= 1


def test_a_second_run_computes_nothing_and_another_scene_only_what_depends_on_it(tiny, splat, labelled, tmp_path):
    store = labelled[1]
    again = run_tiny(tiny.scene, store, "--scene", splat, out=tmp_path / "again")
    assert again.computed() == {}
    other = read_gaussians(splat)
    other.opacity_logits[:] += 0.5
    write_gaussians(tmp_path / "other.ply", other)
    changed = run_tiny(tiny.scene, store, "--scene", tmp_path / "other.ply", out=tmp_path / "other")
    assert changed.code == 0
    assert not {"capture.ingest", "capture.cameras", "capture.ready_masks"} & set(changed.computed())
    assert set(changed.computed()) >= GIVEN_STEPS
    why = ss_flow("why", "splat.label", tiny.scene, "--cache", store)
    assert why.code == 0 and "given_scene" in why.out


def test_a_labelled_scene_is_searched_exported_edited_and_rendered(labelled, tmp_path):
    _, store, out = labelled
    entries = json.loads((out / "instances.json").read_text())["instances"]
    first = next(entry for entry in entries if entry["file"])
    assert ss_flow("query", out, first["name"], "--cache", store).code == 0
    exported = ss_flow(
        "export", out, "--format", "gltf", "--instance", str(first["id"]), "--out", tmp_path / "a.glb", "--cache", store
    )
    assert exported.code == 0, exported.err
    script = tmp_path / "script.json"
    script.write_text(json.dumps({"version": 1, "operations": [{"op": "remove", "instances": first["id"]}]}))
    edited = ss_flow("edit", out, script, "--out", tmp_path / "edited", "--cache", store)
    assert edited.code == 0, edited.err
    kept, before = read_columns(tmp_path / "edited/scene.ply"), read_columns(out / "scene_labeled.ply")
    rest = before[before["instance_id"] != first["id"]]
    assert kept.tolist() == rest[list(kept.dtype.names)].tolist()
    drawn = ss_flow("render", out, "--frames", "0", "--out", tmp_path / "pictures", "--cache", store)
    assert drawn.code == 0, drawn.err


def test_a_scene_in_another_frame_is_told_of_with_a_figure(tiny, splat, tmp_path):
    turned = read_gaussians(splat)
    turned.means[:] = turned.means[:, [0, 2, 1]] * np.float32([1, -1, 1])
    write_gaussians(tmp_path / "turned.ply", turned)
    called = run_tiny(tiny.scene, tmp_path / "store", "--scene", tmp_path / "turned.ply", "--until", "given_scene")
    (warning,) = [w["text"] for w in called.document()["warnings"] if "hardly looks like the photos" in w["text"]]
    assert "turned.ply" in warning and "median of" in warning


def test_a_scene_that_no_camera_sees_is_refused(tiny, splat, tmp_path):
    away = read_gaussians(splat)
    away.means[:] += np.float32([0, 0, 500])
    write_gaussians(tmp_path / "away.ply", away)
    called = run_tiny(tiny.scene, tmp_path / "store", "--scene", tmp_path / "away.ply")
    assert called.code == 2
    assert "none of the 5 cameras sees the scene of away.ply" in called.err


def test_what_is_no_scene_is_refused_before_anything_is_computed(tiny, tmp_path):
    file = tmp_path / "mesh.ply"
    file.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    for given, complaint in ((file, "binary_little_endian"), (tmp_path / "absent.ply", "cannot be read")):
        called = run_tiny(tiny.scene, tmp_path / "store", "--scene", given)
        assert called.code == 2 and complaint in called.err
    photos = run_tiny(tiny.scene / "color", tmp_path / "store", "--scene", tiny.out / "scene.ply")
    assert photos.code == 2 and "color has no poses" in photos.err
    rendered = run_tiny(tiny.scene, tmp_path / "store", "--set", "capture.depth=rendered")
    assert rendered.code == 2 and "give it --scene" in rendered.err


def test_a_file_without_gaussians_is_refused(tiny, tmp_path):
    write_gaussians(tmp_path / "none.ply", made_gaussians(0, 0))
    called = run_tiny(tiny.scene, tmp_path / "store", "--scene", tmp_path / "none.ply")
    assert called.code == 2 and "none.ply holds no Gaussians" in called.err
