import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from clouds import even_cloud
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Gaussians, PointCloud, PointLabels, PointParts
from ss_flow.tasks.deliver.ply import write_cloud, write_gaussians
from ss_flow.tasks.gaussians.read_ply import read_columns, read_gaussians


def gaussians_of(n: int, degree: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    return Gaussians(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        quaternions=(q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32),
        log_scales=rng.normal(size=(n, 3)).astype(np.float32),
        opacity_logits=rng.normal(size=n).astype(np.float32),
        sh=rng.normal(size=(n, (degree + 1) ** 2, 3)).astype(np.float32),
        instance_id=rng.integers(0, 1 << 24, n).astype(np.int32),
        instance_conf=rng.random(n).astype(np.float32),
        part_id=rng.integers(0, 9, n).astype(np.int32),
    )


def header_of(path: Path) -> list[str]:
    return path.read_bytes().split(b"end_header\n")[0].decode("ascii").split("\n")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None)
@given(n=st.integers(0, 40), degree=st.integers(0, 3), seed=st.integers(0, 9))
def test_labelled_gaussians_read_back_equal(tmp_path: Path, n, degree, seed):
    written = gaussians_of(n, degree, seed)
    write_gaussians(tmp_path / "a.ply", written, labelled=True)
    read = read_gaussians(tmp_path / "a.ply")
    for field in fields(Gaussians):
        expected = getattr(written, field.name)
        found = getattr(read, field.name)
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == expected.dtype


def test_a_standard_row_is_62_floats_in_the_order_that_viewers_expect(tmp_path: Path):
    one = gaussians_of(1, 3)
    write_gaussians(tmp_path / "a.ply", one)
    data = (tmp_path / "a.ply").read_bytes()
    row = np.frombuffer(data[data.index(b"end_header\n") + 11 :], "<f4")
    assert len(row) == 62
    np.testing.assert_array_equal(row[:3], one.means[0])
    assert not row[3:6].any()
    np.testing.assert_array_equal(row[6:9], one.sh[0, 0])
    np.testing.assert_array_equal(row[9:24], one.sh[0, 1:, 0])
    np.testing.assert_array_equal(row[24:39], one.sh[0, 1:, 1])
    np.testing.assert_array_equal(row[39:54], one.sh[0, 1:, 2])
    assert row[54] == one.opacity_logits[0]
    np.testing.assert_array_equal(row[55:58], one.log_scales[0])
    np.testing.assert_array_equal(row[58:62], one.quaternions[0])


@pytest.mark.parametrize(("degree", "columns"), [(0, 17), (1, 26), (2, 41), (3, 62)])
def test_no_column_is_written_above_the_degree_of_the_colours(tmp_path: Path, degree, columns):
    some = gaussians_of(3, degree)
    write_gaussians(tmp_path / "a.ply", some)
    rows = read_columns(tmp_path / "a.ply")
    names = rows.dtype.names
    assert len(names) == columns
    rest = [name for name in names if name.startswith("f_rest_")]
    assert rest == [f"f_rest_{i}" for i in range(columns - 17)]
    assert (*names[:9], *rest, *names[-8:]) == names and names[8] == "f_dc_2" and names[-8] == "opacity"
    if degree:
        found = np.stack([rows[name] for name in rest], axis=1).reshape(3, 3, -1)
        np.testing.assert_array_equal(found, some.sh[:, 1:].transpose(0, 2, 1))


def test_the_header_is_what_viewers_read(tmp_path: Path):
    write_gaussians(tmp_path / "a.ply", gaussians_of(5, 0))
    lines = header_of(tmp_path / "a.ply")
    assert lines[:4] == [
        "ply",
        "format binary_little_endian 1.0",
        "comment SplatRenderMode: default",
        "element vertex 5",
    ]
    assert lines[4] == "property float x" and lines[-2] == "property float rot_3"
    assert all(line.startswith("property float ") for line in lines[4:-1]) and len(lines) == 4 + 17 + 1


def test_the_labelled_rows_are_the_standard_rows_and_three_columns(tmp_path: Path):
    some = gaussians_of(9, 2)
    write_gaussians(tmp_path / "a.ply", some)
    write_gaussians(tmp_path / "b.ply", some, labelled=True)
    plain, labelled = read_columns(tmp_path / "a.ply"), read_columns(tmp_path / "b.ply")
    assert labelled.dtype.names == (*plain.dtype.names, "instance_id", "instance_conf", "part_id")
    for name in plain.dtype.names:
        np.testing.assert_array_equal(labelled[name], plain[name])


