"""Edit scripts: what is refused, with which sentence, and what becomes of the objects."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path

import numpy as np
import pytest
from still_life import DOCUMENT, scene

from ss_flow.errors import InputError
from ss_flow.flows.edit_objects import Objects
from ss_flow.flows.edit_script import _OPERATIONS, check
from ss_flow.tasks.artifacts import EditedScene


def checked(*steps: object, folder: Path = Path("here")):
    objects = Objects.of(copy.deepcopy(DOCUMENT), scene())
    return check({"operations": list(steps)}, objects, folder)


def applied(*steps: object) -> tuple[EditedScene, Objects]:
    todo, objects = checked(*steps)
    now = scene()
    for step in todo:
        now = step.apply(now)
    return now, objects


@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        ("remove", 'operation 1 must be an object such as {"op": "remove", "instances": [3]}.'),
        ({"op": "erase"}, "operation 1: op is 'erase'; it must be one of remove, keep, "),
        ({"op": "remov"}, "did you mean 'remove'?"),
        ({"op": "remove"}, "operation 1 (remove): instances is missing; it must name instances by id or by name"),
        ({"op": "remove", "instances": []}, "instances is []; it must name at least one instance."),
        ({"op": "remove", "instances": [2, 99]}, "instances is [2, 99]; no instance goes by 99 at this point"),
        ({"op": "remove", "instances": "red mugg"}, "instances.json lists ids and names; did you mean 'red mug'?"),
        ({"op": "remove", "instances": [True]}, "no instance goes by True"),
        ({"op": "remove", "instances": 2, "fill": 1}, "operation 1 (remove): fill is 1; it must be true or false."),
        ({"op": "remove", "instances": 2, "fil": True}, "the field 'fil' is unknown; it takes op, comment, instances,"),
        ({"op": "keep", "instances": {}}, "instances is {}; no instance goes by {}"),
        ({"op": "transform", "instances": 2, "move": [1, 2]}, "move is [1, 2]; it must be three numbers in world"),
        ({"op": "transform", "instances": 2, "move": [1, 2, "x"]}, "it must be three numbers"),
        ({"op": "transform", "instances": 2, "move": [1e39, 0, 0]}, "it must be three numbers"),
        ({"op": "transform", "instances": 2, "scale": 0}, "scale is 0; it must be a number above 0."),
        ({"op": "transform", "instances": 2, "scale": float("nan")}, "it must be a number above 0."),
        ({"op": "transform", "instances": 2, "scale": 10**400}, "it must be a number above 0."),
        (
            {"op": "transform", "instances": 2, "rotate": {"axis": [0, 0, 0], "degrees": 9}},
            'it must be such as {"axis": [0, 0, 1], "degrees": 90}, with an axis that is not 0.',
        ),
        ({"op": "transform", "instances": 2, "pivot": "middle"}, 'pivot is \'middle\'; it must be "centre", or three'),
        ({"op": "transform", "instances": 5, "move": [1, 0, 0]}, "5 has no Gaussians (too few views show it)"),
        ({"op": "transform", "instances": 0}, "instances is 0; no instance goes by 0"),
        ({"op": "recolour", "instances": 2, "color": "red"}, "color is 'red'; it must be \"#rrggbb\", or red, green"),
        ({"op": "recolour", "instances": 2, "color": [0, 0, 256]}, "whole numbers of 0 to 255."),
        ({"op": "duplicate", "instance": 2, "name": "lamp"}, "name is 'lamp'; there is an object of this name"),
        ({"op": "relabel", "instance": 2, "name": "background"}, "the background goes by this name; give it"),
        ({"op": "relabel", "instance": 2, "name": ""}, "name is ''; it must be a text that is not empty."),
        ({"op": "relabel", "instance": 2, "kind": "tool"}, 'kind is \'tool\'; it must be "thing" or "stuff".'),
        ({"op": "merge", "instances": [2]}, "instances is [2]; it must name at least 2 instances."),
        ({"op": "merge", "instances": [2, "red mug"]}, "it must name at least 2 instances."),
        ({"op": "split", "instance": 2}, "instance is 2; it has no parts to split it by"),
        ({"op": "replace", "instance": 2, "run": "no/such", "by": 1}, "run is 'no/such'; here/no/such is not the"),
        ({"op": "replace", "instance": 2, "run": "x", "by": 1, "scale": "big"}, 'it must be "fit" (the size of what'),
    ],
)  # fmt: skip
def test_a_fault_is_told_with_the_operation_the_field_and_what_would_be_right(step, sentence):
    with pytest.raises(InputError, match=re.escape(sentence)) as refused:
        checked(step)
    assert str(refused.value).endswith((".", "?")) and "?." not in str(refused.value)


@pytest.mark.parametrize(
    ("script", "sentence"),
    [
        ([], "an edit script is a JSON object"),
        ({"operations": {}}, "an edit script is a JSON object"),
        ({"version": 2, "operations": []}, "has the version 2; this program reads version 1."),
        ({"operations": [], "undo": 1}, "has the field 'undo'; it takes version, operations and comment."),
    ],
)
def test_what_is_no_script_is_refused(script, sentence):
    with pytest.raises(InputError, match=re.escape(sentence)):
        check(script, Objects.of(copy.deepcopy(DOCUMENT), scene()), Path())


def test_a_later_operation_sees_what_the_earlier_ones_made():
    with pytest.raises(InputError, match=r"operation 2 \(recolour\): instances is 2; no instance goes by 2"):
        checked({"op": "remove", "instances": 2}, {"op": "recolour", "instances": 2, "color": "#000000"})
    _, objects = applied(
        {"op": "duplicate", "instance": "red mug", "move": [1, 0, 0]},
        {"op": "transform", "instances": "red mug 2", "scale": 2.0},
        {"op": "relabel", "instance": "red mug 2", "name": "the other mug"},
    )
    assert objects.find("the other mug") == 8  # 7 is a group's


def test_ids_are_never_used_again():
    _, objects = applied(
        {"op": "duplicate", "instance": 2, "name": "first"},
        {"op": "remove", "instances": "first"},
        {"op": "duplicate", "instance": 2, "name": "second"},
    )
    assert objects.find("second") == 9


def test_an_empty_script_leaves_instances_json_but_for_the_places_as_it_was():
    now, objects = applied()
    document = objects.document(DOCUMENT, now)
    for old, new in zip(DOCUMENT["instances"], document["instances"], strict=True):
        changed = {key for key in old if old[key] != new[key]}
        assert changed <= {"bbox", "centroid", "num_gaussians", "file"}
    assert {**document, "instances": []} == {**DOCUMENT, "instances": []}


def test_objects_keep_their_order_of_fields_and_say_who_named_them():
    now, objects = applied({"op": "duplicate", "instance": 2}, {"op": "relabel", "instance": 4, "name": "bowl"})
    document = objects.document(DOCUMENT, now)
    assert all(list(e) == list(DOCUMENT["instances"][0]) for e in document["instances"])
    told = {e["id"]: (e["name"], e["named_by"], e["views"], e["file"]) for e in document["instances"]}
    assert told[8] == ("red mug 2", "script", [], "instances/0008.ply")
    assert told[4] == ("bowl", "script", ["a", "b"], "instances/0004.ply")


def test_merging_makes_parts_of_what_had_none_and_splitting_gives_them_back():
    merge = {"op": "merge", "instances": ["red bowl", "lamp", 2], "name": "still life"}
    now, objects = applied(merge)
    assert objects.names() == ["still life", "speck"] and objects.parts[4] == {1: 40, 2: 30, 3: 20, 4: 40}
    assert np.array_equal(now.instance_id > 0, scene().instance_id > 0)
    entry = objects.document(DOCUMENT, now)["instances"][0]
    assert entry["num_parts"] == 4 and entry["num_points"] == 140 and entry["id"] == 4
    apart, objects = applied(merge, {"op": "split", "instance": 4})
    pairs = np.stack([scene().instance_id * 10 + scene().part_id, apart.instance_id])
    assert len(np.unique(pairs, axis=1).T) == len(np.unique(pairs[0])) == len(np.unique(pairs[1]))
    assert objects.names() == ["speck", *(f"still life part {p}" for p in (1, 2, 3, 4))]


def test_instances_that_only_masks_show_lie_together_where_both_lie_when_they_are_merged():
    faint = [
        {**DOCUMENT["instances"][3], "id": 5, "bbox": {"min": [0, 0, 0], "max": [1, 2, 1]}, "centroid": [0.5, 1, 0.5]},
        {**DOCUMENT["instances"][3], "id": 6, "name": "mote", "bbox": {"min": [3, 1, -1], "max": [4, 4, 0]},
         "centroid": [3.5, 2, -0.5], "num_points": 120},
    ]  # fmt: skip
    document = {**DOCUMENT, "instances": [*DOCUMENT["instances"][:3], *faint]}
    script = {"operations": [{"op": "merge", "instances": [5, "mote"]}]}
    steps, objects = check(script, Objects.of(copy.deepcopy(document), scene()), Path("here"))
    merged = objects.document(document, steps[0].apply(scene()))["instances"][-1]
    assert (merged["id"], merged["num_points"], merged["file"]) == (5, 160, None)
    assert merged["bbox"] == {"min": [0, 0, -1], "max": [4, 4, 1]} and merged["centroid"] == [2.75, 1.75, -0.25]


_AWAY = {"move": [1, 0, 0]}


@pytest.mark.parametrize(
    ("steps", "count"),
    [
        ([{"op": "transform", "instances": 3, **_AWAY}], 1),
        ([{"op": "duplicate", "instance": 3, **_AWAY}], 1),
        ([{"op": "transform", "instances": 3, **_AWAY}, {"op": "split", "instance": 3}], 2),
        (
            [
                {"op": "duplicate", "instance": 2, **_AWAY},
                {"op": "merge", "instances": [4, 8]},
                {"op": "split", "instance": 4},
            ],
            1,
        ),
    ],
)
def test_what_is_not_where_photos_show_it_has_no_views_and_no_points_nor_have_its_parts(steps, count):
    now, objects = applied(*steps)
    unseen = [entry for entry in objects.document(DOCUMENT, now)["instances"] if not entry["num_points"]]
    assert len(unseen) == count
    for entry in unseen:
        assert entry["views"] == [] and all(part["num_points"] == 0 for part in entry["parts"])
        assert objects.dense[entry["id"]] == set()


def test_what_belongs_to_no_part_keeps_the_id_when_an_instance_is_split():
    whole = scene()
    parts = whole.part_id.copy()
    parts[np.flatnonzero(whole.instance_id == 3)[0]] = 0
    now = EditedScene(**{**vars(whole), "part_id": parts})
    steps, objects = check(
        {"operations": [{"op": "split", "instance": "lamp"}]},
        Objects.of(copy.deepcopy(DOCUMENT), now),
        Path(),
    )
    after = steps[0].apply(now)
    assert [(after.instance_id == i).sum() for i in (3, 8, 9)] == [1, 1, 2]
    assert {i: e["num_points"] for i, e in objects.entries.items() if i in (3, 8, 9)} == {3: 10, 8: 30, 9: 20}


def test_the_dense_points_of_what_has_left_no_longer_count():
    steps, _ = checked(
        {"op": "merge", "instances": [2, 4]},
        {"op": "transform", "instances": 3, "move": [0, 0, 1]},
        {"op": "split", "instance": 3},
        {"op": "remove", "instances": [2, "lamp part 1"]},
        {"op": "keep", "instances": [0]},
    )
    assert [step.gone for step in steps] == [(), (3,), (3,), (2, 3, 4), (2, 3, 4, 5)]
    assert [step.leaving for step in steps] == [(), (3,), (), (2, 8), ()]


def test_the_dense_points_of_the_background_leave_with_it():
    steps, _ = checked({"op": "remove", "instances": ["background", 2]}, {"op": "remove", "instances": [3]})
    assert [step.gone for step in steps] == [(0, 2), (0, 2, 3)]
    assert [step.leaving for step in steps] == [(2,), (3,)]
    steps, _ = checked({"op": "keep", "instances": [2, 3]}, {"op": "remove", "instances": [3]})
    assert [step.gone for step in steps] == [(0, 4, 5), (0, 3, 4, 5)]


def test_groups_lose_what_has_left_them():
    now, objects = applied({"op": "transform", "instances": 3, "move": [0, 0, 1]})
    assert objects.document(DOCUMENT, now)["groups"][0]["instances"] == [4]
    now, objects = applied({"op": "remove", "instances": [3, 4]})
    assert objects.document(DOCUMENT, now)["groups"] == []


def test_what_an_instance_is_split_into_is_part_of_its_groups():
    now, objects = applied({"op": "split", "instance": 3}, {"op": "remove", "instances": 4})
    document = objects.document(DOCUMENT, now)
    assert {e["id"]: e["parent"] for e in document["instances"]} == {2: None, 5: None, 8: 7, 9: 7}
    assert [(group["id"], group["instances"]) for group in document["groups"]] == [(7, [8, 9])]
    assert DOCUMENT["groups"][0]["instances"] == [3, 4]


def test_checking_changes_nothing_that_it_was_given():
    before = copy.deepcopy(DOCUMENT)
    objects = Objects.of(DOCUMENT, scene())
    check({"operations": [{"op": "remove", "instances": [2, 3]}]}, objects, Path())
    assert before == DOCUMENT and sorted(objects.entries) == [2, 3, 4, 5]


PAGE = (Path(__file__).parents[2] / "docs" / "editing.md").read_text(encoding="utf-8")


def test_the_page_lists_every_operation_with_the_fields_that_it_takes():
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+?) \| .+ \|$", PAGE, re.MULTILINE))
    assert rows.keys() == _OPERATIONS.keys()
    valid = {
        "instance": 3, "instances": [2, 3], "run": "x", "by": 1, "color": "#000000",
    }  # fmt: skip
    for op, fields in rows.items():
        told = set(re.findall(r"`(\w+)`", fields.replace("those of `transform`", "`move` `rotate` `scale` `pivot`")))
        given = {"op": op, "nonsense": 1, **{name: value for name, value in valid.items() if name in told}}
        with pytest.raises(InputError) as refused:
            checked(given)
        if op != "replace":  # which finds first that there is no such run
            taken = re.search(r"it takes (.+?)[.;]", str(refused.value)).group(1).split(", ")
            assert set(taken) - {"op", "comment"} == told, op


def test_the_script_of_the_page_passes():
    document = copy.deepcopy(DOCUMENT)
    names = {2: "red object", 3: "blue object", 4: "green object", 5: "speck"}
    for known in document["instances"]:
        known["name"] = names[known["id"]]
    script = json.loads(re.search(r"```json\n(.*?)```", PAGE, re.DOTALL).group(1))
    steps, objects = check(script, Objects.of(document, scene()), Path())
    assert [step.op for step in steps] == ["remove", "transform", "recolour", "duplicate"]
    assert objects.names() == ["blue object", "toolbox", "second toolbox"]
