"""The two ways to read an array, compared: our own for small ones, and Zarr's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ss_flow.cache import codec
from ss_flow.tasks.artifacts import Gaussians, LabelMap

KINDS = (np.float32, np.float64, np.int32, np.int64, np.uint8, np.uint16, np.bool_, np.dtype(">i4"))
ANY = st.sampled_from(KINDS).flatmap(
    lambda kind: hnp.arrays(kind, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
)


@given(ANY)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_small_array_reads_back_as_zarr_reads_it(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("codec") / "object"
    codec.write(LabelMap("x", content), folder)
    ours = codec.read(folder).ids
    theirs = np.asarray(zarr.open_group(store=folder, mode="r")["ids"][...])
    assert ours.shape == theirs.shape == content.shape
    assert ours.dtype == theirs.dtype == content.dtype.newbyteorder("=")
    np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(ours, content)


@pytest.mark.parametrize("count", [codec.PLAIN_BYTES // 2, codec.PLAIN_BYTES // 2 + 1, 3 * codec.CHUNK_BYTES])
def test_arrays_round_the_limits_of_plain_and_of_one_chunk_read_back(tmp_path, count):
    content = np.arange(count).astype(np.uint16)[:, None]
    codec.write(LabelMap("x", content), tmp_path / "object")
    np.testing.assert_array_equal(codec.read(tmp_path / "object").ids, content)


def test_a_small_object_is_read_without_zarr(tmp_path, monkeypatch):
    codec.write(LabelMap("x", np.eye(3, dtype=np.uint16)), tmp_path / "object")
    monkeypatch.setattr(codec, "_read_zarr", lambda folder: pytest.fail("read through Zarr"))
    assert codec.read(tmp_path / "object").ids.trace() == 3


def test_a_cut_chunk_is_a_fault_and_not_an_array(tmp_path):
    codec.write(LabelMap("x", np.eye(3, dtype=np.uint16)), tmp_path / "object")
    chunk = tmp_path / "object/ids/c/0/0"
    chunk.write_bytes(chunk.read_bytes()[:-2])
    with pytest.raises(ValueError, match="damaged"):
        codec.read(tmp_path / "object")


def test_a_folder_that_is_no_object_is_refused(tmp_path):
    (tmp_path / "zarr.json").write_text("{}")
    with pytest.raises(ValueError, match="not a stored object"):
        codec.read(tmp_path)


def test_an_object_that_names_a_foreign_type_is_refused(tmp_path):
    codec.write(LabelMap("x", np.eye(3, dtype=np.uint16)), tmp_path / "object")
    header = tmp_path / "object/zarr.json"
    header.write_text(header.read_text().replace("ss_flow.tasks.artifacts:LabelMap", "subprocess:Popen"))
    with pytest.raises(ValueError, match="foreign type"):
        codec.read(tmp_path / "object")


def test_what_is_not_a_dataclass_of_arrays_is_refused(tmp_path):
    @dataclass(frozen=True)
    class Holder:
        callback: object

    with pytest.raises(TypeError, match="only dataclasses"):
        codec.write({"a": 1}, tmp_path / "a")
    with pytest.raises(TypeError, match=r"Holder\.callback"):
        codec.write(Holder(print), tmp_path / "b")


def test_gaussians_of_no_rows_keep_their_shapes(tmp_path):
    empty = {
        n: np.zeros((0, *s), np.float32) for n, s in (("means", (3,)), ("quaternions", (4,)), ("log_scales", (3,)))
    }
    ids = {n: np.zeros(0, np.int32) for n in ("instance_id", "part_id")}
    rest = {n: np.zeros(0, np.float32) for n in ("opacity_logits", "instance_conf")}
    codec.write(Gaussians(**empty, **ids, **rest, sh=np.zeros((0, 16, 3), np.float32)), tmp_path / "object")
    assert codec.read(tmp_path / "object").sh.shape == (0, 16, 3)