def test_more_rows_than_a_block_are_all_written(tmp_path: Path):
    many = gaussians_of(70_000, 0)
    write_gaussians(tmp_path / "a.ply", many, labelled=True)
    np.testing.assert_array_equal(read_gaussians(tmp_path / "a.ply").instance_id, many.instance_id)


def test_writing_takes_little_memory_beside_the_scene(tmp_path: Path):
    many = gaussians_of(300_000, 0)
    tracemalloc.start()
    write_gaussians(tmp_path / "a.ply", many)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < (tmp_path / "a.ply").stat().st_size * 0.7


def cloud_of(n: int) -> tuple[PointCloud, PointLabels, PointParts]:
    rng = np.random.default_rng(1)
    nothing = np.zeros(0, np.int32)
    points, colors = rng.normal(size=(n, 3)).astype(np.float32), rng.integers(0, 256, (n, 3), np.uint8)
    labels = rng.integers(0, 300, n).astype(np.int32)
    return (
        even_cloud(points, colors, 1.0, 0.02),
        PointLabels(labels, rng.random(n).astype(np.float32), 300, nothing, nothing, nothing),
        PointParts(rng.integers(0, 5, n).astype(np.int32)),
    )


def test_labelled_points_read_back_equal(tmp_path: Path):
    cloud, labels, parts = cloud_of(1000)
    write_cloud(tmp_path / "c.ply", cloud, labels, parts)
    rows = read_columns(tmp_path / "c.ply")
    np.testing.assert_array_equal(np.stack([rows[a] for a in "xyz"], axis=1), cloud.points)
    np.testing.assert_array_equal(np.stack([rows[c] for c in ("red", "green", "blue")], axis=1), cloud.colors)
    np.testing.assert_array_equal(rows["instance_id"], labels.label)
    np.testing.assert_array_equal(rows["instance_conf"], labels.confidence)
    np.testing.assert_array_equal(rows["part_id"], parts.part)
    assert [line for line in header_of(tmp_path / "c.ply") if "property" in line] == [
        *(f"property float {a}" for a in "xyz"),
        *(f"property uchar {c}" for c in ("red", "green", "blue")),
        *(f"property float {c}" for c in ("instance_id", "instance_conf", "part_id")),
    ]


def test_open3d_reads_the_points(tmp_path: Path):
    from ss_flow.tasks.geometry.open3d import load_open3d

    cloud, labels, parts = cloud_of(50)
    write_cloud(tmp_path / "c.ply", cloud, labels, parts)
    read = load_open3d().t.io.read_point_cloud(str(tmp_path / "c.ply"))
    np.testing.assert_array_equal(read.point.positions.numpy(), cloud.points)
    np.testing.assert_array_equal(read.point.instance_id.numpy()[:, 0], labels.label)


def test_points_and_labels_of_different_length_are_an_error(tmp_path: Path):
    cloud, labels, parts = cloud_of(5)
    with pytest.raises(ValueError, match="5 points but 4 labels"):
        write_cloud(tmp_path / "c.ply", cloud, replace(labels, label=labels.label[:4]), parts)


@pytest.mark.parametrize("cut", [1, 68])
def test_a_file_cut_short_is_refused(tmp_path: Path, cut):
    path = tmp_path / "a.ply"
    write_gaussians(path, gaussians_of(3, 0))
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(InputError, match=r"a\.ply has .* bytes and its header promises"):
        read_columns(path)


@pytest.mark.parametrize(
    "content, complaint",
    [
        (b"", "not a PLY file"),
        (b"solid cube", "not a PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "binary_little_endian"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 0\nend_header\n", "element vertex"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty list uchar int i\nend_header\n",
            "property list uchar int i",
        ),
    ],
)
def test_other_files_are_refused_by_name(tmp_path: Path, content, complaint):
    (tmp_path / "odd.ply").write_bytes(content)
    with pytest.raises(InputError, match=rf"odd\.ply.*{complaint}"):
        read_columns(tmp_path / "odd.ply")


def test_points_are_not_taken_for_gaussians(tmp_path: Path):
    cloud, labels, parts = cloud_of(5)
    write_cloud(tmp_path / "c.ply", cloud, labels, parts)
    with pytest.raises(InputError, match=r"c\.ply lacks f_dc_0"):
        read_gaussians(tmp_path / "c.ply")
