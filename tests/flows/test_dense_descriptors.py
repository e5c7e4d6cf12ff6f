"""Vectors of single Gaussians in a run: made on request, cached an instance at a time, written beside the PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from random_networks import dino_like
from tiny_runs import run_tiny

from ss_flow.tasks.artifacts import NO_VECTOR
from ss_flow.tasks.gaussians.read_ply import read_gaussians

ASKED = ("--set", "semantics.patches=auto", "--set", "semantics.dense.elevations=1", "--set", "semantics.dense.side=56")


@pytest.fixture
def dino(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "models/dinov2-small").mkdir(parents=True)
    dino_like(tmp_path / "models/dinov2-small/model.onnx", 384)
    monkeypatch.setenv("SS_FLOW_MODELS", str(tmp_path / "models"))


def test_a_run_describes_every_gaussian_of_its_instances_and_nothing_else_anew(warm, dino):
    assert not (warm.out / "descriptors.npz").exists()
    run = run_tiny(warm.scene, warm.store, *ASKED, out=warm.out)
    assert run.code == 0, run.err
    scene = read_gaussians(warm.out / "scene_labeled.ply")
    instances = len(set(scene.instance_id.tolist()) - {0})
    steps = {"apart": 1, "together": 1}
    expected = {f"semantics.dense_describe.{step}": count for step, count in steps.items()}
    assert run.computed() == expected | {"semantics.dense_describe": instances}
    assert run.document()["models"]["patches"] == "dinov2-small"
    with np.load(warm.out / "descriptors.npz") as vectors:
        np.testing.assert_array_equal(vectors["instance_id"], scene.instance_id)
        np.testing.assert_array_equal(vectors["origin"] == NO_VECTOR, scene.instance_id == 0)
        assert vectors["features"].shape == (len(scene), 384)
    assert (warm.out / "descriptors.png").is_file()
    assert run_tiny(warm.scene, warm.store, *ASKED, out=warm.out).computed() == {}


def test_without_a_network_they_are_refused_with_one_sentence(warm):
    refused = run_tiny(warm.scene, warm.store, *ASKED, out=warm.out)
    assert refused.code == 2 and "run `ss-flow models fetch dinov2-small`" in refused.err
