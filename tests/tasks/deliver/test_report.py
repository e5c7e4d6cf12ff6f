import base64
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame, Gaussians, LabelMap, PointLabels
from ss_flow.tasks.deliver.compressed import Picture, Thumbnail, compressed, decompressed
from ss_flow.tasks.deliver.report import Comparison, Insight, Votes, report_html
from ss_flow.tasks.deliver.report_pictures import report_pictures
from ss_flow.tasks.deliver.timeline import timeline
from ss_flow.tasks.geometry.images import encode_png

PHOTO = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)
FILE = compressed(PHOTO)
HALF = np.repeat(np.uint16([[0, 1]]), 40, axis=1).repeat(60, axis=0)
RUN = {
    "status": "degraded",
    "scene": "my <room> & more",
    "params": {"split": {"tau_depth": 0.02, "grids": (1, 4)}, "seed": None},
    "models": {"masks": "rgb-d graph"},
    "metrics": {"split": {"miou": 0.8123}, "novel_view": {"psnr": 27.314, "ssim": 0.9}, "extra": 3},
    "nodes": [
        {"step": "split.segment", "item": "a", "hit": True, "seconds": 50.0, "peak_rss_mb": 10},
        {"step": "split.segment", "item": "b", "hit": False, "seconds": 4.0, "peak_rss_mb": 812.3},
        {"step": "splat.merge", "hit": False, "seconds": 76.0},
    ],
    "failures": [{"step": "splat.reconstruct", "item": "3", "error": "loss is <NaN>"}],
}
INSTANCE = {
    **{"id": 3, "name": "red <b>mug</b>", "color": [1, 2, 3], "views": ["a", "b"], "num_points": 12345},
    **{
        "num_gaussians": 0,
        "confidence": 0.9,
        "weak": True,
        "file": None,
        "kind": "thing",
        "num_parts": 0,
        "crumb": False,
    },
}


