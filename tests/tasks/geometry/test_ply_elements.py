"""PLY files of scans: text and binary, both byte orders, lists, and what is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.geometry.ply_elements import read_elements

HEADER = (
    "ply\nformat {} 1.0\ncomment made by hand\nelement vertex 3\nproperty float x\nproperty double y\n"
    "property ushort label\nelement face 2\nproperty list uchar int vertex_indices\nproperty int object_id\n"
    "end_header\n"
)
VERTICES = [(1.5, -2.25, 7), (0.0, 1e-3, 65535), (3.0, 4.0, 0)]
FACES = [((0, 1, 2, 0), -1), ((2, 1, 0, 1), 12)]


def _file(folder: Path, form: str) -> Path:
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}[form]
    if order:
        body = b"".join(struct.pack(f"{order}fdH", *row) for row in VERTICES)
        body += b"".join(struct.pack(f"{order}B4ii", 4, *corners, one) for corners, one in FACES)
    else:
        rows = [" ".join(map(repr, row)) for row in VERTICES]
        rows += [f"4 {' '.join(map(str, corners))} {one}" for corners, one in FACES]
        body = ("\n".join(rows) + "\n").encode()
    path = folder / f"{form}.ply"
    path.write_bytes(HEADER.format(form).encode() + body)
    return path


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_scalars_and_lists_come_back_as_they_were_written(tmp_path: Path, form: str) -> None:
    found = read_elements(_file(tmp_path, form))
    assert list(found) == ["vertex", "face"] and found["vertex"]["label"].tolist() == [7, 65535, 0]
    np.testing.assert_array_equal(found["vertex"]["x"], np.float32([1.5, 0, 3]))
    np.testing.assert_array_equal(found["vertex"]["y"], [-2.25, 1e-3, 4])
    assert found["face"]["vertex_indices"].tolist() == [list(corners) for corners, _ in FACES]
    assert found["face"]["object_id"].tolist() == [-1, 12]


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
def test_an_element_without_rows_is_empty(tmp_path: Path, form: str) -> None:
    path = tmp_path / "none.ply"
    header = f"ply\nformat {form} 1.0\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header.encode())
    assert read_elements(path)["face"]["vertex_indices"].shape == (0, 0)


def test_what_is_damaged_or_no_ply_is_refused_by_name(tmp_path: Path) -> None:
    whole = _file(tmp_path, "binary_little_endian").read_bytes()
    at = len(HEADER.format("binary_little_endian")) + 3 * 14
    mixed = whole[: at + 21] + bytes([3]) + whole[at + 22 :]
    wrong = {"no_ply": b"solid\n", "short": whole[:-1], "mixed": mixed, "odd": whole.replace(b"ushort", b"nibble")}
    for name, content in wrong.items():
        path = tmp_path / f"{name}.ply"
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"{name}.ply"):
            read_elements(path)
    with pytest.raises(InputError, match="absent"):
        read_elements(tmp_path / "absent.ply")
