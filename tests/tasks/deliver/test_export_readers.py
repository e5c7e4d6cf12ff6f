"""Exports read by programs of others; each test needs its reader, and says which is not here.

`npm install @playcanvas/splat-transform @spz-loader/core gltf-validator` in a folder, and that folder in
SS_FLOW_TEST_NPM, bring the ones in JavaScript; `pip install trimesh usd-core` those in Python.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_gaussians import made_cameras, made_gaussians

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver.export.compressed_ply import compressed_ply
from ss_flow.tasks.deliver.export.content import morton_order
from ss_flow.tasks.deliver.export.gaussian_ply import gaussian_ply
from ss_flow.tasks.deliver.export.gltf import gltf
from ss_flow.tasks.deliver.export.sog import sog
from ss_flow.tasks.deliver.export.splat import splat
from ss_flow.tasks.deliver.export.spz import spz
from ss_flow.tasks.deliver.export.usda import usda
from ss_flow.tasks.gaussians.read_ply import read_gaussians
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of

NPM = Path(os.environ.get("SS_FLOW_TEST_NPM", "none")) / "node_modules"
_VALIDATE = """
const { validateBytes } = await import(process.argv[1]);
const { readFileSync } = await import('fs');
console.log(JSON.stringify(await validateBytes(new Uint8Array(readFileSync(process.argv[2])))));
"""
_LOAD_SPZ = """
process.type = 'renderer';  // else the package looks for a part of Node that its bundler left out
const { loadSpz } = await import(process.argv[1]);
const { readFileSync, writeFileSync } = await import('fs');
const cloud = await loadSpz(new Uint8Array(readFileSync(process.argv[2])));
const columns = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'].map((name) => cloud[name]);
for (const column of columns) writeFileSync(process.argv[3], Buffer.from(column.buffer), { flag: 'a' });
console.log(JSON.stringify(columns.map((column) => column.length)));
"""


def needs(package: str) -> Path:
    folder = NPM / package
    if shutil.which("node") is None or not folder.is_dir():
        pytest.skip(f"node with {package} is not here (SS_FLOW_TEST_NPM)")
    return folder


def through_splat_transform(data: bytes, folder: Path, suffix: str) -> Gaussians:
    """The Gaussians of a file as splat-transform reads them."""
    tool = needs("@playcanvas/splat-transform")
    file, back = folder / f"scene{suffix}", folder / "back.ply"
    file.write_bytes(data)
    subprocess.run(["node", tool / "bin/cli.mjs", "-q", "-w", file, back], check=True, capture_output=True)
    read = read_gaussians(back)
    return replace(read, opacity_logits=read.opacity_logits.clip(-20, 20))  # an opacity of 1 reads as infinite


def gltf_issues(data: bytes, folder: Path) -> list[dict]:
    tool = needs("gltf-validator")
    (folder / "a.glb").write_bytes(data)
    command = ["node", "--input-type=module", "-e", _VALIDATE, tool / "index.js", folder / "a.glb"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)["issues"]["messages"]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(
    ("write", "suffix", "decibels"),
    [
        (lambda g: gaussian_ply(g, labelled=False), ".ply", 100),
        (compressed_ply, ".compressed.ply", 38),
        (spz, ".spz", 33),
        (splat, ".splat", 38),
        (sog, ".sog", 36),
    ],
    ids=["ply", "compressed-ply", "spz", "splat", "sog"],
)
def test_a_rendering_of_what_was_read_is_that_of_what_was_written(tmp_path, write, suffix, decibels, degree):
    made = made_gaussians(3000, degree)
    read = through_splat_transform(write(made).content.tobytes(), tmp_path, suffix)
    assert len(read) == 3000
    if suffix == ".splat":
        made = replace(made, sh=made.sh[:, :1])
    camera = camera_of(made_cameras(), 0)
    ours, theirs = (render(g, camera).rgb.clip(0, 1) for g in (made, read))
    assert -10 * np.log10(np.square(ours - theirs).mean() + 1e-12) > decibels


@pytest.mark.parametrize("count", [1, 100_000])
@pytest.mark.parametrize(
    ("write", "suffix", "decibels"),
    [
        (lambda g: gaussian_ply(g, labelled=False), ".ply", 100),
        (compressed_ply, ".compressed.ply", 40),
        (spz, ".spz", 36),
        (splat, ".splat", 50),
        (sog, ".sog", 40),
    ],
    ids=["ply", "compressed-ply", "spz", "splat", "sog"],
)
def test_one_gaussian_and_a_hundred_thousand_are_read(tmp_path, write, suffix, decibels, count):
    made = made_gaussians(count, 0)
    read = through_splat_transform(write(made).content.tobytes(), tmp_path, suffix)
    assert len(read) == count
    camera = camera_of(made_cameras(), 0)
    ours, theirs = (render(g, camera).rgb.clip(0, 1) for g in (made, read))
    assert -10 * np.log10(np.square(ours - theirs).mean() + 1e-12) > decibels


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (700, 1), (700, 2), (700, 3), (100_000, 0)])
def test_spz_loader_reads_every_number_within_its_step(tmp_path, count, degree):
    tool = needs("@spz-loader/core")
    made = made_gaussians(count, degree)
    (tmp_path / "a.spz").write_bytes(spz(made).content.tobytes())
    command = ["node", "--input-type=module", "-e", _LOAD_SPZ, tool / "dist/index.js", tmp_path / "a.spz"]
    lengths = json.loads(subprocess.run([*command, tmp_path / "raw"], check=True, capture_output=True).stdout)
    read = np.split(np.fromfile(tmp_path / "raw", np.float32), np.cumsum(lengths)[:-1])
    positions, scales, rotations, alphas, colors, sh = (column.reshape(count, -1) for column in read)
    axes = np.array([1, -1, -1])  # the file's are right, up, back
    np.testing.assert_allclose(positions * axes, made.means, atol=2**-12)
    np.testing.assert_allclose(np.log(scales), made.log_scales, atol=1 / 32 + 1e-4)
    np.testing.assert_allclose(alphas[:, 0], made.opacities, atol=0.5 / 255 + 1e-4)
    # The angle between the two rotations; the file's order is x y z w.
    turned = rotations[:, [3, 0, 1, 2]] * np.array([1, 1, -1, -1])
    cosine = np.abs((turned * made.quaternions).sum(axis=1))
    assert cosine.min() > np.cos(0.004)
    base = 0.5 + 0.28209479177387814 * made.sh[:, 0]
    assert np.abs(colors - base).max() < 0.28209479177387814 / 0.15 * 0.5 / 255 + 1e-4
    assert sh.shape[1] == 3 * ((degree + 1) ** 2 - 1)


@pytest.mark.parametrize("count", [1, 3, 17])
def test_sog_of_few_gaussians_is_read_too(tmp_path, count):
    made = made_gaussians(count, 3)
    read = through_splat_transform(sog(made).content.tobytes(), tmp_path, ".sog")
    order = morton_order(made.means)
    np.testing.assert_allclose(read.means, made.means[order], atol=1e-4)
    np.testing.assert_allclose(read.log_scales, made.log_scales[order], atol=1e-6)
    np.testing.assert_allclose(read.sh, made.sh[order], atol=0.02)


def test_labels_survive_in_the_labelled_ply(tmp_path):
    made = made_gaussians(300, 1)
    read = through_splat_transform(gaussian_ply(made, labelled=True).content.tobytes(), tmp_path, ".ply")
    np.testing.assert_array_equal(read.instance_id, made.instance_id)
    np.testing.assert_array_equal(read.part_id, made.part_id)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_the_gltf_validator_finds_nothing_but_an_extension_that_it_does_not_know(tmp_path, count):
    made = made_gaussians(count, 3)
    issues = gltf_issues(gltf(made, made_cameras(), names={}).content.tobytes(), tmp_path)
    faults = [issue for issue in issues if issue["severity"] < 2]  # errors and warnings
    assert [issue for issue in faults if issue["code"] != "MESH_PRIMITIVE_INVALID_ATTRIBUTE"] == []
    assert all("/attributes/KHR_gaussian_splatting:" in issue["pointer"] for issue in faults)


def test_openusd_reads_every_instance_with_its_numbers(tmp_path):
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is not here")
    made = made_gaussians(60, 2)
    (tmp_path / "a.usda").write_bytes(usda(made, made_cameras(), names={"3": "green box"}).content.tobytes())
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    prims = [p for p in stage.Traverse() if p.GetTypeName() == "ParticleField3DGaussianSplat"]
    assert [p.GetCustomDataByKey("instance_id") for p in prims] == [0, 1, 2, 3]
    assert prims[3].GetDisplayName() == "green box"
    own = made.instance_id == 3

    def read(name: str) -> np.ndarray:
        return np.array(prims[3].GetAttribute(name).Get(), np.float32)

    np.testing.assert_array_equal(read("positions"), made.means[own])
    np.testing.assert_allclose(np.log(read("scales")), made.log_scales[own], atol=1e-6)
    np.testing.assert_allclose(read("opacities"), made.opacities[own], rtol=1e-6)
    np.testing.assert_array_equal(read("radiance:sphericalHarmonicsCoefficients"), made.sh[own].reshape(-1, 3))
    turns = prims[3].GetAttribute("orientations").Get()
    np.testing.assert_array_equal([[q.GetReal(), *q.GetImaginary()] for q in turns], made.quaternions[own])
