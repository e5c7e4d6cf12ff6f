"""What the exports' bytes say, taken apart here by the formats' own definitions."""

from __future__ import annotations

import gzip
import io
import itertools
import json
import struct
import zipfile
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_gaussians import made_cameras, made_gaussians

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver.export.compressed_ply import compressed_ply
from ss_flow.tasks.deliver.export.content import FileContent, chosen, morton_order, smallest_three, y_up
from ss_flow.tasks.deliver.export.gaussian_ply import gaussian_ply
from ss_flow.tasks.deliver.export.gltf import gltf
from ss_flow.tasks.deliver.export.sog import _kinds, sog
from ss_flow.tasks.deliver.export.splat import splat
from ss_flow.tasks.deliver.export.spz import spz
from ss_flow.tasks.deliver.export.usda import usda
from ss_flow.tasks.edit.operations import edited
from ss_flow.tasks.gaussians.read_ply import read_columns, read_gaussians

SIZES = st.sampled_from([0, 1, 2, 255, 256, 257, 700])
DEGREES = st.integers(0, 3)
SH_ZERO = 0.28209479177387814


def bytes_of(file: FileContent) -> bytes:
    return file.content.tobytes()


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """[N, 3, 3] of w x y z, of any length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)


def glb_parts(data: bytes) -> tuple[dict, bytes]:
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    rest = data[20 + size :]
    if rest:
        count, kind = struct.unpack_from("<I4s", rest)
        assert kind == b"BIN\0" and count == len(rest) - 8
    return json.loads(data[20 : 20 + size]), rest[8:]


def column(document: dict, binary: bytes, accessor: int) -> np.ndarray:
    entry = document["accessors"][accessor]
    view = document["bufferViews"][entry["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
    kind = {5126: "<f4", 5125: "<u4"}[entry["componentType"]]
    found = np.frombuffer(binary, kind, entry["count"] * width, view["byteOffset"])
    assert view["byteLength"] == found.nbytes
    return found.reshape(-1, width) if width > 1 else found


@given(count=SIZES, degree=DEGREES)
def test_gltf_holds_every_number_of_every_instance_exactly_and_names_its_node(count, degree):
    made = made_gaussians(count, degree)
    document, binary = glb_parts(bytes_of(gltf(made, made_cameras(), names={"1": "red mug"})))
    nodes = {node["extras"]["instance_id"]: node for node in document["nodes"][1:]}
    assert sorted(nodes) == np.unique(made.instance_id).tolist()
    assert document["nodes"][0].get("children", []) == list(range(1, len(nodes) + 1))
    assert nodes.get(1, {"name": "red mug"})["name"] == "red mug"
    for instance_id, node in nodes.items():
        own = made.instance_id == instance_id
        assert document["meshes"][node["mesh"]]["name"] == node["name"]
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        found = {name: column(document, binary, a) for name, a in primitive["attributes"].items()}
        prefix = "KHR_gaussian_splatting"
        assert primitive["mode"] == 0 and primitive["extensions"][prefix]["kernel"] == "ellipse"
        np.testing.assert_array_equal(found["POSITION"], made.means[own])
        np.testing.assert_array_equal(found[f"{prefix}:ROTATION"], made.quaternions[own][:, [1, 2, 3, 0]])
        np.testing.assert_allclose(np.log(found[f"{prefix}:SCALE"]), made.log_scales[own], atol=1e-6)
        np.testing.assert_allclose(found[f"{prefix}:OPACITY"], made.opacities[own], rtol=1e-6)
        coefficients = [found[f"{prefix}:SH_DEGREE_{d}_COEF_{n}"] for d in range(degree + 1) for n in range(2 * d + 1)]
        np.testing.assert_array_equal(np.stack(coefficients, axis=1), made.sh[own])
        assert len(found) == 5 + (degree + 1) ** 2
        accessor = document["accessors"][primitive["attributes"]["POSITION"]]
        np.testing.assert_array_equal(np.float32(accessor["min"]), made.means[own].min(axis=0))


@given(count=SIZES, degree=DEGREES)
def test_flat_gltf_has_one_mesh_and_tells_the_instance_of_each_gaussian(count, degree):
    made = made_gaussians(count, degree)
    document, binary = glb_parts(bytes_of(gltf(made, made_cameras(), names={"1": "red mug"}, flat=True)))
    ids = np.unique(made.instance_id).tolist()
    if not ids:
        assert len(document["nodes"]) == 1 and "meshes" not in document
        return
    root, node = document["nodes"]
    called = {0: "background", 1: "red mug", 2: "object 2", 3: "object 3"}
    assert root["children"] == [1] and node["extras"] == {"instances": [{"id": i, "name": called[i]} for i in ids]}
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    found = {name: column(document, binary, a) for name, a in primitive["attributes"].items()}
    np.testing.assert_array_equal(found["POSITION"], made.means)
    np.testing.assert_array_equal(found["_INSTANCE_ID"], made.instance_id)
    assert len(found) == 6 + (degree + 1) ** 2


def test_the_root_node_turns_up_to_y():
    cameras = made_cameras(((3, 0, 0), (0, 3, 0)))
    up = -cameras.world_to_camera[:, 1, :3].mean(axis=0)
    x, y, z, w = y_up(cameras)
    turned = rotations(np.array([[w, x, y, z]]))[0] @ (up / np.linalg.norm(up))
    np.testing.assert_allclose(turned, (0, 1, 0), atol=1e-9)


@given(count=SIZES, degree=DEGREES)
def test_splat_rows_decode_within_half_a_level(count, degree):
    made = made_gaussians(count, degree)
    data = bytes_of(splat(made))
    assert len(data) == 32 * count
    rows = np.frombuffer(data, [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    weight = made.log_scales.sum(axis=1, dtype=np.float64) + np.log(made.opacities)
    order = np.argsort(-weight, kind="stable")
    np.testing.assert_array_equal(rows["mean"], made.means[order])
    np.testing.assert_allclose(np.log(rows["scale"]), made.log_scales[order], atol=1e-6)
    color = (0.5 + SH_ZERO * made.sh[order, 0]).clip(0, 1)
    assert np.abs(rows["rgba"][:, :3] / 255 - color).max(initial=0) <= 0.5 / 255 + 1e-6
    assert np.abs(rows["rgba"][:, 3] / 255 - made.opacities[order]).max(initial=0) <= 0.5 / 255 + 1e-6
    q = (rows["rotation"].astype(float) - 128) / 128
    assert np.abs(q - made.quaternions[order]).max(initial=0) <= 1 / 128  # 1 itself has no level


@given(count=SIZES, degree=DEGREES)
def test_compressed_ply_decodes_within_its_chunks_steps(count, degree):
    made = made_gaussians(count, degree)
    head, _, body = bytes_of(compressed_ply(made)).partition(b"end_header\n")
    chunks = -(-count // 256)
    assert f"element chunk {chunks}\n".encode() in head and f"element vertex {count}\n".encode() in head
    assert head.count(b"property uchar f_rest_") == 3 * ((degree + 1) ** 2 - 1)
    order = morton_order(made.means)
    ends = np.frombuffer(body, "<f4", 18 * chunks).reshape(-1, 3, 2, 3)
    packed = np.frombuffer(body, "<u4", 4 * count, ends.nbytes).reshape(-1, 4)
    rest = np.frombuffer(body, "u1", offset=ends.nbytes + packed.nbytes).reshape(count, -1) if count else None
    chunk = np.arange(count) // 256
    position, rotation, scale, color = packed.T if count else np.zeros((4, 0), np.uint32)
    for group, (word, truth) in enumerate(((position, made.means[order]), (scale, made.log_scales[order]))):
        low, high = ends[chunk, group, 0], ends[chunk, group, 1]
        steps = np.array([2047, 1023, 2047])
        share = np.stack([word >> 21 & 2047, word >> 11 & 1023, word & 2047], axis=1) / steps
        assert (np.abs(low + share * (high - low) - truth) <= (high - low) / steps * 0.5 + 1e-5).all()
    share = np.stack([color >> 24 & 255, color >> 16 & 255, color >> 8 & 255], axis=1) / 255
    low, high = ends[chunk, 2, 0], ends[chunk, 2, 1]
    truth = 0.5 + SH_ZERO * made.sh[order, 0]
    assert (np.abs(low + share * (high - low) - truth) <= (high - low) / 255 * 0.5 + 1e-5).all()
    assert np.abs((color & 255) / 255 - made.opacities[order]).max(initial=0) <= 0.5 / 255 + 1e-6
    others = np.stack([rotation >> 20 & 1023, rotation >> 10 & 1023, rotation & 1023], axis=1) / 1023
    largest, three = smallest_three(made.quaternions[order])
    np.testing.assert_array_equal(rotation >> 30, largest)
    assert np.abs((others - 0.5) * 2**0.5 - three).max(initial=0) <= 2**0.5 * 0.5 / 1023 + 1e-6
    if count and degree:
        truth = made.sh[order, 1:].transpose(0, 2, 1).reshape(count, -1)
        assert np.abs((rest / 256 - 0.5) * 8 - truth).max() <= 8 / 256 + 1e-6


@given(count=SIZES, degree=DEGREES)
def test_spz_decodes_within_its_steps_in_its_own_axes(count, degree):
    made = made_gaussians(count, degree)
    data = gzip.decompress(bytes_of(spz(made)))
    magic, version, points, stored, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, points, stored, flags, reserved) == (0x5053474E, 3, count, degree, 0, 0)
    coefficients = (degree + 1) ** 2 - 1
    sizes = np.cumsum([16, 9 * count, count, 3 * count, 3 * count, 4 * count, 3 * coefficients * count])
    assert len(data) == sizes[-1]
    places, alphas, colors, scales, turns, harmonics = (
        np.frombuffer(data[a:b], "u1") for a, b in itertools.pairwise(sizes)
    )
    raw = places.reshape(-1, 3).astype(np.int64) @ [1, 256, 65536]
    means = (np.where(raw >= 1 << 23, raw - (1 << 24), raw) / (1 << bits)).reshape(-1, 3) * (1, -1, -1)
    assert np.abs(means - made.means).max(initial=0) <= 0.5 / (1 << bits) + 1e-9
    assert np.abs(alphas / 255 - made.opacities).max(initial=0) <= 0.5 / 255 + 1e-6
    dc = (colors.reshape(-1, 3) / 255 - 0.5) / 0.15
    assert np.abs(dc - made.sh[:, 0]).max(initial=0) <= 0.5 / 255 / 0.15 + 1e-5
    assert np.abs(scales.reshape(-1, 3) / 16 - 10 - made.log_scales).max(initial=0) <= 0.5 / 16 + 1e-6
    word = turns.view("<u4")
    fields = np.stack([word >> 20 & 1023, word >> 10 & 1023, word & 1023], axis=1).astype(int)
    three = np.where(fields & 512, -1, 1) * (fields & 511) / 511 / 2**0.5
    largest = (word >> 30).astype(int)
    xyzw = np.zeros((count, 4))
    for row in range(count):
        xyzw[row, [i for i in range(4) if i != largest[row]]] = three[row]
        xyzw[row, largest[row]] = np.sqrt(max(0, 1 - (three[row] ** 2).sum()))
    if count:
        flip = np.diag([1.0, -1.0, -1.0])
        expected = flip @ rotations(made.quaternions.astype(float)) @ flip
        assert np.abs(rotations(xyzw[:, [3, 0, 1, 2]]) - expected).max() < 0.01
    found = (harmonics.reshape(count, coefficients, 3).astype(float) - 128) / 128
    step = np.concatenate([[8.0] * 3, [16.0] * 12])[:coefficients, None] / 128
    flips = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])[:coefficients, None]
    assert (np.abs(found * flips - made.sh[:, 1:]) <= 0.5 * step + 0.5 / 128 + 1e-6).all()


def test_spz_spends_fewer_bits_on_fractions_where_coordinates_are_large():
    far = made_gaussians(3, 0)
    far.means[0] = (100_000.0, 0, 0)
    assert struct.unpack_from("<IIIBB", gzip.decompress(bytes_of(spz(far))))[4] == 6
    far.means[0] = (1e8, 0, 0)
    with pytest.raises(InputError, match="lies 1e"):
        spz(far)


@pytest.mark.parametrize("size", [0.7, 0.05, 1e-3])
def test_spz_spends_more_bits_on_fractions_where_all_coordinates_are_small(size):
    made = made_gaussians(50, 0)
    made.means[:] *= size / np.abs(made.means).max()
    data = gzip.decompress(bytes_of(spz(made)))
    raw = np.frombuffer(data, "u1", 9 * 50, 16).reshape(-1, 3).astype(np.int64) @ [1, 256, 65536]
    means = (np.where(raw >= 1 << 23, raw - (1 << 24), raw) / (1 << data[13])).reshape(-1, 3) * (1, -1, -1)
    assert np.abs(means - made.means).max() <= size / 4096


def sog_parts(data: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """What is in the archive: meta.json, and the pixels of each image [n, 4] RGBA."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    meta = json.loads(archive.read("meta.json"))
    images = {}
    for name in archive.namelist():
        if name.endswith(".webp"):
            data = archive.read(name)
            assert data[:4] == b"RIFF" and data[8:16] == b"WEBPVP8L"  # lossless
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            if pixels.shape[2] == 3:  # opaque all over
                pixels = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=2)
            images[name] = pixels[..., [2, 1, 0, 3]].astype(int).reshape(-1, 4)
    listed = [file for entry in meta.values() if isinstance(entry, dict) for file in entry.get("files", ())]
    assert sorted(listed) == sorted(images)
    return meta, images


