"""Points picked in the viewer where things are joined or broken, and the run that goes by them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from faulty_masks import places_to_click, write_faulty_masks
from scipy.spatial.transform import Rotation
from tiny_runs import ROOM, Called, run_tiny, ss_flow

pytest.importorskip("viser", reason="needs the extra `view`")
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import StoreOptions, open_run
from ss_flow.flows.generated import generate, write_scene
from ss_flow.flows.results import FinishedRun
from ss_flow.flows.view.corrections import Corrections
from ss_flow.flows.view.viewer import Viewer
from ss_flow.tasks.geometry.cameras import camera_of

TABLE, SOFA, MUG = 1, 3, 4
FAULTY = "--set=propagate.touching_merge=false"
"""Else the halves of the sofa, alike and side by side, would find together."""


class Faulty:
    """A tiny run of a room in which the mug and the table are one thing, and the sofa is two."""

    def __init__(self, folder: Path) -> None:
        room = generate(replace(ROOM, width=192, height=144))  # masks drawn from points need pixels
        self.scene, self.store, self.out = folder / "room", folder / "store", folder / "out"
        write_scene(room, self.scene)
        write_faulty_masks(room, self.scene / "instance_masks", joined=(TABLE, MUG), broken=SOFA)
        self.called = self.run()

    def run(self, *more: str | Path, out: Path | None = None) -> Called:
        called = run_tiny(self.scene, self.store, FAULTY, *more, out=out or self.out)
        assert called.code == 0, called.err
        return called

    def finished(self) -> FinishedRun:
        return open_run(self.out, StoreOptions(self.store), ("scene", "cameras"))


@pytest.fixture(scope="module")
def faulty(tmp_path_factory) -> Faulty:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SS_FLOW_MODELS", "")
        return Faulty(tmp_path_factory.mktemp("faulty"))


@pytest.fixture
def viewer(faulty, tmp_path):
    viewer = Viewer(faulty.finished(), tmp_path / "s.json", hints=tmp_path / "out.hints.json", port=0)
    yield viewer
    viewer.close()


def click(viewer: Viewer, run: FinishedRun, view: int, row: int, column: int) -> None:
    """Click a pixel as a browser does that stands where a photo was taken."""
    camera = camera_of(run.results.one("cameras"), view)
    turn = camera.world_to_camera[:3, :3]
    ray = turn.T @ [(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1]
    looking = SimpleNamespace(
        image_width=camera.width,
        image_height=camera.height,
        fov=2 * np.arctan(camera.height / 2 / camera.fy),
        wxyz=Rotation.from_matrix(turn.T).as_quat(scalar_first=True),
    )
    client = SimpleNamespace(camera=looking, add_notification=lambda *told, **_: pytest.fail(f"{told}"))
    viewer.panel._clicked(SimpleNamespace(client=client, ray_origin=camera.center, ray_direction=ray), more=False)


def best_ious(ids: np.ndarray, shown: np.ndarray) -> tuple[int, float]:
    """The instance that shows something best in all views together, and how well."""
    union = {i: ((ids == i) & shown).sum() / ((ids == i) | shown).sum() for i in np.unique(ids[shown]).tolist()}
    best = max(union, key=union.__getitem__)
    return best, float(union[best])


def test_a_joined_pair_is_parted_and_a_broken_thing_joined_and_only_what_depends_on_it_computed(
    faulty, viewer, tmp_path
):
    run = faulty.finished()
    real, before = (np.stack([one.ids for one in run.results.all(name)]) for name in ("truth", "masks_split"))
    assert best_ious(before, real == MUG)[0] == best_ious(before, real == TABLE)[0]
    assert best_ious(before, real == SOFA)[1] < 0.75

    correcting = viewer.panel.correcting
    correcting.box.value = True
    for thing, *place in places_to_click(run, joined=(TABLE, MUG), broken=SOFA):
        if thing > correcting.corrections.thing:
            correcting.corrections.next_thing()
        click(viewer, run, *place)
    assert not viewer.panel.session.selected  # such a click selects nothing
    assert [told.split()[-2:] for told in correcting.corrections.told()] == [["become", "one"], ["into", "2"]]
    assert "4 points, not all saved" in correcting._told.content and correcting.corrections.unsaved
    correcting.corrections.save()
    hints = tmp_path / "out.hints.json"
    assert not correcting.corrections.unsaved and len(json.loads(hints.read_text())) > 1

    again = faulty.run("--correct", hints, out=tmp_path / "again")
    corrected = open_run(tmp_path / "again", StoreOptions(faulty.store), ("scene", "cameras"))
    after = np.stack([one.ids for one in corrected.results.all("masks_split")])
    assert best_ious(after, real == MUG)[1] > 0.6
    assert best_ious(after, real == TABLE)[1] > 0.8
    assert best_ious(after, real == SOFA)[1] > 0.9
    computed = again.computed()
    upstream = {
        "capture.ingest.frames",
        "split.dense",
        "split.visibility",
        "split.observe",
        "split.propagate",
        "split.cut",
    }
    assert not upstream & computed.keys() and computed["split.correct"] == 1
    kept = {e["id"] for e in run.instances["instances"]} & {e["id"] for e in corrected.instances["instances"]}
    assert 0 < computed["splat.reconstruct"] < len(corrected.instances["instances"])
    assert len(kept) == len(run.instances["instances"]) - 3  # the pair, and both halves
    known = corrected.results.one("hierarchy").node.tolist()
    assert {e["id"] for e in corrected.instances["instances"]} <= {*known}  # so that kinds and groups are told of all

    gone_on = Corrections(corrected, hints)
    assert not gone_on.unsaved and gone_on.told() == [] and gone_on.thing == 4


def test_points_that_a_file_holds_show_as_soon_as_the_box_is_checked(faulty, viewer, tmp_path):
    panel = viewer.panel
    first = Corrections(faulty.finished(), tmp_path / "out.hints.json")
    first.pick(TABLE, np.array(first._cloud.points[first._seen & (first._instance.label == TABLE)][0], float))
    first.save()
    panel.correcting.box.value = True
    assert "1 point; now on thing 2" in panel.correcting._told.content and len(panel.correcting._marks) == 1
    panel.correcting.box.value = False
    assert not panel.correcting._marks


def test_points_are_undone_and_things_named_by_what_they_lie_on(faulty, tmp_path):
    run = faulty.finished()
    corrections = Corrections(run, tmp_path / "h.json")
    scene = run.results.one("scene")
    entry = run.instances["instances"][0]
    for place in scene.means[scene.instance_id == entry["id"]][[0, -1]]:
        corrections.pick(entry["id"], place.astype(np.float64))
        corrections.next_thing()
    assert corrections.told() == [f"{entry['name']} falls into 2"]
    named = {name for things in corrections.document().values() for name in things}
    assert named == {entry["name"], f"{entry['name']} 2"}
    corrections.undo()
    assert corrections.thing == 2 and corrections.told() == []
    corrections.undo()
    corrections.undo()
    assert corrections.document() == {} and corrections.thing == 1


def test_what_cannot_be_corrected_is_refused_in_a_sentence_without_a_path(faulty, viewer, tmp_path):
    run = faulty.finished()
    with pytest.raises(InputError, match="pick a point on an object"):
        Corrections(run, tmp_path / "h.json").pick(0, np.zeros(3))
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(InputError, match=r"^bad\.json holds no hints") as refused:
        Corrections(run, tmp_path / "bad.json")
    assert str(tmp_path) not in str(refused.value)
    run.document["scene"] = str(tmp_path / "gone")
    with pytest.raises(InputError, match="photos are not where they were"):
        Corrections(run, tmp_path / "h.json")
    viewer.panel.session.do({"op": "remove", "instances": [viewer.panel.session.state.objects.next_id - 1]})
    with pytest.raises(InputError, match="undo the edits first"):
        viewer.panel._correct(viewer.panel.correcting, None)


def test_corrections_of_a_view_that_is_not_there_are_refused(faulty, tmp_path):
    (tmp_path / "h.json").write_text(json.dumps({"9999": {"mug": [[1, 1]]}}))
    called = ss_flow("run", faulty.scene, "--correct", tmp_path / "h.json", "--cache", faulty.store)
    assert called.code == 2 and "'9999', which is no view" in called.err
