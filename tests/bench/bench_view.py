"""What the viewer costs: a generated scene of many Gaussians and objects, opened in headless Chromium.

    python tests/bench/bench_view.py [--gaussians 100000 1000000] [--objects 200] [--frames 10]

Of each number of Gaussians: the seconds until the server is ready; until a browser draws all of them; of finding what a
click in the scene meets, also in processor seconds; of showing what is selected, and of an operation; the memory of the
server and of the page. Frames are drawn by SwiftShader on the processor, and asked for one by one while the camera
turns: a frame rate is good only to be compared with another of the same run. `--frames 0` opens no browser.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from browser import Page, browser_page

from ss_flow.flows.view.panel import Panel
from ss_flow.flows.view.picking import pixel_met
from ss_flow.flows.view.server import start
from ss_flow.flows.view.session import Session
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.initialise import initialise

_CLICKS = 40


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
    entries = [
        {"id": i, "name": f"object {i}", "parts": [], "confidence": 1.0, "parent": None, "views": [], "num_points": 0}
        for i in range(1, objects + 1)
    ]
    return scene, {"instances": entries, "groups": []}


def measure(count: int, objects: int, frames: int) -> dict[str, float]:
    """The figures of one size of scene."""
    scene, instances = generated(count, objects)
    side = objects**0.5
    eye, middle = np.array([side / 2, -side * 0.7, side * 0.7]), np.array([side / 2, side / 2, 0])
    begun = time.perf_counter()
    server, address = start("127.0.0.1", 0, "bench")
    server.initial_camera.position, server.initial_camera.look_at = eye, middle
    with tempfile.TemporaryDirectory() as folder:
        panel = Panel(server, Session(scene, instances, Path()), Path(folder, "script.json"), None)
        told = {"server ready, s": time.perf_counter() - begun}
        if frames:
            told |= _browser(address, frames)
    told |= _clicks(panel, eye, middle, side)
    told["server's memory, MB"] = psutil.Process().memory_info().rss / 1e6
    server.stop()
    return told


def _browser(address: str, frames: int) -> dict[str, float]:
    with browser_page(960, 600) as page:
        begun = time.perf_counter()
        page.open(address)
        page.wait_for("!!document.querySelector('canvas')", 600)
        _wait_for_splats(page)
        first = time.perf_counter() - begun
        memory = page.call("Runtime.getHeapUsage")["backingStorageSize"] / 1e6
        return {
            "first picture, s": first,
            "page's memory, MB": memory,
            "frames a second": _frame_rate(page, frames),
        }


def _wait_for_splats(page: Page, seconds: float = 900) -> None:
    """Until two pictures, one after the other, are the same and show something."""
    end, before = time.monotonic() + seconds, b""
    while time.monotonic() < end:
        now = page.screenshot()
        if now == before and len(now) > 60_000:
            return
        before = now
    raise TimeoutError("the browser has not drawn the scene")


def _frame_rate(page: Page, frames: int) -> float:
    """Frames a second while the scene is turned with the mouse."""
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=300, y=300, button="left", buttons=1, clickCount=1)
    begun = time.perf_counter()
    for frame in range(frames):
        x = 300 + 4 * frame
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=300, button="left", buttons=1)
        page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return frames / (time.perf_counter() - begun)


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
    options = parser.parse_args()
    for count in options.gaussians:
        told = measure(count, options.objects, options.frames)
        print(json.dumps({"gaussians": count} | {name: round(value, 4) for name, value in told.items()}), flush=True)


if __name__ == "__main__":
    main()
