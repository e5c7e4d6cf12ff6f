"""The stages of a run in the viewer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_gaussians import made_gaussians

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.results import FinishedRun, Results, finished_run, read_run
from ss_flow.flows.view.timeline import Round, Timeline, rounds, stages
from ss_flow.tasks.packed import ViewLists
from ss_flow.tasks.splat.collisions import MergePlan

viser = pytest.importorskip("viser", reason="needs the extra `view`")


@pytest.fixture(scope="module")
def run(tiny):
    return finished_run(tiny.out, read_run(tiny.out), Store(tiny.store), ())


@pytest.fixture
def scene():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server.scene
    server.stop()


def without(run, *names):
    kept = {name: digests for name, digests in run.results.digests.items() if name not in names}
    return replace(run, results=Results(run.store, kept))


def visible(scene) -> set[str]:
    """The stages that are shown, as "side/index"."""
    frames = [name for name in scene._handle_from_node_name if name.startswith("/timeline/") and name.count("/") == 3]
    return {name.removeprefix("/timeline/") for name in frames if scene.get_handle_by_name(name).visible}


def test_the_stages_go_from_sparse_points_to_the_scene(run):
    names = [stage.name for stage in stages(run)]
    assert names == [
        *("Sparse points", "Dense points", "Masks before", "Votes", "Labels", "Masks after", "Instances as trained"),
        *("Scene", "Final masks"),
    ]


def test_a_stage_whose_result_is_gone_is_left_out(run):
    names = [stage.name for stage in stages(without(run, "dense", "segment"))]
    assert "Sparse points" in names and "Scene" in names
    assert not {"Dense points", "Votes", "Labels", "Masks before"} & set(names)


@pytest.fixture
def merging(store):
    """A run that merges the second of four groups with the last, then that with the third, which only joins them."""
    groups = [store.put(made_gaussians(10 + i, 0, seed=i)) for i in range(4)]
    pair, joined = (store.put(made_gaussians(count, 0, seed=9)) for count in (24, 36))

    def plan(pairs: list[list[int]], singles: list[int]) -> str:
        return store.put(
            MergePlan(
                pairs=np.array(pairs, np.int32).reshape(-1, 2),
                scores=np.ones(len(pairs), np.float32),
                singles=np.array(singles, np.int32),
                mask_weight=0.05,
                collisions=np.zeros((4, 4), np.float32),
                **ViewLists.arrays([[0]] * len(pairs)),
            )
        )

    made = {
        **{("splat.retrain", str(i)): group for i, group in reversed(list(enumerate(groups)))},
        ("splat.plan", "0"): plan([[1, 3]], [0, 2]),
        ("splat.merge_pair", "0.1+3"): pair,
        ("splat.plan", "1"): plan([[0, 2]], [1]),
        ("splat.assemble", "1.0+2"): joined,
        ("splat.plan", "2"): plan([], [0, 1]),
        ("splat.assemble", ""): store.put(made_gaussians(46, 0)),
    }
    nodes = [{"step": step, "item": item, "outputs": [digest]} for (step, item), digest in made.items()]
    run = FinishedRun(store.root, {"nodes": nodes}, {"instances": []}, Results(store, {}))
    return run, groups, pair, joined


def test_rounds_of_merging_are_followed_from_plan_to_plan(merging):
    run, groups, pair, joined = merging
    assert rounds(run) == [Round(0, (pair,), (groups[0], groups[2])), Round(1, (joined,), (groups[0],))]
    assert [stage.name for stage in stages(run)] == ["Merge round 1", "Merge round 2"]


def test_a_round_whose_groups_are_gone_is_left_out(merging):
    run, groups, _, joined = merging
    run.store.discard(groups[2])
    assert rounds(run) == [Round(1, (joined,), (groups[0],))]


def test_what_merged_in_a_round_has_a_colour_of_its_own(merging, scene):
    timeline = Timeline(scene, merging[0])
    timeline.show(0)

    def colors(index: int) -> set[bytes]:
        buffer = scene.get_handle_by_name(f"/timeline/0/0/it/{index}").buffer
        return {row[:3].tobytes() for row in np.ascontiguousarray(buffer[:, 7]).view(np.uint8).reshape(-1, 4)}

    assert colors(1) == colors(2) == {bytes((200, 200, 200))} and len(colors(0)) == 1 and colors(0) != colors(1)


def test_one_stage_is_shown_at_a_time_and_drawn_once(run, scene):
    timeline = Timeline(scene, run)
    for index in range(len(timeline.names)):
        timeline.show(index)
        assert visible(scene) == {f"0/{index}"}
        assert any(name.startswith(f"/timeline/0/{index}/it") for name in scene._handle_from_node_name), index
    held = set(scene._handle_from_node_name)
    timeline.show(0)
    assert visible(scene) == {"0/0"} and set(scene._handle_from_node_name) == held
    timeline.show(None)
    assert visible(scene) == set()


def test_another_run_stands_beside_at_the_stages_that_both_have(run, scene):
    timeline = Timeline(scene, run, without(run, "dense"))
    timeline.show(timeline.names.index("Scene"))
    index = timeline.names.index("Scene")
    assert visible(scene) == {f"0/{index}", f"1/{index}"}
    points = run.results.one("dense").points
    away = np.asarray(scene.get_handle_by_name("/timeline/1").position)
    along = points @ (away / np.linalg.norm(away))
    assert np.linalg.norm(away) > np.ptp(np.percentile(along, (2, 98)))
    timeline.show(1)
    assert visible(scene) == {"0/1"}


def test_a_run_of_which_nothing_is_left_is_refused(run, scene):
    nothing = replace(without(run, *run.results.digests), document=run.document | {"nodes": []})
    with pytest.raises(InputError, match="holds no stage"):
        Timeline(scene, nothing)
