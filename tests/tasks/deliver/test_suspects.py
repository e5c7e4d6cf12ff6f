"""Each reason for a second look, and that nothing is said of a clean object."""

from __future__ import annotations

import numpy as np
import pytest
from view_masks import as_fields

from ss_flow.tasks.artifacts import Hierarchy, InstanceMasks
from ss_flow.tasks.deliver.suspects import suspects

SPACING = 0.01


def _block(x: float, y: float = 0.0) -> np.ndarray:
    """A cube of 10 x 10 x 10 points with its least corner at x, y."""
    grid = np.stack(np.meshgrid(*[np.arange(10) * SPACING] * 3), axis=-1).reshape(-1, 3)
    return (grid + np.array([x, y, 0])).astype(np.float32)


def _instance(number: int, points: np.ndarray, views: int = 20, confidence: float = 0.9) -> InstanceMasks:
    n = len(points)
    zeros = np.zeros(n, np.int32)
    return InstanceMasks(
        instance_id=number,
        points=points,
        colors=np.zeros((n, 3), np.uint8),
        point_confidence=np.ones(n, np.float32),
        point_part=zeros,
        confidence=confidence,
        views=tuple(f"v{i}" for i in range(views)),
        **as_fields(np.ones((views, 1, 8), bool)),
        origin=np.zeros(views, np.uint8),
        weak=False,
    )


def _found(
    *instances: InstanceMasks, groups=(), tree=((), ()), kinds=None, crumbs=(), gaussians=None
) -> dict[int, str]:
    entries = [
        {
            "id": one.instance_id,
            "name": f"thing {one.instance_id}",
            "kind": (kinds or {}).get(one.instance_id, "thing"),
            "crumb": one.instance_id in crumbs,
            "confidence": one.confidence,
            "num_gaussians": (gaussians or {}).get(one.instance_id, len(one.points)),
        }
        for one in instances
    ]
    nodes, agreement = tree
    hierarchy = Hierarchy(
        np.array(nodes, np.int32), np.zeros(len(nodes), np.int32), np.float32(agreement), np.zeros(len(nodes), bool)
    )
    document = {"instances": entries, "groups": list(groups)}
    told = suspects(instances, document, hierarchy, spacing=SPACING, num_views=20)
    assert all(one["name"] == f"thing {one['id']}" for one in told)
    return {one["id"]: "; ".join(one["reasons"]) for one in told}


def test_clean_objects_are_not_told_of() -> None:
    clean = [_instance(1, _block(0)), _instance(2, _block(1)), _instance(3, _block(2))]
    group = {"id": 9, "agreement": 0.3, "instances": [1, 2]}
    assert _found(*clean, groups=[group], tree=((1, 2, 3, 7), (1, 1, 0.6, 0.2))) == {}


def test_what_was_hardly_reconstructed_is_told_of() -> None:
    told = _found(*(_instance(i, _block(i)) for i in (1, 2, 3)), gaussians={1: 1, 2: 99, 3: 100})
    assert told == {
        1: "hardly anything of it was reconstructed: 1 Gaussian for 1,000 points",
        2: "hardly anything of it was reconstructed: 99 Gaussians for 1,000 points",
    }


def test_few_views_and_low_confidence_are_told_with_their_figures() -> None:
    told = _found(_instance(1, _block(0), views=2), _instance(2, _block(1), confidence=0.45), _instance(3, _block(2)))
    assert told == {1: "few views: it is seen in 2 of 20", 2: "low confidence: 45%"}


def test_what_is_doubtful_and_walls_without_confidence_are_not_told_of() -> None:
    assert _found(_instance(1, _block(0), views=2, confidence=0.09)) == {}
    assert _found(_instance(1, _block(0), confidence=0.09), kinds={1: "stuff"}) == {}
    assert _found(_instance(1, _block(0), confidence=0.1)) == {1: "low confidence: 10%"}


def test_an_object_in_places_apart_is_in_pieces_but_its_specks_and_walls_are_not() -> None:
    apart = np.concatenate([_block(0), _block(0.5)])
    speck = np.concatenate([_block(1), _block(2)[:50]])
    told = _found(_instance(1, apart), _instance(2, speck), _instance(3, apart + 5), kinds={3: "stuff"})
    assert told == {1: "in pieces: its points lie in 2 places apart"}


def test_what_nearly_half_of_the_views_show_as_one_thing_are_fragments_of_it() -> None:
    groups = [
        {"id": 8, "agreement": 0.44, "instances": [1, 2]},
        {"id": 9, "agreement": 0.41, "instances": [1, 2, 3]},
    ]
    told = _found(*(_instance(i, _block(i)) for i in (1, 2, 3)), groups=groups)
    assert told[1] == "a fragment: 44% of the views show it as one thing with thing 2", "the smallest group counts"
    assert told[3] == "a fragment: 41% of the views show it as one thing with thing 1, thing 2"
    many = [{"id": 9, "agreement": 0.5, "instances": [1, 2, 3, 4, 5, 6]}]
    told = _found(*(_instance(i, _block(i)) for i in range(1, 7)), groups=many)
    assert told[6] == "a fragment: 50% of the views show it as one thing with thing 1, thing 2, thing 3 and 2 more"


def test_what_hardly_half_of_the_views_show_as_one_thing_may_have_swallowed_a_neighbour() -> None:
    told = _found(_instance(7, _block(0)), tree=((5, 7), (1, 0.46)))
    assert told == {7: "a swallowed neighbour: only 46% of the views show all of it as one thing"}


@pytest.mark.parametrize(("shift", "collides"), [(0.01, True), (0.05, False)])
def test_things_that_fill_the_same_place_collide(shift: float, collides: bool) -> None:
    told = _found(_instance(1, _block(0)), _instance(2, _block(shift)))
    assert (told.keys() == {1, 2}) == collides
    if collides:
        assert told[1].startswith("boxes that collide: it fills the same place as thing 2 (IoU 0.")
    assert _found(_instance(1, _block(0)), _instance(2, _block(0)), kinds={2: "stuff"}) == {}


def test_crumbs_and_the_background_are_left_out() -> None:
    told = _found(_instance(1, _block(0), views=1), _instance(2, _block(0)), crumbs=(1,))
    assert told == {}