@given(count=SIZES, degree=DEGREES)
def test_sog_decodes_within_its_steps(count, degree):
    made = made_gaussians(count, degree)
    meta, images = sog_parts(bytes_of(sog(made)))
    assert (meta["version"], meta["count"]) == (2, count)
    assert ("shN" in meta) == (count > 0 and degree > 0)
    order = morton_order(made.means)
    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    whole = (images["means_l.webp"] + 256 * images["means_u.webp"])[:count, :3]
    logs = low + whole / 65535 * (high - low)
    truth = np.sign(made.means[order]) * np.log1p(np.abs(made.means[order].astype(float)))
    assert (np.abs(logs - truth) <= (high - low) / 65535 * 0.5 + 1e-12).all()
    for file, entry, values in (
        ("scales.webp", meta["scales"], made.log_scales[order]),
        ("sh0.webp", meta["sh0"], made.sh[order, 0]),
    ):
        book = np.array(entry["codebook"])
        assert len(book) == 256 and (np.diff(book) >= 0).all()
        found = book[images[file][:count, :3]]
        # What stands for a number is the nearest of all there are.
        nearest = np.abs(values.reshape(-1, 1) - book).min(axis=1, initial=np.inf).reshape(values.shape)
        np.testing.assert_allclose(np.abs(found - values), nearest, atol=1e-6)
        assert np.abs(found - values).max(initial=0) < 0.05
    alpha = images["sh0.webp"][:count, 3]
    assert alpha.min(initial=255) >= 1 and np.abs(alpha / 255 - made.opacities[order]).max(initial=0) <= 1 / 255
    largest, three = smallest_three(made.quaternions[order])
    np.testing.assert_array_equal(images["quats.webp"][:count, 3], 252 + largest)
    assert np.abs((images["quats.webp"][:count, :3] / 255 - 0.5) * 2**0.5 - three).max(initial=0) <= 0.5 * 2**0.5 / 255
    if "shN" in meta:
        entry, coefficients = meta["shN"], (degree + 1) ** 2 - 1
        assert (entry["bands"], entry["count"], len(entry["codebook"])) == (degree, count, 256)
        label = images["shN_labels.webp"][:count] @ [1, 256, 0, 0]
        grid = images["shN_centroids.webp"].reshape(-1, 64, coefficients, 4)[label // 64, label % 64, :, :3]
        assert np.abs(np.array(entry["codebook"])[grid] - made.sh[order, 1:]).max() < 0.05


def test_harmonics_of_more_kinds_than_there_may_be_are_joined_with_their_like():
    different = np.random.default_rng(0).normal(size=(40, 24)).astype(np.float32)
    rows = np.repeat(different, 50, axis=0)[np.random.default_rng(1).permutation(2000)]
    kind, kinds = _kinds(rows, 256)
    assert kinds.shape == (256, 24) and np.bincount(kind).min() >= 7 and np.bincount(kind).max() <= 8
    # Forty kinds of rows in 256 groups: most groups hold one kind, and then nothing is lost.
    off = np.abs(kinds[kind] - rows).max(axis=1)
    assert (off < 1e-6).mean() > 0.7
    assert np.square(kinds[kind] - rows).mean() < 0.2 * rows.var()
    kind, kinds = _kinds(rows, 2000)
    np.testing.assert_array_equal(kinds[kind], rows)


@given(count=st.sampled_from([0, 1, 300]), degree=DEGREES, labelled=st.booleans())
def test_ply_reads_back_equal(tmp_path_factory, count, degree, labelled):
    made = made_gaussians(count, degree)
    file = tmp_path_factory.mktemp("ply") / "a.ply"
    file.write_bytes(bytes_of(gaussian_ply(made, labelled=labelled)))
    read = read_gaussians(file)
    np.testing.assert_array_equal(read.means, made.means)
    np.testing.assert_array_equal(read.sh[:, : made.sh.shape[1]], made.sh)
    np.testing.assert_array_equal(read.instance_id, made.instance_id * labelled)


def test_instances_of_an_edited_scene_keep_the_column_that_says_what_fills_holes(tmp_path):
    made = made_gaussians(40, 1)
    flags = np.arange(40) % 2
    scene = replace(edited(made, filled=0), filled=flags.astype(np.uint8))
    own = made.instance_id == 2
    (tmp_path / "two.ply").write_bytes(bytes_of(gaussian_ply(chosen(scene, instances=(2,)), labelled=True)))
    assert np.array_equal(read_columns(tmp_path / "two.ply")["filled"], flags[own]) and own.any()


def test_usda_has_a_prim_for_each_instance_and_numbers_that_read_back():
    made = made_gaussians(40, 1)
    text = bytes_of(usda(made, made_cameras(), names={"2": 'a "quoted" cup', "1": "a\x01b\\"})).decode()
    assert text.startswith("#usda 1.0\n") and text.count("ParticleField3DGaussianSplat") == 4
    assert 'displayName = "a \\"quoted\\" cup"' in text and 'displayName = "a\\x01b\\\\"' in text
    prim = text.partition('"instance_0002"')[2]
    written = prim.partition("positions = [")[2].partition("]")[0]
    own = made.means[made.instance_id == 2]
    found = np.array([float(number) for number in written.replace("(", "").replace(")", "").split(",")], np.float32)
    np.testing.assert_array_equal(found.reshape(-1, 3), own)
    assert "instance_0001" not in bytes_of(usda(chosen(made, instances=(2,)), made_cameras(), names={})).decode()


@given(degree=DEGREES, count=st.sampled_from([0, 1, 500]))
def test_the_same_gaussians_give_the_same_bytes(degree, count):
    cameras = made_cameras()
    for write in (
        splat,
        spz,
        sog,
        compressed_ply,
        lambda g: gltf(g, cameras, names={}),
        lambda g: usda(g, cameras, names={}),
    ):
        first: Gaussians = made_gaussians(count, degree)
        assert bytes_of(write(first)) == bytes_of(write(made_gaussians(count, degree)))
