"""The page of a run: one file that shows it without a server and without a network."""

from __future__ import annotations

import base64
import gzip
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import browser_page, needs_browser

from ss_flow.cache.store import Store
from ss_flow.flows.results import finished_run, read_run
from ss_flow.flows.view.looking import start_view
from ss_flow.flows.view.page import page_html, write_page
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver.compressed import decompressed
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, looking

pytest.importorskip("websockets", reason="needs the extra `view`, whose websockets drive the browser")


@pytest.fixture(scope="module")
def run(tiny):
    document = read_run(tiny.out)
    return finished_run(tiny.out, document, Store(tiny.store), ())


@pytest.fixture(scope="module")
def file(run, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("page") / "room.html"
    write_page(file, run)
    return file


@pytest.fixture(scope="module")
def page(file):
    """The page in a browser; tests leave all objects shown."""
    with browser_page(1000, 640) as page:
        page.open(file.as_uri())
        page.wait_for("document.body?.dataset.drawn")
        yield page


def part(html: str, name: str) -> str:
    return re.search(rf'id="{name}">(.*?)</script>', html, re.DOTALL).group(1)


def rows(page) -> list[int]:
    return page.evaluate("[...document.querySelectorAll('li')].map(row => Number(row.dataset.id))")


def test_the_file_holds_every_gaussian_that_can_be_seen_and_its_instance(file, run):
    html = file.read_text()
    scene = run.results.one("scene")
    ids = np.frombuffer(gzip.decompress(base64.b64decode(part(html, "instances"))), "<u2")
    seen = scene.instance_id[scene.opacities >= 1 / 255]
    assert (np.bincount(ids) == np.bincount(seen)).all()
    spz = gzip.decompress(base64.b64decode(part(html, "gaussians")))
    assert len(spz) == 16 + 20 * len(seen)


def test_no_path_of_the_machine_and_no_address_is_in_the_file(file, run):
    html = file.read_text()
    assert str(run.folder) not in html and str(run.folder.parent) not in html and "/home/" not in html
    assert not re.search(r"\b(https?|wss?|ftp)://", html)


def test_a_name_that_is_markup_stays_a_name(run):
    scene, cameras = run.results.one("scene"), run.results.one("cameras")
    name = "</script><script>alert(1)</script>"
    entries = [(entry | {"name": name}, None) for entry in run.instances["instances"]]
    html = page_html(name, scene, start_view(cameras, scene.means), entries)
    assert "alert(1)</script>" not in html
    assert {one["name"] for one in json.loads(part(html, "scene"))["objects"]} == {name, "background"}


def test_an_object_without_a_photo_of_its_own_has_its_colour_as_its_picture(run):
    scene, cameras = run.results.one("scene"), run.results.one("cameras")
    entries = [(entry, None) for entry in run.instances["instances"]]  # as of an edited run
    html = page_html("edited", scene, start_view(cameras, scene.means), entries)
    for one in json.loads(part(html, "scene"))["objects"]:
        kind, _, content = one["thumbnail"].partition(";base64,")
        assert kind in ("data:image/png", "data:image/jpeg")
        picture = decompressed(np.frombuffer(base64.b64decode(content), np.uint8))
        assert picture[0, 0].tolist() == one["color"]


def test_a_scene_without_gaussians_is_a_page_without_objects(run):
    scene, cameras = run.results.one("scene"), run.results.one("cameras")
    nothing: Gaussians = select(scene, np.zeros(len(scene), bool))
    html = page_html("empty", nothing, start_view(cameras, scene.means), [])
    assert "0 objects, 0 Gaussians" in html


def test_one_is_told_as_one(run):
    scene, cameras = run.results.one("scene"), run.results.one("cameras")
    (entry, *_) = (entry for entry in run.instances["instances"] if entry["num_gaussians"])
    one = select(scene, np.flatnonzero((scene.instance_id == entry["id"]) & (scene.opacities > 0.1))[:1])
    html = page_html("one", one, start_view(cameras, scene.means), [(entry, None)])
    assert "1 object, 1 Gaussian<" in html


@needs_browser
def test_the_page_asks_for_nothing_and_complains_of_nothing(page, file):
    page.evaluate("new Promise(done => setTimeout(done, 500))")
    assert [url for url in page.requests if not url.startswith("data:")] == [file.as_uri()]
    assert page.complaints == []
    assert page.evaluate("fetch('data:,1').then(() => 'let through', () => 'refused')") == "refused"
    page.complaints.clear()  # the browser says that it refused


@needs_browser
def test_an_object_of_a_tiny_scene_is_gone_to_no_nearer_than_it_is_drawn(run, tmp_path):
    size = np.float32(0.01)
    scene, cameras = run.results.one("scene"), run.results.one("cameras")
    scene = replace(scene, means=scene.means * size, log_scales=scene.log_scales + np.log(size))
    poses = cameras.world_to_camera.copy()
    poses[:, :3, 3] *= size
    entries = [(entry, None) for entry in run.instances["instances"] if entry["num_gaussians"]]
    start = start_view(replace(cameras, world_to_camera=poses), scene.means)
    (tmp_path / "tiny.html").write_text(page_html("tiny", scene, start, entries))
    with browser_page(400, 300) as page:
        page.open((tmp_path / "tiny.html").as_uri())
        page.wait_for("document.body?.dataset.drawn")
        for number, (entry, _) in enumerate(entries):
            for button in (".only", ".go"):
                page.evaluate(f"document.querySelectorAll('li {button}')[{number}].click()")
            own = int((scene.opacities[scene.instance_id == entry["id"]] >= 1 / 255).sum())
            assert page.evaluate(DRAWN) >= 0.8 * own


@needs_browser
def test_the_page_shows_what_our_rasterizer_renders(page, run):
    import cv2

    scene, cameras = run.results.one("scene"), run.results.one("cameras")
    start = start_view(cameras, scene.means)
    width, height = page.evaluate("[document.querySelector('canvas').width, document.querySelector('canvas').height]")
    ahead = start.look_at - start.position
    pose = looking(start.position, ahead / np.linalg.norm(ahead), start.up)
    focal = height / 2 / np.tan(start.fov / 2)
    camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
    plain = Gaussians(**(vars(scene) | {"sh": scene.sh[:, :1]}))
    ours = render(plain, camera, background=(0.957, 0.961, 0.969)).rgb.clip(0, 1)
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR_RGB)[:height, :width] / 255
    unhidden = np.s_[: height - 40]  # a line of words lies over the lowest rows
    error = np.mean((picture[unhidden] - ours[unhidden]) ** 2)
    assert -10 * np.log10(error) > 42
    assert ours[unhidden].std() > 0.05


