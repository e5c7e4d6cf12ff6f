import json
from dataclasses import replace

import numpy as np
from view_masks import as_fields

from ss_flow.tasks.artifacts import Gaussians, Hierarchy, InstanceMasks
from ss_flow.tasks.deliver.instances_json import instance_file, instances_document
from ss_flow.tasks.deliver.palette import instance_color
from ss_flow.tasks.gaussians.initialise import NO_GAUSSIANS
from ss_flow.tasks.semantics.name import InstanceNames

NO_NAMES = InstanceNames(np.zeros(0, np.int32), (), np.zeros(0, np.float32), "clip")
NO_TREE = Hierarchy(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros(0, bool))


def instance(instance_id: int, points, views=(0, 2), weak: bool = False, shown: int = 4) -> InstanceMasks:
    points = np.asarray(points, np.float32).reshape(-1, 3)
    n, v = len(points), len(views)
    return InstanceMasks(
        **as_fields(np.arange(8).reshape(1, 2, 4).repeat(v, axis=0) < shown), views=tuple("abc"[k] for k in views),
        instance_id=instance_id, points=points, colors=np.zeros((n, 3), np.uint8),
        point_confidence=np.ones(n, np.float32), point_part=np.arange(n, dtype=np.int32), confidence=0.87654321,
        origin=np.zeros(v, np.uint8), weak=weak,
    )  # fmt: skip


def gaussians(means, ids) -> Gaussians:
    n = len(ids)
    return Gaussians(
        np.asarray(means, np.float32), np.zeros((n, 4), np.float32), np.zeros((n, 3), np.float32),
        np.zeros(n, np.float32), np.zeros((n, 1, 3), np.float32), np.asarray(ids, np.int32),
        np.zeros(n, np.float32), np.zeros(n, np.int32),
    )  # fmt: skip


def test_an_instance_is_described_by_its_points():
    document = instances_document([instance(7, [[0, 0, 0], [2, 4, 6]])], NO_GAUSSIANS, NO_NAMES, NO_TREE)
    assert json.loads(json.dumps(document)) == {
        "version": 1,
        "background_id": 0,
        "num_crumbs": 0,
        "instances": [
            {
                "id": 7,
                "name": "object 7",
                "named_by": None,
                "kind": "thing",
                "color": list(instance_color(7)),
                "parent": None,
                "parts": [
                    {"part_id": 1, "num_points": 1, "bbox": {"min": [2, 4, 6], "max": [2, 4, 6]}, "centroid": [2, 4, 6]}
                ],
                "bbox": {"min": [0, 0, 0], "max": [2, 4, 6]},
                "centroid": [1, 2, 3],
                "views": ["a", "c"],
                "confidence": 0.8765,
                "num_parts": 1,
                "num_points": 2,
                "num_gaussians": 0,
                "weak": False,
                "crumb": False,
                "file": None,
            }
        ],
        "groups": [],
    }


def test_where_there_are_gaussians_they_say_where_it_is():
    scene = gaussians([[9, 9, 9], [1, 0, 0], [5, 5, 5], [3, 0, 0]], [0, 7, 8, 7])
    entry = instances_document([instance(7, [[0, 0, 0]])], scene, NO_NAMES, NO_TREE)["instances"][0]
    assert entry["bbox"] == {"min": [1, 0, 0], "max": [3, 0, 0]} and entry["centroid"] == [2, 0, 0]
    assert entry["num_gaussians"] == 2 and entry["file"] == instance_file(7) == "instances/0007.ply"


def test_gaussians_that_are_hardly_to_be_seen_do_not_widen_a_box_unless_all_are():
    scene = gaussians([[1, 0, 0], [3, 0, 0], [80, 0, 0]], [7, 7, 7])
    told = []
    for opacities in ([0.9, 0.2, 0.1], [0.1, 0.1, 0.1]):
        logits = np.log(np.array(opacities, np.float32) / (1 - np.array(opacities, np.float32)))
        document = instances_document(
            [instance(7, [[0, 0, 0]])], replace(scene, opacity_logits=logits), NO_NAMES, NO_TREE
        )
        told.append(document["instances"][0])
    assert [entry["bbox"]["max"] for entry in told] == [[3, 0, 0], [80, 0, 0]]
    assert [entry["centroid"] for entry in told] == [[28, 0, 0]] * 2


