"""Our own ways to read arrays, compared with Zarr's."""

from __future__ import annotations

import enum
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import ss_flow_toy as toy
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from zarr.codecs import BloscCodec

from ss_flow.cache import codec
from ss_flow.cache.canonical import digest
from ss_flow.tasks.artifacts import Gaussians, LabelMap

KINDS = (*sorted(codec.DTYPES), ">i4", ">f8", ">c8")
ANY = st.sampled_from(KINDS).flatmap(
    lambda kind: hnp.arrays(np.dtype(kind), hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
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


def files_of(folder: Path) -> dict[str, object]:
    files = {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}
    return {name: json.loads(data) if name.endswith("json") else data for name, data in files.items()}


@given(
    st.sampled_from(KINDS),
    st.sampled_from([(20_001,), (300, 80), (90, 20, 13)]),
    st.booleans(),
    st.integers(3000, 70_000),
)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_large_array_is_written_as_zarr_writes_it(tmp_path_factory, kind, shape, by_columns, chunk_bytes):
    folder = tmp_path_factory.mktemp("codec")
    content = np.random.default_rng(0).integers(0, 4, shape).astype(kind, order="F" if by_columns else "C")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "CHUNK_BYTES", chunk_bytes)
        patch.setattr(codec, "PLAIN_BYTES", 0)
        codec.write(LabelMap("x", content), folder / "ours")
        theirs = zarr.create_array(
            folder / "theirs",
            shape=shape,
            dtype=content.dtype.newbyteorder("="),
            chunks=codec._chunks(content),
            compressors=BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"),
            fill_value=0,
            config={"write_empty_chunks": True},
        )
        theirs[...] = content
        np.testing.assert_array_equal(codec.read(folder / "ours").ids, content)
    assert files_of(folder / "ours/ids") == files_of(folder / "theirs")


@dataclass(frozen=True)
class Everything:
    """Fields of every kind that is stored."""

    numbers: np.ndarray
    offsets: np.ndarray
    """Rows of different lengths, one after the other: row i is numbers[offsets[i]:offsets[i + 1]]."""
    names: tuple[str, ...]
    table: dict[str, float]
    unit: float
    count: int
    flag: bool
    rows: tuple[tuple[int, ...], ...] = ((1, 2), (3,), ())
    nothing: None = None


texts = st.text(st.characters(exclude_categories=["Cs"]))


@given(
    st.lists(st.lists(st.floats(width=32), max_size=4), max_size=4),
    st.lists(texts, max_size=3),
    st.dictionaries(texts, st.floats()),
    st.floats(),
    st.integers(),
)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_ragged_rows_texts_and_tables_read_back_equal(tmp_path_factory, rows, names, table, unit, count):
    value = Everything(
        np.array([x for row in rows for x in row], np.float32),
        np.cumsum([0, *map(len, rows)]),
        tuple(names),
        table,
        unit,
        count,
        count > 0,
    )
    folder = tmp_path_factory.mktemp("codec") / "object"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "type_named", lambda name: Everything)
        codec.write(value, folder)
        back = codec.read(folder)
    assert digest(back) == digest(value)
    assert (back.names, back.count, back.flag, back.nothing) == (value.names, value.count, value.flag, None)
    assert back.rows == ((1, 2), (3,), ())
    assert [type(x) for x in vars(back).values()] == [type(x) for x in vars(value).values()]


@pytest.mark.parametrize("count", [3, codec.PLAIN_BYTES])
def test_the_payload_of_a_nan_survives(tmp_path, count):
    bits = np.full(count, 0x7FC00123, np.uint32)
    codec.write(LabelMap("x", bits.view(np.float32)), tmp_path / "object")
    np.testing.assert_array_equal(codec.read(tmp_path / "object").ids.view(np.uint32), bits)


@pytest.mark.parametrize(
    "content", [np.array(["a"]), np.array([b"a"]), np.array(["2026-01-01"], "M8[D]"), np.array([{}])]
)
def test_an_array_of_anything_but_numbers_is_refused(tmp_path, content):
    with pytest.raises(TypeError, match=r"LabelMap\.ids holds .*, which is not stored"):
        codec.write(LabelMap("x", content), tmp_path / "object")