class Page(HTMLParser):
    """Open tags, text, and the addresses that the page would load."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open, self.words, self.addresses = [], [], []
        self.feed(html)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        self.addresses += [value for key, value in attrs if key in ("src", "href", "srcset")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)


def test_the_page_is_well_formed_and_loads_nothing():
    pictures = [Picture("a/photo", FILE), Picture("Cameras", FILE)]
    html = report_html(RUN, pictures=pictures, instances={"instances": [INSTANCE]})
    page = Page(html)
    assert page.open == []
    assert len(page.addresses) == 2 and all(a.startswith("data:image/") for a in page.addresses)
    assert not re.search(r"https?:|url\(|@import|<script|<link", html)


def test_what_the_run_says_is_on_the_page():
    page = Page(report_html(RUN, pictures=(), instances={"instances": [INSTANCE]}))
    for text in (
        "my <room> & more", "degraded", "mIoU 0.812", "PSNR 27.31 dB", "SSIM 0.900", "After Split", "Novel views",
        "rgb-d graph", "split.tau_depth 0.02", "split.grids (1, 4)", "seed –", "splat.reconstruct 3: loss is <NaN>",
        "red <b>mug</b> (weak: points only)", "12,345", "812 MB", "Nodes computed 2", "From the cache 1",
    ):  # fmt: skip
        assert text in page.text, text


def test_what_is_doubtful_and_crumbs_are_folded_away_and_stuff_comes_after_things():
    def entry(name: str, **changes):
        return INSTANCE | {"name": name, "weak": False} | changes

    unlikely = {"confidence": 0.09}
    listed = [
        entry("wall", kind="stuff", num_points=9, **unlikely),
        entry("speck", crumb=True, **unlikely),
        entry("patch", num_points=99, **unlikely),
        entry("mug", num_points=5),
    ]
    text = Page(report_html(RUN, pictures=(), instances={"instances": listed})).text
    order = ("2, 1 doubtful", "mug", "wall", "1 that is hardly a whole thing: ", "patch", "1 crumb: ", "speck")
    assert [text.index(words) for words in order] == sorted(text.index(words) for words in order)


def test_metrics_read_as_words_and_counts_as_whole_numbers():
    metrics = {"split": {"hungarian_miou": 0.5, "over_segmentation": 0.25, "num_truth": 13.0, "some_new_figure": 1.0}}
    text = Page(report_html({"metrics": metrics}, pictures=())).text
    for words in ("mIoU, one-to-one 0.500", "Instances split up 0.250", "True instances 13 ", "Some new figure 1.000"):
        assert words in text, words
    assert "_" not in text


def test_of_a_scenes_place_only_its_name_is_shown():
    html = report_html({**RUN, "scene": "/home/someone/captures/kitchen"}, pictures=())
    assert "<h1>kitchen</h1>" in html and "someone" not in html
    assert "<h1>kitchen</h1>" in report_html({**RUN, "scene": "/captures/kitchen/transforms.json"}, pictures=())


def test_warnings_are_told_once():
    warnings = [{"label": "capture.registration", "text": "Depth <does> not fit."}]
    html = report_html({"warnings": warnings}, pictures=())
    assert html.count("Depth &lt;does&gt; not fit.") == 1 and "(capture.registration)" in html
    assert "Warnings" not in report_html({"warnings": []}, pictures=())


def test_failures_by_label_are_told():
    page = Page(report_html({"failures": [{"label": "reconstruct[3]", "error": "out of memory"}]}, pictures=()))
    assert "reconstruct[3]: out of memory" in page.text


def test_three_views_spread_over_the_capture_are_drawn():
    n, h, w = 9, 60, 80
    frames = [Frame(f"v{i}", w, h, encode_png(PHOTO), np.zeros(0, np.uint8), w, h) for i in range(n)]
    maps = [LabelMap(f"v{i}", np.ones((h, w), np.uint16)) for i in range(n)]
    depths = [DepthMap(f"v{i}", np.ones((h, w), np.float32), "sensor") for i in range(n)]
    poses = np.tile(np.eye(4), (n, 1, 1))
    cameras = Cameras(tuple(f.name for f in frames), np.full((n, 2), (w, h), np.int32), np.ones((n, 4)), poses, True)
    f, i = np.zeros(0, np.float32), np.zeros(0, np.int32)
    nothing = Gaussians(f.reshape(0, 3), f.reshape(0, 4), f.reshape(0, 3), f, f.reshape(0, 1, 3), i, f, i)
    pictures = report_pictures(frames, cameras, depths, maps, maps, nothing)
    kinds = ("photo", "masks_split", "masks", "depth, 1 to 1 m, near = red; sensor, 100 % known")
    assert [one.name for one in pictures] == [*(f"{v}/{kind}" for v in ("v1", "v4", "v7") for kind in kinds), "Cameras"]
    few = report_pictures(frames[:2], cameras, depths[:2], maps[:2], maps[:2], nothing)
    assert [one.name for one in few if one.name.endswith("photo")] == ["v0/photo", "v1/photo"]
    assert decompressed(pictures[0].content).shape == (h, w, 3)
    lying = report_pictures(frames, cameras, depths, maps, maps, nothing, turns=3)
    for one, turned in zip(pictures[:12], lying, strict=False):
        whole = np.rot90(decompressed(one.content), 3).astype(int)
        assert one.name == turned.name and np.abs(decompressed(turned.content) - whole).mean() < 8
    assert lying[12].content.tobytes() == pictures[12].content.tobytes(), "the cameras stand as they are"


def test_what_the_colours_of_a_depth_map_mean_stands_in_its_caption():
    frame, maps = Frame("v", 80, 60, encode_png(PHOTO), np.zeros(0, np.uint8), 80, 60), [LabelMap("v", HALF)]
    cameras = Cameras(("v",), np.array([[80, 60]], np.int32), np.ones((1, 4)), np.eye(4)[None], False)
    f, i = np.zeros(0, np.float32), np.zeros(0, np.int32)
    nothing = Gaussians(f.reshape(0, 3), f.reshape(0, 4), f.reshape(0, 3), f, f.reshape(0, 1, 3), i, f, i)
    known, unknown = (
        report_pictures([frame], cameras, [DepthMap("v", depth, "mvs")], maps, maps, nothing)[3]
        for depth in (np.float32(2 * HALF), np.zeros((60, 80), np.float32))
    )
    assert "<figcaption>Depth, 2 to 2 units, near = red; mvs, 50 % known</figcaption>" in report_html(
        RUN, pictures=[known]
    )
    assert decompressed(known.content).shape == (60, 80, 3), "no legend in the picture"
    assert unknown.name == "v/depth, mvs, nothing known"


def test_a_report_of_an_edit_says_so_and_what_was_done():
    operations = [
        {"op": "remove", "instances": ["red mug", 5, 0], "fill": True, "comment": "in <the> way"},
        {"op": "keep", "instances": "lamp"},
        {"op": "duplicate", "instance": "lamp", "name": "lamp b", "move": [0.4, 0, 0]},
        {"op": "transform", "instances": [3], "rotate": {"axis": [0, 0, 1], "degrees": 90}, "scale": 0.5},
        {"op": "recolour", "instances": "lamp", "color": [208, 32, 32]},
        {"op": "replace", "instance": "lamp", "run": "/home/someone/other", "by": 7, "scale": "fit"},
        {"op": "relabel", "instance": "lamp b", "name": "torch", "kind": "stuff"},
        {"op": "merge", "instances": ["a", "b"], "name": "c"},
        {"op": "split", "instance": "c"},
    ]
    hole = {"operation": 1, "cleared": 1294, "pixels": 12_000, "unmeasured": 1082, "open_after_filling": 61}
    edit = {"source": "/home/someone/kitchen", "script": {"operations": operations}, "holes": [hole], "num_filled": 67}
    html = report_html(RUN | {"edit": edit}, pictures=())
    told = [line.strip() for line in re.findall(r"<li>(.*?)</li>", html.split("<ol>")[1].split("</ol>")[0])]
    assert told == [
        "Removed red mug, instance 5 and the background, filled the hole (in &lt;the&gt; way). Behind 1,082 of the"
        " 12,000 pixels that showed it nothing was measured; after filling, behind 61. 1,294 Gaussians that no view had"
        " shaped came to light, and went too.",
        "Kept nothing but lamp.",
        "Copied lamp as lamp b, moved by (0.4, 0, 0).",
        "Changed instance 3, turned by 90° about (0, 0, 1), scaled by 0.5.",
        "Recoloured lamp to #d02020.",
        "Replaced lamp by instance 7 of other.",
        "Relabelled lamp b as torch, stuff from now on.",
        "Merged a and b as c.",
        "Split c into its parts.",
    ]
    assert "the run <b>kitchen</b>" in html and "67 Gaussians fill holes" in html
    assert "How it was made" not in html and "someone" not in html
    assert "Edited" not in report_html(RUN, pictures=()) and "How it was made" in report_html(RUN, pictures=())


def test_pictures_are_there_at_once_so_that_the_page_does_not_jump():
    assert "lazy" not in report_html(RUN, pictures=[Picture("a/photo", FILE), Picture("Cameras", FILE)])


def test_the_time_of_a_hit_is_not_counted():
    page = Page(report_html(RUN, pictures=()))
    assert "Computing time 1 min 20 s" in page.text
    assert "split.segment 2 1 4.00 s" in page.text and "splat.merge 1 0 1 min 16 s" in page.text


def test_the_longest_step_has_the_full_bar():
    html = report_html(RUN, pictures=())
    assert re.findall(r'<i style="width: ([\d.]+)%"', html) == ["5.3", "100.0"]


def test_pictures_of_a_view_stand_together_in_a_fixed_order():
    pictures = [Picture(name, FILE) for name in ("a/depth", "b/photo", "a/photo", "Cameras")]
    html = report_html(RUN, pictures=pictures)
    assert re.findall(r"<figcaption>(.*?)</figcaption>", html) == ["Photo", "Depth", "Photo", "Cameras"]
    assert re.findall(r"<h3>View (.*?)</h3>", html) == ["a", "b"]


def test_objects_are_pictured_by_how_much_they_matter_and_the_doubtful_ones_named():
    def entry(number: int, name: str):
        return INSTANCE | {"id": number, "name": name, "weak": False}

    votes = Votes.of(labels([0, 0.5, 0.9, 1.0], [0, 0, 3, 3]), 0.7)
    doubt = {"id": 3, "name": "small mug", "reasons": ["few views: it is seen in 2 of 20", "low <confidence>"]}
    insight = Insight([Thumbnail(3, 0.0004, FILE), Thumbnail(4, 0.25, FILE)], [doubt], votes)
    listed = [entry(3, "small mug"), entry(4, "large box"), entry(5, "never shown")]
    html = report_html(RUN, pictures=(), instances={"instances": listed}, insight=insight)
    text = Page(html).text
    assert "small mug (3) : few views: it is seen in 2 of 20; low <confidence>" in text
    doubts = re.search(r'<ul class="doubts">(.*?)</ul>', html, re.DOTALL)[1]
    assert base64.b64encode(FILE.tobytes()).decode() in doubts
    pictured = re.findall(r'alt="(.+?)"><figcaption><b>', html)
    assert pictured == ["large box", "small mug"]
    assert "25.0 % of the pixels" in text and "less than 0.1 % of the pixels" in text
    assert "50.0 % of the dense points carry a label" in text and "Of 25.0 % the best label" in text
    assert "voted for 25.0 %" in text


def labels(confidence: list[float], label: list[int]) -> PointLabels:
    nothing = np.zeros(0, np.int32)
    return PointLabels(np.int32(label), np.float32(confidence), 3, nothing, nothing, nothing)


def test_agreement_is_told_by_tenths_of_the_points_that_have_votes():
    votes = Votes.of(labels([0, 0, 0.05, 0.95, 1.0], [0, 0, 1, 1, 1]), 0.7)
    assert votes.histogram == (0.5, *[0.0] * 8, 1.0)
    assert (votes.labelled, votes.contested, votes.without) == pytest.approx((3 / 5, 1 / 5, 2 / 5))


def test_stages_stand_side_by_side():
    metrics = {"split": {"miou": 0.5, "pq": 0.25}, "refined": {"miou": 0.625}, "splat": {"miou": 0.75, "pq": 0.125}}
    text = Page(report_html({"metrics": metrics}, pictures=())).text
    assert "After Split Refined masks After Splat mIoU 0.500 0.625 0.750 PQ 0.250 0.125" in text
    assert "As fractions; the terminal prints the same in percent." in text


def test_of_another_run_only_what_differs_is_told():
    metrics = {"split.miou": [0.5, 0.5], "splat.miou": [0.5, 0.625], "novel_view.psnr": [None, 27.3]}
    found = Comparison("before", {"a.b": [1, None]}, metrics, 0.75, ("3 of the first is in pieces: 4, 5",))
    text = Page(report_html({}, pictures=(), comparison=found)).text
    assert "Compared with before What was asked for before Here a.b 1 – " in text
    assert "Measured before Here Difference mIoU (after Splat) 0.500 0.625 +0.125 PSNR (novel views) – 27.30 dB" in text
    assert "1 of 3 figures are the same in both. The objects of both agree with a mean IoU of 0.750;" in text
    assert "1 change; before is the first 3 of the first is in pieces: 4, 5" in text
    nothing = Page(report_html({}, pictures=(), comparison=Comparison("x", {}, {}, None, ()))).text
    assert "were not compared" in nothing and "Measured" not in nothing


def test_the_timeline_places_what_was_computed_and_leaves_out_the_cache():
    nodes = [
        {"step": "b", "hit": False, "seconds": 5.0, "ended": 110.0},
        {"step": "a", "hit": False, "seconds": 2.0, "ended": 102.0},
        {"step": "a", "hit": False, "seconds": 2.0, "ended": 104.0},
        {"step": "a", "hit": False, "seconds": 1.0, "ended": 110.0},
        {"step": "c", "hit": True, "seconds": 9.0, "ended": 101.0},
    ]
    a, b = timeline(nodes)
    assert (a["name"], b["name"]) == ("a", "b")
    assert a["bars"] == [(0, 40), (90, 10)], "bars that touch are one"
    assert b["bars"] == [(50, 50)]
    assert timeline([nodes[-1], {"step": "d", "hit": False, "seconds": 1.0}]) == []
    instant = timeline([{"step": "a", "hit": False, "seconds": 0.0, "ended": 1.0}, nodes[0]])
    assert all(left >= 0 and left + width <= 100 and width > 0 for row in instant for left, width in row["bars"])


def test_memory_is_told_by_step():
    assert "split.segment 2 1 4.00 s 812 MB" in Page(report_html(RUN, pictures=())).text


@pytest.mark.parametrize("place, title", [("/a/fox/images", "fox"), ("/a/kitchen", "kitchen"), ("images", "images")])
def test_the_title_is_the_folder_of_the_capture_not_that_of_its_photos(place, title):
    assert f"<h1>{title}</h1>" in report_html({"scene": place}, pictures=())


def test_an_empty_run_has_a_report_too():
    page = Page(report_html({}, pictures=()))
    assert "unknown" in page.text and "How it was made" in page.text and "Instances" in page.text


def test_pictures_are_kept_in_the_smaller_form():
    flat = np.zeros((60, 80, 3), np.uint8)
    assert compressed(flat)[:4].tobytes() == b"\x89PNG" and FILE[:2].tobytes() == b"\xff\xd8"
    np.testing.assert_array_equal(decompressed(compressed(flat)), flat)
    smooth = cv2.resize(PHOTO, (320, 240), interpolation=cv2.INTER_CUBIC)
    assert np.abs(decompressed(compressed(smooth)).astype(int) - smooth).mean() < 12


def test_the_drawing_of_the_cameras_is_inverted_on_a_dark_page_and_photos_are_not():
    html = report_html({}, pictures=[Picture("a/photo", FILE), Picture("Cameras", FILE)])
    inverted = re.findall(r'img\[alt="(.*?)"\] { filter: invert', html.partition("(prefers-color-scheme: dark)")[2])
    assert inverted == ["Cameras"] and len(re.findall(r'<img [^>]*alt="Cameras"', html)) == 1


@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_the_page_holds_the_files_as_they_are(kind):
    content = encode_png(PHOTO) if kind == "png" else FILE
    (uri,) = Page(report_html({}, pictures=[Picture("Cameras", content)])).addresses
    assert uri.startswith(f"data:image/{kind};") and base64.b64decode(uri.split(",")[1]) == content.tobytes()


@pytest.mark.parametrize("width, expected", [(2000, 960), (500, 500)])
def test_large_pictures_are_scaled_down(width, expected):
    assert decompressed(compressed(np.zeros((90, width, 3), np.uint8))).shape[1] == expected
