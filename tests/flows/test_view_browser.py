"""The viewer in a browser: every operation clicked through, and the saved script run on the command line."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from browser import Page, browser_page, needs_browser
from scipy.spatial.transform import Rotation
from tiny_runs import run_tiny, ss_flow

from ss_flow.cache.store import Store
from ss_flow.flows.cli.context import StoreOptions, open_run
from ss_flow.flows.cli.view import search_of
from ss_flow.tasks.artifacts import EditedScene, Float64
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, project

pytest.importorskip("viser", reason="needs the extra `view`")
from ss_flow.flows.view.viewer import Viewer

if TYPE_CHECKING:
    import viser

pytestmark = [
    needs_browser,
    pytest.mark.skipif("SS_FLOW_TEST_BROWSER" not in os.environ, reason="takes minutes; set SS_FLOW_TEST_BROWSER"),
]
_ARROW, _ARROW_BELOW_THE_MOUSE = (255, 44, 104), (229, 226, 127)
"""Colours that viser's page draws the first arrow of a gizmo in, over white or a scene."""
_LOOK = """
window.buttons = text => [...document.querySelectorAll('button')].filter(b => b.innerText.trim() === text);
window.field = label => {
  let found = [...document.querySelectorAll('label, div, span, p')].find(
    e => e.children.length === 0 && e.textContent.trim() === label);
  while (found && !found.querySelector('input')) found = found.parentElement;
  return found.querySelector('input');
};
window.thumb = label => {
  let found = [...document.querySelectorAll('label, div, span, p')].find(
    e => e.children.length === 0 && e.textContent.trim() === label);
  while (found && !found.querySelector('[role=slider]')) found = found.parentElement;
  return found.querySelector('[role=slider]');
};
"""

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


