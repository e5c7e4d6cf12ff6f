"""PLY files of Gaussians from elsewhere: every value as it is in the file, and one sentence for what is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_gaussians import made_gaussians

from ss_flow.errors import InputError
from ss_flow.tasks.deliver.ply import write_gaussians
from ss_flow.tasks.gaussians.read_ply import read_columns, read_gaussians

NEEDED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")


def write_columns(file: Path, columns: dict[str, np.ndarray], first: str = "element vertex {n}") -> Path:
    """A PLY file of these columns, in this order, of whatever scalar types they have."""
    kinds = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<i4": "int"}
    count = len(next(iter(columns.values())))
    rows = np.zeros(count, [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    properties = [f"property {kinds[values.dtype.str]} {name}" for name, values in columns.items()]
    head = ["ply", "format binary_little_endian 1.0", first.format(n=count), *properties, "end_header", ""]
    file.write_bytes("\n".join(head).encode() + rows.tobytes())
    return file


def columns_of(count: int, rest: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    names = (*NEEDED, *(f"f_rest_{i}" for i in range(rest)), *ROTATION)
    return {name: rng.normal(size=count).astype(np.float32) for name in names}


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None)
@given(count=st.integers(0, 30), rest=st.sampled_from([0, 9, 24, 45]), extra=st.booleans(), seed=st.integers(0, 9))
def test_every_value_is_that_of_the_file_whatever_stands_beside_it(tmp_path, count, rest, extra, seed):
    columns = columns_of(count, rest, seed)
    beside = {
        "nx": np.zeros(count, np.float32),
        "segment": np.ones(count, np.int32),
        "red": np.ones(count, np.uint8),
        "filter_3D": np.ones(count),
    }
    file = write_columns(tmp_path / "a.ply", {**(beside if extra else {}), **columns})
    read = read_gaussians(file)
    np.testing.assert_array_equal(read.means, np.stack([columns[n] for n in "xyz"], axis=1).reshape(-1, 3))
    np.testing.assert_array_equal(read.quaternions, np.stack([columns[n] for n in ROTATION], axis=1))
    np.testing.assert_array_equal(read.opacity_logits, columns["opacity"])
    assert read.sh.shape == (count, 1 + rest // 3, 3)
    for channel in range(3):
        for i in range(rest // 3):
            np.testing.assert_array_equal(read.sh[:, 1 + i, channel], columns[f"f_rest_{channel * rest // 3 + i}"])
    assert not read.instance_id.any() and not read.instance_conf.any()


def test_a_scene_that_is_read_and_written_again_has_the_same_bytes(tmp_path):
    made = made_gaussians(50, 3)
    write_gaussians(tmp_path / "a.ply", replace(made, quaternions=made.quaternions * np.float32(3.7)))
    write_gaussians(tmp_path / "b.ply", read_gaussians(tmp_path / "a.ply"))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_quaternions_have_unit_length_where_they_are_asked_for_so():
    made = made_gaussians(50, 0)
    np.testing.assert_array_equal(made.unit_quaternions, made.quaternions)
    longer = replace(made, quaternions=made.quaternions * np.float32(3.7))
    np.testing.assert_allclose(longer.unit_quaternions, made.quaternions, atol=1e-6)


@pytest.mark.parametrize(
    ("drop", "complaint"),
    [
        (("scale_2",), "flat Gaussians"),
        (("opacity", "rot_3"), "lacks opacity, rot_3"),
        (("f_rest_0",), "8 f_rest columns"),
    ],
)
def test_columns_that_are_missing_are_named(tmp_path, drop, complaint):
    columns = {name: values for name, values in columns_of(3, 9, 0).items() if name not in drop}
    with pytest.raises(InputError, match=rf"a\.ply.*{complaint}"):
        read_gaussians(write_columns(tmp_path / "a.ply", columns))


def with_mode(file: Path, mode: str) -> Path:
    write_gaussians(file, made_gaussians(3, 0))
    file.write_bytes(file.read_bytes().replace(b"SplatRenderMode: default", b"SplatRenderMode: " + mode.encode()))
    return file


def test_a_scene_that_was_trained_with_anti_aliasing_is_read_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"a\.ply was trained with anti-aliasing .* written as plain 3DGS"):
        assert len(read_gaussians(with_mode(tmp_path / "a.ply", "mip"))) == 3


def test_a_scene_of_plain_gaussians_is_read_without_one(tmp_path, recwarn):
    read_gaussians(with_mode(tmp_path / "a.ply", "default"))
    assert not recwarn.list


def test_a_scene_whose_header_says_that_it_is_flat_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"a\.ply holds flat Gaussians \(2DGS: SplatRenderMode\)"):
        read_gaussians(with_mode(tmp_path / "a.ply", "2dgs"))


def test_harmonics_under_other_names_are_named(tmp_path):
    columns = columns_of(3, 9, 0)
    columns["f_rest_20"] = columns.pop("f_rest_4")
    with pytest.raises(InputError, match="lacks f_rest_4"):
        read_gaussians(write_columns(tmp_path / "a.ply", columns))


def test_a_compressed_file_is_refused_with_the_way_out(tmp_path):
    file = write_columns(tmp_path / "a.ply", columns_of(3, 0, 0), first="element chunk {n}")
    with pytest.raises(InputError, match=r"compressed PLY; unpack it first: `splat-transform a\.ply"):
        read_columns(file)


def test_a_column_that_comes_twice_is_refused(tmp_path):
    file = write_columns(tmp_path / "a.ply", columns_of(3, 0, 0))
    file.write_bytes(file.read_bytes().replace(b"property float y\n", b"property float x\n"))
    with pytest.raises(InputError, match="two columns of one name"):
        read_columns(file)
