"""Film the viewer of a finished run: what a person does in it, as an animated picture.

`python docs/make_viewer_film.py RUN STORE FILE.webp`, where RUN is an output folder and STORE where its results are.
Needs the extra `view`, and Chromium. Beside the film stand its pictures, FILE.00.png and so on, to be looked at.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from browser import Page, browser_page

from ss_flow.cache.location import open_store
from ss_flow.flows.cli.view import search_of
from ss_flow.flows.results import open_finished
from ss_flow.flows.view.viewer import Viewer

SIZE = 1000, 760
"""Of the window, pixels; what the page has of it is less high."""
SECONDS = 1.6
"""How long each picture stays."""
QUALITY = 72
_SEARCH = """[...document.querySelectorAll('label')].find(e => e.textContent.trim() === 'Search')
  .closest('div:has(input)').querySelector('input')"""
_CLOSE = "document.querySelectorAll('[class*=Notification-closeButton]').forEach(button => button.click())"


def steps(viewer: Viewer, page: Page) -> Iterator[str]:
    """Do one thing after the other, and tell each."""
    panel, session = viewer.panel, viewer.panel.session
    yield "the scene"
    search(page, "brown")
    yield "search"
    objects, pieces = session.state.objects, session.state.pieces
    chosen = max((i for i in pieces if i and "brown" in objects.name(i)), key=lambda i: len(pieces[i].rows))
    panel._chosen((chosen,))
    yield "select what was found"
    (client,) = viewer.server.get_clients().values()
    panel._look_at(client)
    yield "look at it"
    session.isolate((chosen,))
    panel.refresh()
    yield "isolate"
    session.show()
    search(page, "")
    panel._chosen(())
    panel._colors.value = "objects"
    panel.refresh()
    yield "colours of the objects"


def search(page: Page, text: str) -> None:
    """Type into the search box, in the place of what stands there."""
    page.evaluate(f"{_SEARCH}.focus(); {_SEARCH}.select()")
    page.call("Input.insertText", text=text)
    page.evaluate("document.activeElement.blur()")  # a cursor that blinks never comes to rest


def picture(page: Page) -> np.ndarray:
    """What the page shows once it stays as it is."""
    end, last = time.monotonic() + 240, b""
    while time.monotonic() < end:
        time.sleep(4)
        now = page.screenshot()
        if now == last:
            return cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR)
        last = now
    raise TimeoutError("the page does not come to rest")


def film(run: Path, store: Path, target: Path) -> None:
    """Write the film, and its pictures beside it."""
    finished = open_finished(run, open_store(store))
    viewer = Viewer(finished, target.with_suffix(".json"), (), search_of(finished), port=0)
    viewer.load_pictures()
    pictures: list[np.ndarray] = []
    with browser_page(*SIZE) as page:
        page.open(viewer.address)
        page.wait_for("document.querySelector('canvas') !== null && document.querySelectorAll('button').length > 12")
        time.sleep(20)
        page.evaluate(_CLOSE)  # the warning that this browser draws without a GPU
        for number, told in enumerate(steps(viewer, page)):
            pictures.append(picture(page))
            cv2.imwrite(str(target.with_suffix(f".{number:02d}.png")), pictures[-1])
            print(number, told, flush=True)
    viewer.close()
    animation = cv2.Animation()
    animation.frames = pictures
    animation.durations = [round(1000 * SECONDS)] * len(pictures)
    cv2.imwriteanimation(str(target), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    print(f"{target.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    film(*map(Path, sys.argv[1:]))