@pytest.mark.parametrize("count", [codec.PLAIN_BYTES // 2, codec.PLAIN_BYTES // 2 + 1, 3 * codec.CHUNK_BYTES])
def test_arrays_round_the_limits_of_plain_and_of_one_chunk_read_back(tmp_path, count):
    content = np.arange(count).astype(np.uint16)[:, None]
    codec.write(LabelMap("x", content), tmp_path / "object")
    np.testing.assert_array_equal(codec.read(tmp_path / "object").ids, content)
    theirs = zarr.open_group(store=tmp_path / "object", mode="r")["ids"]
    np.testing.assert_array_equal(np.asarray(theirs[...]), content)


def test_a_small_object_is_read_as_it_lies(tmp_path, monkeypatch):
    codec.write(LabelMap("x", np.eye(3, dtype=np.uint16)), tmp_path / "object")
    monkeypatch.setattr(codec, "_read_chunks", lambda *_: pytest.fail("read by chunks"))
    assert codec.read(tmp_path / "object").ids.trace() == 3


def test_a_cut_chunk_is_a_fault_and_not_an_array(tmp_path):
    codec.write(LabelMap("x", np.eye(3, dtype=np.uint16)), tmp_path / "object")
    chunk = tmp_path / "object/ids/c.0.0"
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


def test_more_plain_data_than_can_be_read_back_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(codec, "MOST_HEADER_BYTES", 1000)
    codec.write(LabelMap("x" * 800, np.zeros(1)), tmp_path / "a")
    assert codec.read(tmp_path / "a").name == "x" * 800
    with pytest.raises(TypeError, match=r"LabelMap holds .* bytes of plain data, where 1000 are the most"):
        codec.write(LabelMap("x" * 1000, np.zeros(1)), tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_what_is_not_a_dataclass_of_arrays_is_refused(tmp_path):
    @dataclass(frozen=True)
    class Holder:
        callback: object

    with pytest.raises(TypeError, match="only dataclasses"):
        codec.write({"a": 1}, tmp_path / "a")
    with pytest.raises(TypeError, match=r"Holder\.callback"):
        codec.write(Holder(print), tmp_path / "b")


def test_what_could_be_changed_or_not_be_read_back_is_refused(tmp_path):
    @dataclass
    class Loose:
        value: float = 0.0

    @dataclass(frozen=True)
    class Derived:
        value: float = field(default=0.0, init=False)

    with pytest.raises(TypeError, match="Loose is not frozen"):
        codec.write(Loose(), tmp_path / "a")
    with pytest.raises(TypeError, match=r"Derived\.value has init=False"):
        codec.write(Derived(), tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


class Kind(enum.IntEnum):
    ONE = 1


class Pair(NamedTuple):
    a: int
    b: int


@dataclass(frozen=True)
class Foreign:
    value: float


@pytest.mark.parametrize(
    ("made", "what"),
    [
        (lambda: toy.Scaled(np.zeros(2), 2.0), "Scaled could not be built again .* 'by'"),
        (lambda: toy.Shifted(np.zeros(2)), "Shifted makes something else of its own fields"),
        (lambda: toy.Sorted(np.array([2.0, 1.0])), "Sorted could not be built again .* read-only"),
        (lambda: toy.Table({}, [Kind.ONE]), r"Table\.names holds a Kind, which would not come back"),
        (lambda: toy.Table({"a": Pair(1, 2)}, []), r"Table\.rows holds a Pair, which would not come back"),
        (lambda: toy.Table({"a": np.zeros(2)}, []), r"Table\.rows holds arrays in a list or a dict"),
        (
            lambda: Foreign(1.0),
            "Foreign could not be built .* its module's name does not begin with ss_flow_",
        ),
    ],
    ids=["init variable", "other fields", "changed fields", "enum", "named tuple", "arrays in a dict", "foreign type"],
)
def test_what_the_store_could_not_give_back_is_refused(tmp_path, made, what):
    with pytest.raises(TypeError, match=what):
        codec.write(made(), tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_a_type_that_makes_the_same_of_its_fields_again_is_stored(tmp_path):
    codec.write(toy.Rounded(np.array([0.6])), tmp_path / "a")
    assert codec.read(tmp_path / "a").value == 1.0


def test_a_field_that_is_declared_as_a_bare_tuple_reads_back_as_one(tmp_path):
    codec.write(toy.Row((1, 2), ("m",)), tmp_path / "a")
    assert codec.read(tmp_path / "a") == toy.Row((1, 2), ("m",))


def test_gaussians_of_no_rows_keep_their_shapes(tmp_path):
    empty = {
        n: np.zeros((0, *s), np.float32) for n, s in (("means", (3,)), ("quaternions", (4,)), ("log_scales", (3,)))
    }
    ids = {n: np.zeros(0, np.int32) for n in ("instance_id", "part_id")}
    rest = {n: np.zeros(0, np.float32) for n in ("opacity_logits", "instance_conf")}
    codec.write(Gaussians(**empty, **ids, **rest, sh=np.zeros((0, 16, 3), np.float32)), tmp_path / "object")
    assert codec.read(tmp_path / "object").sh.shape == (0, 16, 3)