class Hands:
    """Somebody at the viewer's page."""

    def __init__(self, page: Page, viewer: Viewer) -> None:
        self.page, self.viewer, self.session = page, viewer, viewer.panel.session

    def has_arrived(self) -> bool:
        """Whether the page has come, and shows the scene from where it is to be looked at first."""
        clients = self.viewer.server.get_clients().values()
        first = self.viewer.server.initial_camera.position
        return any(np.allclose(client.camera.position, first, atol=1e-4) for client in clients)

    def until(self, told: Callable[[], object], seconds: float = 120) -> None:
        """Wait until something has come of what was done."""
        end = time.monotonic() + seconds
        while not told():
            assert time.monotonic() < end, (self.session.script(), self.session.selected, self.page.complaints)
            time.sleep(0.05)

    def press(self, text: str, told: Callable[[], object]) -> None:
        """Press a button."""
        self.page.evaluate(f"buttons({json.dumps(text)})[0].click()")
        self.until(told)

    def pick(self, instance: int) -> None:
        """Press an object's row in the list."""
        entry = self.session.state.objects.entries[instance]
        label = json.dumps(f"{entry['name']} · {entry['confidence']:.2f}")
        self.until(self.has_listed)
        self.page.wait_for(f"buttons({label}).length === 1")
        self.page.evaluate(f"buttons({label})[0].click()")

    def has_listed(self) -> bool:
        """Whether the page's list shows what the server's does: a browser is a moment behind."""
        with self.viewer.panel.lock:  # what is being done is shown, too, before it is let go
            listed = [row.button.label for row in self.viewer.panel.objects.rows]
        drawn = self.page.evaluate("[...document.querySelectorAll('button')].map(b => b.innerText.trim())")
        return [text for text in drawn if " · " in text or text == "background"] == listed

    def fill(self, label: str, text: str) -> None:
        """Type into the field beside a label, in the place of what stands there."""
        self.page.evaluate(f"field({json.dumps(label)}).focus(); field({json.dumps(label)}).select()")
        self.page.call("Input.insertText", text=text)

    def key(self, key: str, code: str, modifiers: int = 0) -> None:
        """Press a key; modifiers: 2 is Ctrl, 8 is Shift."""
        self.page.evaluate("document.activeElement.blur()")
        for kind in ("rawKeyDown", "keyUp"):
            self.page.call("Input.dispatchKeyEvent", type=kind, key=key, code=code, modifiers=modifiers)

    def click(self, place: Float64, modifiers: int = 0) -> None:
        """Click a pixel of the scene."""
        self.mouse("mousePressed", place, modifiers)
        self.mouse("mouseReleased", place, modifiers)

    def mouse(self, kind: str, place: Float64, modifiers: int = 0, *, held: bool = True) -> None:
        """held: whether the left button is down meanwhile."""
        x, y = (float(v) for v in place)
        button = {"button": "left", "buttons": 1, "clickCount": 1} if held else {}
        self.page.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, modifiers=modifiers, **button)

    def drawn(self, places: Float64, color: tuple[int, int, int]) -> list[int]:
        """At which of these places [N, 2] the page shows a colour."""
        picture = cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
        shown = cv2.dilate((np.abs(picture.astype(int) - color).max(axis=-1) < 40).astype(np.uint8), np.ones((5, 5)))
        return [i for i, (x, y) in enumerate(places.astype(int)) if shown[y, x]]

    def drag(self, gizmo: viser.TransformControlsHandle) -> None:
        """Drag the gizmo by its first arrow, by half of its length. Each step waits for what the page draws or tells of
        the one before: a browser that draws on the processor may take seconds for a frame."""
        told: list[str] = []
        gizmo.on_update(lambda event: told.append(event.phase))
        along = np.linspace(0.5, 1.5, 21)[:, None] * (gizmo.scale, 0, 0)
        arrow = project(gizmo.position + along, self.camera())[0]
        self.until(lambda: self.drawn(arrow[:10], _ARROW))
        grip = self.drawn(arrow[:10], _ARROW)[-1]
        self.mouse("mouseMoved", arrow[grip], held=False)
        self.until(lambda: self.drawn(arrow[grip : grip + 1], _ARROW_BELOW_THE_MOUSE))
        self.mouse("mousePressed", arrow[grip])
        self.until(lambda: "start" in told)
        for place in arrow[[grip + 3, grip + 7, grip + 10]]:
            before = gizmo.position
            self.mouse("mouseMoved", place)
            self.until(lambda before=before: not np.array_equal(gizmo.position, before))
        self.mouse("mouseReleased", arrow[grip + 10])
        self.until(lambda: "end" in told)

    def open_stages(self) -> None:
        """Unfold the part of the panel with the time line, and bring its slider into the window."""
        title = "[...document.querySelectorAll('*')].filter(e => e.innerText === 'How it came about').at(-1)"
        self.page.evaluate(f"{title}.click()")
        self.page.wait_for("thumb('Stage')?.getBoundingClientRect().height > 0")
        time.sleep(1)  # it unfolds step by step
        self.page.evaluate("thumb('Stage').scrollIntoView({block: 'center'})")

    def slide(self, label: str, value: int, last: int) -> None:
        """Press the mouse on a slider that goes from 0 to `last`, until it is where it is wanted; it may unfold yet."""
        thumb = f"thumb({json.dumps(label)})"

        def is_there() -> bool:
            box = (
                f"(b => [b.x, b.width, b.y, b.height])({thumb}.closest('[class*=Slider-root]').getBoundingClientRect())"
            )
            x, width, y, height = self.page.evaluate(box)
            self.click(np.array([x + min(value / last, 0.99) * width, y + height / 2]))
            time.sleep(1)
            return self.page.evaluate(f"{thumb}.getAttribute('aria-valuenow')") == str(value)

        self.until(is_there)

    def looked(self) -> Float64:
        """[H, W, 3] what the page shows of the scene, once two pictures of it are the same."""
        end, before = time.monotonic() + 240, b""
        while time.monotonic() < end:
            time.sleep(1)
            now = self.page.screenshot()
            if now == before:
                picture = cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR_RGB)
                return picture[150:, :-350].astype(np.float64)  # below viser's notice, left of the panel
            before = now
        raise TimeoutError("the page does not come to rest")

    def camera(self) -> Camera:
        """What the browser shows the scene with, in its pixels."""
        (client,) = self.viewer.server.get_clients().values()
        seen = client.camera
        focal = seen.image_height / 2 / np.tan(seen.fov / 2)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(seen.wxyz, scalar_first=True).as_matrix().T
        pose[:3, 3] = -pose[:3, :3] @ seen.position
        return Camera(
            seen.image_width, seen.image_height, focal, focal, seen.image_width / 2, seen.image_height / 2, pose
        )

    def is_in_the_middle(self, place: Float64) -> bool:
        """Whether the page shows a place in the middle, and from another place than at first."""
        camera = self.camera()
        (pixel,), _ = project(place[None], camera)
        return np.linalg.norm(pixel - (camera.width / 2, camera.height / 2)) < 3 and not self.has_arrived()

    def seen(self) -> dict[int, Float64]:
        """Of each instance, pixels that show it, left of the panel; those of most pixels first."""
        camera = self.camera()
        top = render(self.session.scene(), camera).top_contributor[20:-20:4, 20:-350:4]
        shown = np.where(top < 0, 0, self.session.scene().instance_id[top])
        found = {i: 4.0 * np.argwhere(shown == i)[:, ::-1] + 20.5 for i in np.unique(shown).tolist() if i}
        return dict(sorted(found.items(), key=lambda item: -len(item[1])))

    def pixel_of(self, instance: int) -> Float64:
        """A pixel that shows it, in the middle of those that do."""
        places = self.seen()[instance]
        return places[np.linalg.norm(places - np.median(places, axis=0), axis=1).argmin()]


@pytest.fixture
def hands(warm, tmp_path: Path) -> Iterator[Hands]:
    """Somebody who has opened the viewer of the tiny run."""
    with opened(warm, tmp_path) as hands:
        yield hands


@contextlib.contextmanager
def opened(warm, folder: Path, beside: Path | None = None, width: int = 900) -> Iterator[Hands]:
    """The viewer of the tiny run, as `ss-flow view` puts it together.

    beside: the output folder of another run. width: of the window, pixels.
    """
    run = open_run(warm.out, StoreOptions(warm.store), ("scene", "cameras"))
    viewer = Viewer(run, folder / "script.json", (), search_of(run), folder / "hints.json", port=0)
    viewer.add_timeline(open_run(beside, StoreOptions(warm.store), ("scene",)) if beside else None)
    viewer.load_pictures()
    with browser_page(width, 600) as page:
        page.open(viewer.address)
        page.wait_for("document.querySelector('canvas') !== null && document.querySelectorAll('button').length > 12")
        page.evaluate(_LOOK)
        hands = Hands(page, viewer)
        hands.until(hands.has_arrived)
        yield hands
    viewer.close()


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
