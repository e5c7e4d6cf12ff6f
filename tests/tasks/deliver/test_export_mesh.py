"""Surfaces of instances, and their files."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from made_gaussians import made_cameras

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver.export.mesh import TriangleMesh, mesh
from ss_flow.tasks.deliver.export.mesh_files import mesh_glb, mesh_obj, mesh_ply
from ss_flow.tasks.gaussians.initialise import SH_ZERO, select
from ss_flow.tasks.geometry.open3d import load_open3d

RADIUS = 0.7
RED = (0.9, 0.2, 0.1)


def ball(count: int = 6000) -> Gaussians:
    """Flat Gaussians on a sphere, facing outwards, opaque and red; instance 3."""
    rows = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * rows / count), np.pi * (1 + 5**0.5) * rows
    normals = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    # The rotation from z to the normal.
    q = np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)])
    flat = np.log(RADIUS * np.array([0.035, 0.035, 0.002]))
    return Gaussians(
        means=(RADIUS * normals).astype(np.float32),
        quaternions=(q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32),
        log_scales=np.tile(flat, (count, 1)).astype(np.float32),
        opacity_logits=np.full(count, 5.0, np.float32),
        sh=np.tile((np.array(RED) - 0.5) / SH_ZERO, (count, 1, 1)).astype(np.float32),
        instance_id=np.full(count, 3, np.int32),
        instance_conf=np.ones(count, np.float32),
        part_id=np.zeros(count, np.int32),
    )


ROUND = made_cameras(
    (*((3 * np.cos(a), 3 * np.sin(a), z) for z in (-1.5, 1.5) for a in range(6)), (0, 0.3, 3), (0, 0.3, -3))
)
FROM_ABOVE = made_cameras(tuple((2 * np.cos(a), 2 * np.sin(a), 2.5) for a in np.arange(6) + 0.1))


@pytest.fixture(scope="module")
def whole() -> TriangleMesh:
    return mesh.function(ball(), ROUND, instance_id=3, holes="open")


def test_the_surface_of_a_ball_is_a_ball_of_its_colour(whole):
    distance = np.linalg.norm(whole.vertices, axis=1)
    assert np.abs(distance - RADIUS).mean() < 0.01 * 2 * RADIUS
    assert np.abs(whole.colors / 255 - RED).mean() < 0.02
    corners = whole.vertices[whole.triangles].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = (normals * corners.mean(axis=1)).sum(axis=1) > 0
    assert outwards.mean() > 0.98
    area = np.linalg.norm(normals, axis=1).sum() / 2
    assert area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.06)


def test_what_no_view_shows_is_open_or_closed_as_asked():
    seen = mesh.function(ball(), FROM_ABOVE, instance_id=3, holes="open")
    solid = mesh.function(ball(), FROM_ABOVE, instance_id=3, holes="closed")
    assert not seen.watertight and solid.watertight
    edges = np.sort(solid.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    corners = solid.vertices[solid.triangles].astype(float)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    ball_volume = 4 / 3 * np.pi * RADIUS**3
    assert ball_volume * 0.95 < volume < ball_volume * 1.5  # it holds the ball, and little of the shadow below it


@pytest.mark.parametrize(("length", "stays"), [(0.6, True), (0.2, False)])
def test_a_long_piece_of_few_triangles_stays_and_a_crumb_goes(length, stays):
    cap, leg = (
        select(ball(), rows) for rows in (np.arange(2000), np.arange(2000, 2060))
    )  # its upper third, a leg below
    places = np.random.default_rng(0).uniform((-0.03, -0.03, -0.5), (0.03, 0.03, -0.5 + length), (60, 3))
    both = replace(cap, **{n: np.concatenate([getattr(cap, n), getattr(leg, n)]) for n in cap.__dataclass_fields__})
    both.means[2000:] = places
    both.log_scales[2000:] = np.log(0.02)
    found = mesh.function(both, ROUND, instance_id=3, holes="open")
    low = found.vertices[:, 2] < -0.5 + length
    assert low.any() == stays and (~low).mean() > 0.5
    if stays:
        assert np.bincount(low[found.triangles[:, 0]])[1] < 0.2 * len(found.triangles)


def test_the_same_gaussians_give_the_same_mesh():
    few = select(ball(), np.arange(3000))
    first, second = (mesh.function(few, FROM_ABOVE, instance_id=3, holes="closed") for _ in range(2))
    for name in ("vertices", "colors", "triangles"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("holes", ["open", "closed"])
@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.filterwarnings("ignore:instance 3")
def test_no_and_one_gaussian_make_no_fault(count, holes):
    one = mesh.function(select(ball(), np.arange(count)), FROM_ABOVE, instance_id=3, holes=holes)
    assert one.instance_id == 3 and one.triangles.max(initial=-1) < max(len(one.vertices), 1)
    if count == 0:
        assert len(one.triangles) == 0
    mesh_ply(one), mesh_obj(one, name="a"), mesh_glb((one,), ROUND, names={})


def test_an_instance_behind_all_views_is_empty_and_said_to_be():
    away = made_cameras(((0, -3.0, 0),))
    away.world_to_camera[0] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ away.world_to_camera[0]
    with pytest.warns(UserWarning, match="no Gaussian that an input view sees"):
        assert not len(mesh.function(ball(100), away, instance_id=3, holes="open").triangles)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_open3d_reads_back_what_was_written(whole, tmp_path, suffix):
    content = mesh_ply(whole) if suffix == ".ply" else mesh_obj(whole, name="ball")
    file = tmp_path / f"a{suffix}"
    file.write_bytes(content.content.tobytes())
    read = load_open3d().io.read_triangle_mesh(str(file))
    rows = np.asarray(read.triangles)  # the OBJ reader numbers vertices anew
    np.testing.assert_allclose(np.asarray(read.vertices)[rows], whole.vertices[whole.triangles], atol=1e-6)
    np.testing.assert_allclose(np.asarray(read.vertex_colors)[rows], whole.colors[whole.triangles] / 255, atol=1e-3)


def test_a_name_is_one_line_of_an_obj(whole):
    lines = bytes(mesh_obj(whole, name="red\n  mug \\").content).decode().splitlines()
    assert lines[0] == "o red mug " and lines[1].startswith("v ")


def test_trimesh_reads_back_the_scene_with_an_object_a_node(whole, tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not here")
    (tmp_path / "a.glb").write_bytes(mesh_glb((whole,), ROUND, names={"3": "red ball"}).content.tobytes())
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    (node,) = scene.graph.nodes_geometry
    assert node == "red ball"
    found = scene.geometry[scene.graph[node][1]]
    np.testing.assert_array_equal(found.vertices.astype(np.float32), whole.vertices)
    np.testing.assert_array_equal(found.faces, whole.triangles)
    assert found.is_watertight == whole.watertight


def test_a_scene_of_meshes_names_its_nodes_and_their_instances(whole):
    data = mesh_glb(
        (whole, TriangleMesh(9, *(np.zeros((0, 3), k) for k in ("f4", "u1", "i4")), False)), ROUND, names={}
    )
    (size,) = struct.unpack_from("<I", data.content.tobytes(), 12)
    document = json.loads(data.content.tobytes()[20 : 20 + size])
    assert [node["name"] for node in document["nodes"]] == ["scene", "object 3"]
    assert document["nodes"][1]["extras"] == {"instance_id": 3}
    assert [mesh["name"] for mesh in document["meshes"]] == ["object 3"]