def test_a_weak_instance_has_points_but_no_file():
    scene = gaussians([[1, 0, 0]], [8])
    entry = instances_document([instance(7, [[1, 1, 1]], weak=True)], scene, NO_NAMES, NO_TREE)["instances"][0]
    assert entry["weak"] and entry["file"] is None and entry["centroid"] == [1, 1, 1]


def test_names_are_unique_and_the_unknown_go_by_their_id():
    names = InstanceNames(
        np.array([3, 1, 2, 4], np.int32), ("mug", "mug", "object", "sofa"), np.ones(4, np.float32), "clip"
    )
    document = instances_document([instance(i, [[0, 0, 0]]) for i in (5, 4, 3, 2, 1)], NO_GAUSSIANS, names, NO_TREE)
    found = [(e["id"], e["name"], e["named_by"]) for e in document["instances"]]
    assert found == [
        (1, "mug", "clip"),
        (2, "object 2", "clip"),
        (3, "mug 2", "clip"),
        (4, "sofa", "clip"),
        (5, "object 5", None),
    ]


def test_names_that_the_user_gave_stay_and_are_told_from_those_of_the_encoder():
    ids, given = np.array([1, 2, 3], np.int32), np.array([2, 3], np.int32)
    names = InstanceNames(ids, ("mug", "mug", "my lamp"), np.ones(3, np.float32), "clip", given)
    document = instances_document([instance(i, [[0, 0, 0]]) for i in (1, 2, 3)], NO_GAUSSIANS, names, NO_TREE)
    found = [(e["name"], e["named_by"]) for e in document["instances"]]
    assert found == [("mug 2", "clip"), ("mug", "hints"), ("my lamp", "hints")]


def test_the_background_is_no_instance_and_instances_know_their_groups_and_kind():
    # 5 = {1, 2} is no instance but a group; so is 6 = {5, 3}. 4 is a wall.
    tree = Hierarchy(
        np.array([1, 2, 3, 4, 5, 6], np.int32),
        np.array([5, 5, 6, 0, 6, 0], np.int32),
        np.array([1, 1, 1, 1, 0.4, 0.25], np.float32),
        np.array([False, False, False, True, False, False]),
    )
    known = [instance(i, [[0, 0, 0]]) for i in (0, 1, 2, 3, 4)]
    document = instances_document(known, NO_GAUSSIANS, NO_NAMES, tree)
    found = [(e["id"], e["parent"], e["kind"]) for e in document["instances"]]
    assert found == [(1, 5, "thing"), (2, 5, "thing"), (3, 6, "thing"), (4, None, "stuff")]
    assert document["groups"] == [
        {"id": 5, "parent": 6, "agreement": 0.4, "instances": [1, 2]},
        {"id": 6, "parent": None, "agreement": 0.25, "instances": [1, 2, 3]},
    ]


def test_crumbs_are_counted_and_have_no_file():
    scene = gaussians([[1, 0, 0], [1, 0, 0]], [7, 8])
    document = instances_document(
        [instance(7, [[0, 0, 0]], shown=0), instance(8, [[0, 0, 0]])], scene, NO_NAMES, NO_TREE
    )
    assert [(e["crumb"], e["file"]) for e in document["instances"]] == [(True, None), (False, "instances/0008.ply")]
    assert document["num_crumbs"] == 1


def test_an_instance_without_points_has_no_place():
    entry = instances_document([instance(1, [])], NO_GAUSSIANS, NO_NAMES, NO_TREE)["instances"][0]
    assert entry["bbox"] is None and entry["centroid"] is None
