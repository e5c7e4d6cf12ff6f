"""The viewer in a browser: every operation clicked through, and the saved script run on the command line."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from browser import browser_page, needs_browser
from tiny_runs import run_tiny, ss_flow

from ss_flow.cache.store import Store
from ss_flow.flows.cli.context import StoreOptions, open_run
from ss_flow.tasks.artifacts import EditedScene
from ss_flow.tasks.geometry.cameras import project

pytest.importorskip("viser", reason="needs the extra `view`")
from viewer_hands import Hands, opened

from ss_flow.flows.view.viewer import Viewer

pytestmark = [
    needs_browser,
    pytest.mark.skipif("SS_FLOW_TEST_BROWSER" not in os.environ, reason="takes minutes; set SS_FLOW_TEST_BROWSER"),
]
_COUNT = """
window.flat = window.instanced = 0;
for (const [name, count] of [['drawArrays', () => flat++], ['drawElementsInstanced', () => instanced++]]) {
  const draw = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...all) {
    if ((all.length === 5 ? 6 * all[4] : all[2]) > 6000) count();
    return draw.apply(this, all);
  };
}
"""
"""Counts pictures of more than a thousand Gaussians by how they are drawn."""
_NO_NAME = """
const extension = WebGL2RenderingContext.prototype.getExtension;
WebGL2RenderingContext.prototype.getExtension = function (name) {
  return name === 'WEBGL_debug_renderer_info' ? null : extension.call(this, name);
};
"""
"""The browser does not tell what it draws with."""


@pytest.fixture
def hands(warm, tmp_path: Path) -> Iterator[Hands]:
    """Somebody who has opened the viewer of the tiny run."""
    with opened(warm, tmp_path) as hands:
        yield hands


def test_what_is_chosen_from_the_list_is_looked_at(hands):
    session, page = hands.session, hands.page
    page.evaluate("buttons('Look at')[0].click()")
    page.wait_for("document.body.innerText.includes('select an object')")
    for chosen in list(session.state.objects.entries)[:3]:
        if chosen not in session.state.pieces:
            continue
        hands.pick(chosen)
        hands.until(lambda chosen=chosen: session.selected == (chosen,))
        place = np.median(session.state.pieces[chosen].gaussians.means, axis=0)
        hands.key("f", "KeyF")
        hands.until(lambda place=place: hands.is_in_the_middle(place))


def test_every_operation_is_clicked_through_and_the_script_gives_the_scene_that_was_seen(hands, warm, tmp_path):
    session, page = hands.session, hands.page
    first, second = list(hands.seen())[:2]

    hands.click(hands.pixel_of(first))
    hands.until(lambda: session.selected == (first,))
    hands.click(hands.pixel_of(second), modifiers=8)
    hands.until(lambda: session.selected == (first, second))
    hands.click(hands.pixel_of(first))
    hands.until(lambda: session.selected == (first,))
    hands.press("Hide", lambda: first not in session.visible())
    hands.press("Show all", lambda: first in session.visible())
    hands.press("Isolate", lambda: set(session.visible()) == {first})
    hands.press("Show all", lambda: second in session.visible())

    hands.press("Move", lambda: hands.viewer.panel.nodes.gizmo is not None)
    gizmo = hands.viewer.panel.nodes.gizmo
    hands.drag(gizmo)
    hands.until(lambda: len(session.state.done) == 1)
    moved = session.state.done[0]["move"]
    assert abs(moved[0]) > 10 * max(abs(moved[1]), abs(moved[2]))  # along the red arrow
    (tmp_path / "moved.png").write_bytes(page.screenshot())

    hands.fill("Name", "toolbox")
    hands.press("Rename", lambda: session.state.objects.name(first) == "toolbox")
    hands.press("Recolour", lambda: session.state.done[-1]["op"] == "recolour")
    hands.fill("Scale factor", "1.5")
    hands.until(lambda: hands.viewer.panel.factor.value == 1.5)  # a browser tells typed numbers a moment later
    hands.press("Scale", lambda: session.state.done[-1].get("scale") == 1.5)
    hands.press("Duplicate", lambda: session.state.done[-1]["op"] == "duplicate" and session.selected != (first,))
    copy = session.selected[0]

    hands.press("Undo", lambda: copy not in session.state.pieces)
    hands.press("Redo", lambda: copy in session.state.pieces)
    hands.key("z", "KeyZ", 2)
    hands.until(lambda: copy not in session.state.pieces)
    hands.key("Z", "KeyZ", 2 | 8)
    hands.until(lambda: copy in session.state.pieces)

    hands.pick(copy)
    hands.until(lambda: session.selected == (copy,))
    hands.key("Delete", "Delete")
    hands.until(lambda: copy not in session.state.pieces)

    hands.pick(second)
    hands.until(lambda: session.selected == (second,))
    page.evaluate("field('Select several').click()")
    hands.until(lambda: hands.viewer.panel.several.value)
    hands.pick(first)
    hands.until(lambda: session.selected == (second, first))
    hands.press("Merge", lambda: first not in session.state.objects.entries)
    hands.press("Split", lambda: session.state.done[-1]["op"] == "split")

    hands.fill("Search", "toolbox")  # no colour word
    page.wait_for("document.body.innerText.includes('colour')")
    hands.fill("Search", "red")
    page.wait_for("/[0-9]+ match|Nothing in the scene/.test(document.body.innerText)")
    hands.fill("Search", "")

    assert hands.viewer.panel.unsaved
    hands.press("Save", lambda: not hands.viewer.panel.unsaved)
    page.wait_for("document.body.innerText.includes('script.json')")
    (tmp_path / "saved.png").write_bytes(page.screenshot())
    script = json.loads((tmp_path / "script.json").read_text())
    assert [step["op"] for step in script["operations"]] == [
        "transform", "relabel", "recolour", "transform", "duplicate", "remove", "merge", "split",
    ]  # fmt: skip
    assert not [text for text in page.complaints if not text.startswith("THREE.")]

    edited = ss_flow(
        "edit", warm.out, tmp_path / "script.json", "--out", tmp_path / "edited", "--cache", warm.store, "--json"
    )
    assert edited.code == 0, edited.err
    scene = Store(warm.store).get(edited.document()["results"]["scene"])
    for field in fields(EditedScene):
        assert np.array_equal(getattr(session.scene(), field.name), getattr(scene, field.name)), field.name


def test_points_are_picked_on_things_and_saved_for_a_run_that_goes_by_them(hands, tmp_path):
    first, second = list(hands.seen())[:2]
    correcting = hands.viewer.panel.correcting
    hands.page.evaluate("field('Correct by clicks').click()")
    hands.until(lambda: correcting.box.value)
    hands.click(hands.pixel_of(first))
    hands.page.wait_for("document.body.innerText.includes('1 point, not all saved; now on thing 1')")
    hands.press("Next thing", lambda: correcting.corrections.thing == 2)
    for count in (2, 3):
        hands.click(hands.pixel_of(second))
        hands.until(lambda count=count: len(correcting.corrections.picks) == count)
    hands.press("Undo point", lambda: len(correcting.corrections.picks) == 2)
    (tmp_path / "picked.png").write_bytes(hands.page.screenshot())
    hands.press("Save hints", lambda: not correcting.corrections.unsaved)
    hands.page.wait_for("document.body.innerText.includes('2 points in hints.json')")
    assert json.loads((tmp_path / "hints.json").read_text()) == correcting.corrections.document()
    names = {hands.session.state.objects.name(i) for i in (first, second)}
    assert {name for things in correcting.corrections.document().values() for name in things} == names
    assert not hands.session.selected and not hands.session.state.done
    assert not [text for text in hands.page.complaints if not text.startswith("THREE.")]


@pytest.mark.parametrize("kind", ["outlines", "photos", "masks", "depth"])
def test_cameras_stand_in_the_scene_with_what_they_saw(hands, tmp_path, kind):
    page = hands.page
    page.evaluate("field('Cameras').click()")
    mine = f"o.parentElement.textContent.includes('outlines') && o.textContent === '{kind}'"
    option = f"[...document.querySelectorAll('[role=option]')].find(o => {mine})"
    page.wait_for(f"!!{option}")
    page.evaluate(f"{option}.click()")
    hands.until(lambda: len(hands.viewer.cameras.frusta) == 5)
    assert all((frustum.image is None) == (kind == "outlines") for frustum in hands.viewer.cameras.frusta)
    (tmp_path / "cameras.png").write_bytes(page.screenshot())
    assert not [text for text in page.complaints if not text.startswith("THREE.")]


def test_the_slider_goes_through_the_stages_and_back_to_the_scene(hands, tmp_path):
    page, timeline = hands.page, hands.viewer.timeline
    hands.open_stages()
    now, pictures = hands.looked(), {}
    for number, name in enumerate(timeline.names, 1):
        hands.slide("Stage", number, len(timeline.names))
        page.wait_for(f"[...document.querySelectorAll('b')].some(b => b.innerText === {json.dumps(name)})")
        hands.until(lambda number=number: [n for (n, _), shown in timeline._drawn.items() if shown] == [number - 1])
        pictures[name] = hands.looked()
        (tmp_path / f"{number} {name}.png").write_bytes(page.screenshot())
    different = [
        (one, other)
        for one, other in itertools.combinations(pictures, 2)
        if np.abs(pictures[one] - pictures[other]).mean() > 0.5
    ]
    assert len(different) == len(pictures) * (len(pictures) - 1) / 2  # no two look alike
    page.evaluate("thumb('Stage').focus()")
    for kind in ("rawKeyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key="Home", code="Home")
    page.wait_for("thumb('Stage').getAttribute('aria-valuenow') === '0'")
    hands.until(lambda: not any(timeline._drawn.values()))
    assert np.abs(hands.looked() - now).mean() < 0.5
    assert not [text for text in page.complaints if not text.startswith("THREE.")]


def test_another_run_stands_to_the_right_at_the_same_stage(warm, tmp_path):
    other = run_tiny(warm.scene, warm.store, "--set=split.dense.max_points=2000", out=tmp_path / "other")
    assert other.code == 0, other.err
    with opened(warm, tmp_path, tmp_path / "other", 1500) as hands:
        page, timeline = hands.page, hands.viewer.timeline
        hands.open_stages()
        number = timeline.names.index("Dense points") + 1
        hands.slide("Stage", number, len(timeline.names))
        hands.until(
            lambda: {key for key, shown in timeline._drawn.items() if shown} == {(number - 1, 0), (number - 1, 1)}
        )
        near = hands.looked()
        for _ in range(6):  # away from the scene, until both are in the picture
            page.call("Input.dispatchMouseEvent", type="mouseWheel", x=250, y=300, deltaX=0, deltaY=400)
        far = hands.looked()
        (tmp_path / "beside.png").write_bytes(page.screenshot())
        assert np.abs(far - near).mean() > 1
        sides = [hands.viewer.server.scene.get_handle_by_name(f"/timeline/{k}/{number - 1}/it") for k in (0, 1)]
        runs = [open_run(out, StoreOptions(warm.store), ("dense",)) for out in (warm.out, tmp_path / "other")]
        assert [len(side.points) for side in sides] == [len(run.results.one("dense").points) for run in runs]
        assert len(sides[1].points) < len(sides[0].points)
        place = np.asarray(hands.viewer.server.scene.get_handle_by_name("/timeline/1").position)
        for side, away in zip(sides, (np.zeros(3), place), strict=True):
            x, y = np.median(project(side.points.astype(np.float64) + away, hands.camera())[0], axis=0)
            shown = far[int(y) - 150 - 15 : int(y) - 150 + 15, int(x) - 15 : int(x) + 15]
            assert shown.size and (shown.min(axis=-1) < 200).mean() > 0.2, (x, y)  # the page is white
        assert not [text for text in page.complaints if not text.startswith("THREE.")]


def test_triangles_in_one_list_look_like_an_instance_each(warm, tmp_path):
    pictures = {}
    for kept in (True, False):
        run = open_run(warm.out, StoreOptions(warm.store), ("scene", "cameras"))
        viewer = Viewer(run, tmp_path / "script.json", port=0)
        with browser_page(900, 600) as page:
            page.call("Page.addScriptToEvaluateOnNewDocument", source=_COUNT + ("" if kept else _NO_NAME))
            page.open(viewer.address)
            page.wait_for("document.querySelectorAll('button').length > 12")
            hands = Hands(page, viewer)
            hands.until(hands.has_arrived)
            pictures[kept] = hands.looked()
            flat, instanced = page.evaluate("[flat, instanced]")
            assert (flat > 3 and instanced == 0) if kept else (flat == 0 and instanced > 3)
            assert not [text for text in page.complaints if not text.startswith("THREE.")]
        viewer.close()
    assert pictures[True].std() > 5
    error = np.mean((pictures[True] - pictures[False]) ** 2)  # Gaussians of one depth may come in another order
    assert 10 * np.log10(255**2 / max(error, 1e-9)) > 45
