"""Hands on the viewer's page in a browser: they click, drag and look, and know what the scene shows where."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from browser import Page, browser_page
from scipy.spatial.transform import Rotation

from ss_flow.flows.cli.context import StoreOptions, open_run
from ss_flow.flows.cli.view import search_of
from ss_flow.flows.view.viewer import Viewer
from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, project

if TYPE_CHECKING:
    import viser

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
