"""What the viewer costs: a generated scene of many Gaussians and objects, opened in headless Chromium.

    python tests/bench/bench_view.py [--gaussians 100000 1000000] [--objects 200] [--frames 10] [--draw-at-most N]

Of each number of Gaussians: the seconds until the server is ready; until a browser shows the first of them, and all of
them (two pictures, one after the other, are the same); of a frame while the mouse turns the scene; of finding what a
click in the scene meets; of showing what is selected, and of an operation; the memory of the server and of the browser.
Frames are drawn by SwiftShader on the processor: they are good only to be compared with others of the same run, best in
processor seconds. `--frames 0` opens no browser.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from box_scene import cameras
from browser import Page, browser_page

from ss_flow.flows.view.panel import Panel
from ss_flow.flows.view.picking import pixel_met
from ss_flow.flows.view.server import start
from ss_flow.flows.view.session import Session
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.initialise import initialise

_CLICKS = 40
_WINDOW = (640, 480)
"""Of the browser, pixels."""
_PATIENCE = 1800.0
"""Seconds until the scene must be drawn, and for each frame."""
_CLOSE = "document.querySelectorAll('[class*=Notification-closeButton]').forEach(button => button.click())"
_COLOURED, _SHARE = 40, 0.02
"""Splats are there when so large a share of the scene's pixels has channels that lie so far apart: page and notices are
grey."""


def generated(count: int, objects: int) -> tuple[Gaussians, dict]:
    """Balls of Gaussians on a floor, as many as objects, and their instances.json; a fifth is the floor's."""
    rng = np.random.default_rng(0)
    ids = np.sort(rng.integers(-objects // 4, objects, count).clip(-1) + 1).astype(np.int32)
    side = int(np.ceil(objects**0.5))
    around = rng.normal(size=(count, 3))
    around *= 0.35 / np.linalg.norm(around, axis=1, keepdims=True)
    means = np.stack([(ids - 1) % side, (ids - 1) // side, np.zeros(count)], axis=1) + around
    floor = ids == 0
    means[floor] = np.stack([*rng.uniform(-1, side, (2, floor.sum())), np.full(floor.sum(), -0.4)], axis=1)
    colors = rng.integers(0, 255, (objects + 1, 3)).astype(np.uint8)[ids]
    scene = initialise(means.astype(np.float32), colors, ids, 0.02)
    scene.opacity_logits[:] = (
        2.2  # as after a training: viser leaves out what is small and as faint as at its beginning
    )
    entries = [
        {"id": i, "name": f"object {i}", "parts": [], "confidence": 1.0, "parent": None, "views": [], "num_points": 0}
        for i in range(1, objects + 1)
    ]
    return scene, {"instances": entries, "groups": []}


def measure(count: int, objects: int, frames: int, draw_at_most: int | None) -> dict[str, float]:
    """The figures of one size of scene."""
    scene, instances = generated(count, objects)
    side = objects**0.5
    eye, middle = np.array([side / 2, -side * 0.7, side * 0.7]), np.array([side / 2, side / 2, 0])
    begun = time.perf_counter()
    server, address = start("127.0.0.1", 0, "bench")
    server.initial_camera.position, server.initial_camera.look_at = eye, middle
    with tempfile.TemporaryDirectory() as folder:
        session, script = Session(scene, instances, Path()), Path(folder, "script.json")
        panel = Panel(server, cameras(), session, script, None, None, draw_at_most)
        told = {"server ready, s": time.perf_counter() - begun}
        if frames:
            told |= _browser(address, frames)
    told |= _clicks(panel, eye, middle, side)
    told["server's memory, MB"] = psutil.Process().memory_info().rss / 1e6
    server.stop()
    return told


def _browser(address: str, frames: int) -> dict[str, float]:
    """What it takes a browser to show the scene, and to turn it."""
    with browser_page(*_WINDOW) as page:
        page.patience = _PATIENCE
        page.evaluate("new Promise(done => requestAnimationFrame(done))")
        empty, busy, begun = _memory(), _processor(), time.perf_counter()
        page.open(address)
        page.wait_for(
            "!!document.querySelector('canvas') && document.querySelectorAll('button').length > 12", _PATIENCE
        )
        first = None
        page.evaluate(_CLOSE)
        for shown, settled in _pictures(page):
            if first is None and shown:
                first = (time.perf_counter() - begun, _processor() - busy)
            if settled:
                break
        assert first is not None
        return {
            "first picture, s": first[0],
            "first picture, processor s": first[1],
            "whole picture, s": time.perf_counter() - begun,
            "whole picture, processor s": _processor() - busy,
            "browser's memory, MB": _memory() - empty,
        } | _turned(page, frames)


def _pictures(page: Page) -> Iterator[tuple[bool, bool]]:
    """Of one picture of the page after another: whether it shows splats, and whether it is the one before."""
    end, before = time.monotonic() + _PATIENCE, b""
    while time.monotonic() < end:
        now = page.screenshot()
        picture = cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR)
        scene = picture[:, : _WINDOW[0] // 2 - 40]  # left of the panel
        shown = bool(np.mean(np.ptp(scene, axis=-1) > _COLOURED) > _SHARE)
        yield shown, shown and now == before
        before = now
    raise TimeoutError("the browser has not drawn the scene")


def _turned(page: Page, frames: int) -> dict[str, float]:
    """Frames a second, and processor seconds a frame, while the scene is turned with the mouse."""
    page.evaluate("window.drawn = 0; (function count() { drawn += 1; requestAnimationFrame(count) })()")
    place = {"y": 100, "button": "left", "buttons": 1}
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=60, clickCount=1, **place)
    busy, begun = _processor(), time.perf_counter()
    for frame in range(frames):
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=64 + 4 * frame, **place)
        page.wait_for(f"drawn > {frame + 1}", _PATIENCE)
    drawn = page.evaluate("drawn - 1")
    seconds = time.perf_counter() - begun
    return {"frames a second": drawn / seconds, "processor s a frame": (_processor() - busy) / drawn}


def _processor() -> float:
    """Seconds of the processor that the browser has used."""
    return _summed(lambda process: sum(process.cpu_times()[:2]))


def _memory() -> float:
    """MB that the browser alone holds: of its page, and of what stands in for the graphics card."""
    return _summed(lambda process: process.memory_full_info().uss) / 1e6


def _summed(figure: Callable[[psutil.Process], float]) -> float:
    """Over the processes of the browser, but those that end meanwhile."""
    total = 0.0
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
            total += figure(process)
    return total


def _clicks(panel: Panel, eye: np.ndarray, middle: np.ndarray, side: float) -> dict[str, float]:
    """Seconds from a click's arrival to what it selects; the first click makes ready what the others use."""
    rng, seconds, processor, met = np.random.default_rng(1), [], [], set()
    forward = (middle - eye) / np.linalg.norm(middle - eye)
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    pose = np.stack([right, np.cross(forward, right), forward], axis=1)
    wxyz = _wxyz(pose)
    session = panel.session
    for _ in range(_CLICKS):
        target = middle + rng.uniform(-side / 2, side / 2, 3) * (1, 1, 0)
        begun, busy = time.perf_counter(), time.process_time()
        pixel = pixel_met(eye, target - eye, wxyz, 500.0, (1280, 800))
        assert pixel is not None
        found = panel.pick().met(pixel)
        seconds.append(time.perf_counter() - begun)
        processor.append(time.process_time() - busy)
        met.add(found and found[0])
    first = next(i for i in met if i)
    begun = time.perf_counter()
    session.select(first)
    panel.refresh()
    selected = time.perf_counter() - begun
    begun = time.perf_counter()
    session.do({"op": "transform", "instances": [first], "move": [0, 0, 0.5]})
    panel.refresh()
    moved = time.perf_counter() - begun
    assert len(met) > 5
    return {
        "first click, s": seconds[0],
        "first click, processor s": processor[0],
        "click, median processor s": float(np.median(processor[1:])),
        "click, median s": float(np.median(seconds[1:])),
        "click, longest s": max(seconds[1:]),
        "showing what is selected, s": selected,
        "moving an object, s": moved,
    }


def _wxyz(pose: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(pose).as_quat(scalar_first=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, nargs="*", default=[100_000, 1_000_000])
    parser.add_argument("--objects", type=int, default=200)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--draw-at-most", type=int)
    options = parser.parse_args()
    for count in options.gaussians:
        told = measure(count, options.objects, options.frames, options.draw_at_most)
        print(json.dumps({"gaussians": count} | {name: round(value, 4) for name, value in told.items()}), flush=True)


if __name__ == "__main__":
    main()
