"""Annotated scans in the files of ScanNet and Replica, as these write them."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.flows.evaluate import scan_truth
from ss_flow.flows.generated import RoomParams, generate
from ss_flow.flows.generated.annotations import write_scan
from ss_flow.running import Surroundings, running
from ss_flow.task import FileRef
from ss_flow.tasks.evaluate.points import TruePoints, quality_by_kind
from ss_flow.tasks.evaluate.replica import replica_truth

NAME = "scene0000_00"


def _reference(path: Path) -> FileRef:
    return FileRef(path, path.name)


def _scannet(root: Path) -> Path:
    """Six vertices in segments 10, 10, 11, 11, 12, 13; a table of 10, 11, a wall of 11, 12; the finer mesh has one
    group more."""
    folder = root / NAME
    folder.mkdir()
    kinds = [("float", "x"), ("float", "y"), ("float", "z"), *(("uchar", c) for c in ("red", "green", "blue", "alpha"))]
    faces = struct.pack("<B3i", 3, 0, 1, 2)
    for end, label in (("", []), (".labels", [("ushort", "label")])):
        header = "ply\nformat binary_little_endian 1.0\ncomment VCGLIB generated\nelement vertex 6\n"
        header += "".join(f"property {kind} {name}\n" for kind, name in (*kinds, *label))
        header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        classes = (7, 7, 7, 1, 1, 2)
        rows = b"".join(
            struct.pack("<fff4B", i, 2 * i, 0, 1, 2, 3, 255) + (struct.pack("<H", classes[i]) if label else b"")
            for i in range(6)
        )
        (folder / f"{NAME}_vh_clean_2{end}.ply").write_bytes(header.encode() + rows + faces)
    segments = {"params": {"kThresh": "0.0001"}, "sceneId": NAME, "segIndices": [10, 10, 11, 11, 12, 13]}
    (folder / f"{NAME}_vh_clean_2.0.010000.segs.json").write_text(json.dumps(segments))
    table, wall = {"segments": [10, 11], "label": "table"}, {"segments": [11, 12], "label": "wall"}
    for file, groups in ((f"{NAME}.aggregation.json", [table, wall]), (f"{NAME}_vh_clean.aggregation.json", [wall])):
        whole = {
            "sceneId": f"scannet.{NAME}",
            "segGroups": [{"id": i, "objectId": i, **g} for i, g in enumerate(groups)],
        }
        (folder / file).write_text(json.dumps(whole))
    return folder


def test_scannets_groups_are_its_instances_and_its_labels_say_what_is_stuff(tmp_path: Path) -> None:
    heard: list[str] = []
    with running(Surroundings(warned=heard)):
        truth = scan_truth(_scannet(tmp_path), _reference)
    assert truth.points.tolist() == [[i, 2 * i, 0] for i in range(6)]
    assert truth.instance.tolist() == [0, 0, 1, 1, 1, -1] and truth.names == ("table", "wall")
    assert truth.stuff.tolist() == [1]
    assert len(heard) == 1 and "83.3%" in heard[0] and f"{NAME}.aggregation.json counts" in heard[0]


def test_the_finer_meshes_annotation_counts_when_asked_for(tmp_path: Path) -> None:
    folder = _scannet(tmp_path)
    assert scan_truth(folder, _reference, compat=True).instance.tolist() == [-1, -1, 0, 0, 0, -1]
    (folder / f"{NAME}_vh_clean_2.labels.ply").unlink()
    assert scan_truth(folder, _reference).stuff.tolist() == [1], "without labels by its name"
    (folder / f"{NAME}.aggregation.json").unlink()
    with pytest.raises(InputError, match=rf"{NAME}\.aggregation\.json"):
        scan_truth(folder, _reference)


def test_labels_of_another_scan_are_refused(tmp_path: Path) -> None:
    folder = _scannet(tmp_path)
    (folder / f"{NAME}_vh_clean_2.labels.ply").write_bytes((folder / f"{NAME}_vh_clean_2.ply").read_bytes())
    with pytest.raises(InputError, match="does not label the 6 vertices"):
        scan_truth(folder, _reference)


def _replica(root: Path) -> Path:
    """A row of three quads: object 4, object 2, and one that the list of objects leaves out."""
    folder = root / "room_0"
    (folder / "habitat").mkdir(parents=True)
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 8\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    header += "element face 3\nproperty list uchar int vertex_indices\nproperty int object_id\nend_header\n"
    rows = b"".join(struct.pack("<6f3B", i // 2, i % 2, 0, 0, 0, 1, 9, 9, 9) for i in range(8))
    faces = [((0, 1, 3, 2), 4), ((2, 3, 5, 4), 2), ((4, 5, 7, 6), 9)]
    body = b"".join(struct.pack("<B4ii", 4, *corners, one) for corners, one in faces)
    (folder / "habitat" / "mesh_semantic.ply").write_bytes(header.encode() + rows + body)
    objects = [
        {"id": 2, "class_id": 20, "class_name": "chair"},
        {"id": 4, "class_id": 93, "class_name": "wall"},
        {"id": 9, "class_id": -1, "class_name": "undefined"},
    ]
    info = {"classes": [{"id": 20, "name": "chair"}], "id_to_label": [0, 0, 20], "objects": objects}
    (folder / "habitat" / "info_semantic.json").write_text(json.dumps(info))
    return folder


def test_replicas_vertices_take_the_object_of_most_of_their_faces(tmp_path: Path) -> None:
    truth = scan_truth(_replica(tmp_path), _reference)
    # Vertices 2 and 3 have a face of each object: the lower id. 6 and 7 have only faces of an object without a class.
    assert truth.instance.tolist() == [4, 4, 2, 2, 2, 2, -1, -1]
    assert truth.names == ("", "", "chair", "", "wall") and truth.stuff.tolist() == [4]
    assert truth.points[5].tolist() == [2, 1, 0]
    with pytest.raises(InputError, match="--compat is for ScanNet"):
        scan_truth(tmp_path / "room_0", _reference, compat=True)


def test_damaged_files_of_replica_are_named(tmp_path: Path) -> None:
    folder = _replica(tmp_path) / "habitat"
    files = {"mesh": _reference(folder / "mesh_semantic.ply"), "info": _reference(folder / "info_semantic.json")}
    for content in ('{"objects": [{"id": 1}]}', "[" * 100_000):
        files["info"].path.write_text(content)
        with pytest.raises(InputError, match=r"info_semantic\.json cannot be read"):
            replica_truth(**files)
    whole = files["mesh"].path.read_bytes()
    last = struct.pack("<6f3B", 3, 1, 0, 0, 0, 1, 9, 9, 9)
    files["mesh"].path.write_bytes(whole.replace(b"element vertex 8", b"element vertex 7").replace(last, b""))
    with pytest.raises(InputError, match=r"mesh_semantic\.ply has faces of vertices that it does not hold"):
        replica_truth(**files)
    files["mesh"].path.write_bytes(whole.replace(b"int object_id", b"int some_other"))
    with pytest.raises(InputError, match=r"no faces with an object_id"):
        replica_truth(**files)
    files["info"].path.unlink()
    with pytest.raises(InputError, match=r"no info_semantic\.json"):
        scan_truth(folder.parent, _reference)


def test_things_and_stuff_have_a_quality_of_their_own() -> None:
    truth, stuff = np.array([0] * 6 + [1] * 6 + [-1]), np.int32([1])
    predicted = np.array([5] * 6 + [6] * 4 + [7] * 2 + [8])
    # The wall (1) is found with IoU 4/6 and in two pieces; the second piece is no false positive among things.
    values = quality_by_kind(truth, predicted, stuff)
    assert values == {"pq_things": 1.0, "pq_stuff": pytest.approx(4 / 6 / 1.5)}
    assert quality_by_kind(truth, np.array([5] * 10 + [0] * 3), stuff) == {
        "pq_things": pytest.approx(0.6),
        "pq_stuff": 0.0,
    }
    unlabelled = quality_by_kind(truth, np.array([5] * 6 + [0] * 6 + [5]), stuff)
    assert unlabelled == {"pq_things": 1.0, "pq_stuff": 0.0}, "what has no label is no prediction"


def test_what_lies_mostly_where_nothing_is_annotated_is_no_false_positive_of_either_kind() -> None:
    truth = np.repeat([0, 0, 1, -1], [90, 10, 100, 300])
    predicted = np.repeat([1, 3, 2, 3], [90, 10, 100, 300])
    assert quality_by_kind(truth, predicted, np.int32([1])) == {"pq_things": pytest.approx(0.9), "pq_stuff": 1.0}
    # With as much of it annotated as not it counts.
    few = quality_by_kind(truth[:210], predicted[:210], np.int32([1]))
    assert few == {"pq_things": pytest.approx(0.6), "pq_stuff": 1.0}


def test_a_generated_rooms_scan_says_what_its_points_are(tmp_path: Path) -> None:
    room = generate(RoomParams(objects=2, views=2, width=48, height=36, held_out=0))
    write_scan(room, tmp_path, tmp_path.name)
    truth: TruePoints = scan_truth(tmp_path, _reference)
    np.testing.assert_array_equal(truth.points, room.points)
    structure = len(room.objects)
    np.testing.assert_array_equal(truth.instance, np.where(room.point_ids > 0, room.point_ids - 1, structure))
    assert truth.names == (*(o.name for o in room.objects), room.structure.name) and truth.stuff.tolist() == [structure]