TYPED = "(box => {{ box.value = {}; box.dispatchEvent(new Event('input')) }})(document.getElementById('search'))"
"""Type a text into the search box."""
DRAWN = "new Promise(done => requestAnimationFrame(() => setTimeout(() => done(+document.body.dataset.drawn))))"
"""How many Gaussians are drawn, after the next frame."""


@needs_browser
def test_objects_are_hidden_shown_and_isolated(page, run):
    scene = run.results.one("scene")
    seen = scene.instance_id[scene.opacities >= 1 / 255]
    ids = rows(page)
    assert sorted(ids) == np.unique(seen).tolist() and ids[-1] == 0
    whole = page.evaluate(DRAWN)
    first = int((seen == ids[0]).sum())
    page.click("li .eye")
    assert whole - first <= page.evaluate(DRAWN) < whole
    assert page.evaluate("document.querySelector('li .eye').textContent") == "show"
    assert page.evaluate("document.querySelector('li').classList.contains('hidden')")
    page.click("li .eye")
    assert page.evaluate(DRAWN) == whole
    page.click("li .only")
    assert 0 < page.evaluate(DRAWN) <= first
    assert page.evaluate("document.querySelectorAll('li.hidden').length") == len(ids) - 1
    page.click("li .only")
    assert page.evaluate(DRAWN) == whole
    page.click("li .only")
    page.click("#all")
    assert page.evaluate(DRAWN) == whole


@needs_browser
def test_labels_colour_the_scene_and_a_click_selects_the_object_under_it(page):
    before = page.screenshot()
    page.click("#labels")
    page.evaluate(DRAWN)
    assert page.screenshot() != before
    page.click("#labels")
    page.evaluate(DRAWN)
    page.click("canvas")
    page.wait_for("document.querySelector('li.selected') !== null")
    chosen = page.evaluate("document.querySelector('li.selected').dataset.id")
    shown = page.evaluate(DRAWN)
    page.evaluate(f"document.querySelector('li[data-id=\"{chosen}\"] .eye').click()")
    page.wait_for(f"document.body.dataset.drawn < {shown}")
    page.click("canvas")
    page.wait_for(f"document.querySelector('li.selected')?.dataset.id !== '{chosen}'")
    page.click("#all")


@needs_browser
def test_the_list_is_searched_by_name(page):
    name = page.evaluate("document.querySelector('li .name').textContent")
    page.evaluate(TYPED.format(json.dumps(f"{name.upper()} ")))
    left = page.evaluate("[...document.querySelectorAll('li:not([hidden]) .name')].map(one => one.textContent)")
    assert left and all(name in one for one in left)
    assert page.evaluate("document.querySelectorAll('li[hidden]').length") > 0
    none = "document.getElementById('none').hidden"
    assert page.evaluate(none)
    page.evaluate(TYPED.format("'no such thing'"))
    assert not page.evaluate(none)
    page.evaluate(TYPED.format("''"))


@needs_browser
def test_the_page_is_for_keyboards_and_screen_readers_too(page):
    name = page.evaluate("document.querySelector('li .name').textContent")
    label = "document.querySelector('li {}').getAttribute('aria-label')"
    assert page.evaluate(label.format("button.go")) == f"Go to {name}"
    assert page.evaluate(label.format(".only")) == f"Show {name} only"
    assert page.evaluate(label.format(".eye")) == f"Hide {name}"
    page.click("li .only")
    pressed = (
        "[...document.querySelectorAll('li {}')].filter(one => one.getAttribute('aria-pressed') === 'true').length"
    )
    assert page.evaluate(pressed.format(".only")) == 1
    assert page.evaluate("document.querySelectorAll('li .eye[aria-label^=\"Show \"]').length") == len(rows(page)) - 1
    page.click("#all")
    assert page.evaluate(pressed.format(".only")) == 0
    is_selected = "String(document.querySelector('li').classList.contains('selected'))"
    for _ in range(2):
        page.click("li .name")
        assert page.evaluate(f"document.querySelector('li .name').getAttribute('aria-pressed') === {is_selected}")
    page.evaluate("document.querySelector('canvas').focus()")
    assert page.evaluate("document.activeElement.tagName") == "CANVAS"
    for key in ("ArrowLeft", "ArrowUp", "+", "-"):
        before = page.screenshot()
        page.evaluate(f"document.activeElement.dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}' }}))")
        page.evaluate(DRAWN)
        assert page.screenshot() != before, key
    page.click("#reset")


@needs_browser
def test_a_selected_object_keeps_its_light_and_shade_in_orange(page):
    """A blue one, mixed with some orange, would have the grey of a wall."""
    import cv2

    def picture() -> np.ndarray:
        page.evaluate(DRAWN)
        return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR_RGB)[:560, :680].astype(int)

    for row in range(len(rows(page))):
        plain = picture()
        page.evaluate(f"document.querySelectorAll('li .name')[{row}].click()")
        marked = picture()
        page.evaluate(f"document.querySelectorAll('li .name')[{row}].click()")
        changed = np.abs(marked - plain).sum(axis=2) > 60
        if changed.sum() > 100:
            red, _, blue = np.median(marked[changed], axis=0)
            assert red > 1.5 * blue


@needs_browser
def test_the_page_is_dark_for_who_wants_that_and_its_help_stays_off_the_edges_of_a_telephone(file):
    ground = "Number(getComputedStyle(document.querySelector('aside')).backgroundColor.match(/[0-9]+/)[0])"
    with browser_page(600, 400) as page:
        page.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
        page.open(file.as_uri())
        page.wait_for("document.body?.dataset.drawn")
        for scheme, is_dark in (("light", False), ("dark", True)):
            page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
            assert (page.evaluate(ground) < 64) == is_dark
        left, right = page.evaluate(
            "(r => [r.left, r.right])(document.querySelector('main p').getBoundingClientRect())"
        )
        assert left >= 12 and right <= 390 - 12


@needs_browser
def test_a_lost_graphics_card_is_told_of(file):
    with browser_page(600, 400) as page:
        page.open(file.as_uri())
        page.wait_for("document.body?.dataset.drawn")
        lose = "document.querySelector('canvas').getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
        page.evaluate(lose)
        page.wait_for("document.getElementById('problem').textContent.includes('load the page again')")
