"""`ss-flow sweep`: parameters with several values, on one small room."""

from __future__ import annotations

import contextlib
import csv
import errno
import json
import os
from pathlib import Path

import cv2
import pytest
from tiny_runs import SHORT, Called, run_tiny, ss_flow

from ss_flow.cache.store import Store
from ss_flow.events import Reporter
from ss_flow.flows import paper
from ss_flow.flows.cli import sweep as sweep_module
from ss_flow.flows.cli import sweep_plot, sweep_report
from ss_flow.flows.measures import HEADLINE, NAMES, measures, names_of
from ss_flow.tasks.split import propagate as propagate_module

CORE = {"scene", "params", "metrics", "hits", "misses", "seconds"}
TAU = "split.visibility.tau_depth"


def sweep_tiny(run, *more: str | Path, out: Path | None = None) -> Called:
    """`ss-flow sweep SCENE --json` on the store of a tiny run, with its short trainings."""
    options = ["--out", out or run.out.parent / "swept", "--cache", run.store, "--preset", "fast", "--json"]
    return ss_flow("sweep", run.scene, *options, *SHORT, *more)


def refused(called: Called, says: str) -> None:
    assert called.code == 2, called
    assert called.out == "" and called.err.count("\n") == 1 and says in called.err, called.err


def test_a_sweep_shares_steps_and_its_variants_are_what_single_runs_give(warm, tmp_path):
    actions = len(list(Store(warm.store).actions()))
    swept = sweep_tiny(warm, "--set", "tau_depth=0.02,0.04,0.0005", out=tmp_path / "swept")
    assert swept.code == 0, swept.err
    rows = swept.document()
    assert all(set(row) >= CORE and row["status"] == "ok" for row in rows)
    assert [row["params"] for row in rows] == [{TAU: 0.02}, {TAU: 0.04}, {TAU: 0.0005}]
    assert (rows[0]["misses"], rows[0]["seconds"]) == (0, 0)
    assert rows[0]["metrics"]["split.miou"] == warm.called.document()["metrics"]["split"]["miou"]
    assert rows[2]["metrics"]["split.miou"] < rows[0]["metrics"]["split.miou"]
    assert sum(row["misses"] for row in rows) == len(list(Store(warm.store).actions())) - actions
    chosen = run_tiny(warm.scene, warm.store, "--set", "tau_depth=0.0005", out=tmp_path / "chosen")
    assert chosen.computed() == {}
    assert chosen.document()["metrics"]["splat"]["pq"] == rows[2]["metrics"]["splat.pq"]
    again = sweep_tiny(warm, "--set", "tau_depth=0.02,0.04,0.0005", out=tmp_path / "swept").document()
    assert [row["misses"] for row in again] == [0, 0, 0]
    assert [row["metrics"] for row in again] == [row["metrics"] for row in rows]


def test_the_files_agree_with_the_document_and_the_picture_is_one(warm, tmp_path):
    rows = sweep_tiny(warm, "--set", "tau_label=0.7,0.72", out=tmp_path / "swept").document()
    assert sorted(path.name for path in (tmp_path / "swept").iterdir()) == ["sweep.csv", "sweep.json", "sweep.png"]
    assert json.loads((tmp_path / "swept/sweep.json").read_text()) == rows
    table = list(csv.DictReader((tmp_path / "swept/sweep.csv").open()))
    for line, row in zip(table, rows, strict=True):
        figures = {**row["params"], **row["metrics"], "hits": row["hits"], "misses": row["misses"]}
        assert {name: float(line[name]) for name in figures} == figures
        assert (line["scene"], line["status"]) == (row["scene"], "ok")
    picture = cv2.imread(str(tmp_path / "swept/sweep.png"))
    assert picture.shape[0] > 300 and picture.std() > 10


def test_two_parameters_make_a_grid_or_go_together(tiny):
    both = ["--dry-run", "--set", "tau_label=0.7,0.8", "--set", "rgbd.levels=0.1,0.2;0.3,0.4"]
    grid, zipped = (sweep_tiny(tiny, *both, *more).document() for more in ([], ["--zip"]))
    pairs = [tuple(row["params"].values()) for row in grid]
    assert pairs == [(a, b) for a in (0.7, 0.8) for b in ([0.1, 0.2], [0.3, 0.4])]
    assert [tuple(row["params"].values()) for row in zipped] == [pairs[0], pairs[3]]


def test_lists_of_one_length_may_be_swept_beside_lists_that_stay(tiny):
    fixed = ["grids=1,2,3,4,5", "stability_offset=1,1,1,1,1", "mask_threshold=0,0,0,0,0"]
    given = [word for text in [*fixed, "box_nms=1,1,1,1,1;0,0,0,0,0"] for word in ("--set", f"segment.{text}")]
    rows = sweep_tiny(tiny, "--dry-run", *given).document()
    assert [row["params"] for row in rows] == [{"split.segment.box_nms": [value] * 5} for value in (1.0, 0.0)]


def test_a_dry_run_says_what_is_there_and_why_the_rest_is_not_and_writes_nothing(warm, tmp_path):
    runs = sorted((warm.store / "roots/runs").iterdir())
    actions = len(list(Store(warm.store).actions()))
    plan = sweep_tiny(warm, "--dry-run", "--set", "tau_label=0.7,0.8", out=tmp_path / "swept")
    there, missing = plan.document()
    assert (there["would_run"], there["hits"]) == ([], len(warm.called.document()["nodes"]))
    assert missing["would_run"] == [{"label": "split.propagate", "why": "parameter tau_label 0.7 -> 0.8"}]
    options = ["--cache", warm.store, "--preset", "fast", "--dry-run", "--set", "tau_label=0.7,0.8"]
    words = ss_flow("sweep", warm.scene, *options, *SHORT)
    assert words.code == 0
    assert f"tau_label=0.7: {there['hits']} results are there, all that is needed\n" in words.out
    assert "at least 1 would be computed, first split.propagate: parameter tau_label 0.7 -> 0.8\n" in words.out
    assert "at least 1 results would be computed in all" in words.out
    assert sorted((warm.store / "roots/runs").iterdir()) == runs
    assert len(list(Store(warm.store).actions())) == actions
    assert not (tmp_path / "swept").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "there is nothing to sweep"),
        (["--set", "tau_label=0.7"], "there is nothing to sweep"),
        (["--set", "tau_label=0.7,0.70"], "there is nothing to sweep"),
        (["--set", "tau_label=0.7,"], "has an empty value"),
        (["--set", "tau_label"], "is not of the form step.param=value"),
        (["--set", "tau_lable=0.6,0.7"], "did you mean"),
        (["--set", "tau_label=0.6,1.7"], "is out of range: 1.7"),
        (["--set", "tau_label=0.6,high"], "cannot be 'high'; it takes a number"),
        (["--set", "tau_label=0.6:0.8:1"], "at least 2 values"),
        (["--set", "propagate.min_new_points=1:10:3"], "cannot be '5.5'; it takes a whole number"),
        (["--set", "tau_label=0.6,0.7", "--set", "split.tau_label=0.8"], "is given twice"),
        (["--set", "tau_label=0.6,0.7", "--set", "tau_depth=0.1,0.2,0.3", "--zip"], "must be equally many"),
        (["--set", "tau_label=0.6,0.7", "--metric", "miou"], "there is no metric 'miou' here; there are "),
        (["--set", "tau_label=0.6,0.7", "--metric", "novel_view.psnr"], "there is no metric 'novel_view.psnr' here"),
        (["--set", "tau_label=0.6,0.7", "--until", "dense", "--metric", "split.miou"], "--until stops before them"),
        (["--set", "tau_label=0.6,0.7", "--until", "densest"], "names no step"),
        (["--set", "tau_corr=0.1,0.2", "--query", "red", "--until", "scene"], "--query is the last step"),
        (["--set", "capture.depth=sensor,mono"], "needs a monocular depth network"),
        (["--set", "tau_label=0.6,0.7", "--memory", "8 XB"], "'8 XB' is not a size"),
        (["--set", "tau_label=0.6,0.7", "--memory", "1kB"], "--memory 1kB is out of range"),
    ],
)
def test_a_bad_sweep_is_refused_with_one_sentence_and_writes_nothing(arguments, says, tiny, tmp_path):
    runs = sorted((tiny.store / "roots/runs").iterdir())
    refused(sweep_tiny(tiny, *arguments, out=tmp_path / "swept"), says)
    assert not (tmp_path / "swept").exists()
    assert sorted((tiny.store / "roots/runs").iterdir()) == runs


def test_a_bad_place_or_scene_is_refused_with_one_sentence(tiny, tmp_path):
    (tmp_path / "file").write_text("x")
    refused(sweep_tiny(tiny, "--set", "tau_label=0.6,0.7", out=tmp_path / "file"), "is not a writable folder")
    options = ["--cache", tiny.store, "--set", "tau_label=0.6,0.7"]
    refused(ss_flow("sweep", *options), "there is no scene to sweep")
    refused(ss_flow("sweep", tmp_path / "nowhere", *options), "nowhere does not exist")
    refused(ss_flow("sweep", tiny.scene, tiny.scene, "--masks", tmp_path, *options), "--masks belongs to one scene")
    refused(ss_flow("sweep", tiny.scene, tiny.scene, "--hints", tmp_path, *options), "--hints belongs to one scene")


def test_with_a_text_the_search_is_a_step_and_its_threshold_can_be_swept(warm, tmp_path):
    options = ["--set", "query.tau_corr=0.01,0.2", "--metric", "query.matched", "query.best"]
    found = sweep_tiny(warm, *options, "--query", "a white thing", out=tmp_path / "swept")
    rows = found.document()
    assert [list(row["metrics"]) for row in rows] == [["query.matched", "query.best"]] * 2
    assert [row["misses"] for row in rows] == [2, 1]  # the similarities are computed once
    answer = ss_flow("query", warm.out, "a white thing", "--json", "--cache", warm.store).document()["instances"]
    assert rows[0]["metrics"]["query.best"] == pytest.approx(answer[0]["score"], abs=1e-3)
    assert rows[0]["metrics"]["query.matched"] == sum(row["matched"] for row in answer if row["id"])
    assert "warning" not in found.err
    refused(sweep_tiny(warm, *options, "--query", "teapot", out=tmp_path / "x"), '"teapot" names no colour')


def test_a_parameter_that_no_step_depends_on_is_told_of(warm, tmp_path):
    values = ["--set", "query.tau_corr=0.01,0.2", "--set", "tau_label=0.7,0.71", "--set", "tau_depth=0.02,0.020"]
    told = sweep_tiny(warm, *values, out=tmp_path / "swept")
    assert [line for line in told.err.splitlines() if "warning" in line] == [
        "warning: no step of these runs depends on semantics.query.tau_corr; --query TEXT adds one."
    ]


def test_the_records_of_a_sweep_leave_those_of_the_scene_alone(warm, tmp_path):
    sweep_tiny(warm, "--set", "tau_label=0.8,0.9", "--until", "propagate", out=tmp_path / "swept")
    plain = json.loads(ss_flow("status", warm.scene, "--json", "--cache", warm.store).out)
    assert plain["steps"]["splat.reconstruct"]["finished"] > 0
    name = f"{warm.scene} [split.propagate.tau_label=0.9]"
    told = ss_flow("why", "propagate", name, "--cache", warm.store)
    assert told.out == "split.propagate: parameter tau_label 0.7 -> 0.9\n", told.err


def test_a_disk_that_does_not_take_the_files_of_a_sweep_gets_one_sentence(warm, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))

    monkeypatch.setattr(sweep_report, "write_atomically", refuse)
    called = sweep_tiny(warm, "--set", "tau_label=0.7,0.8", "--until", "propagate", out=tmp_path / "swept")
    assert called.code == 1 and f"the output {tmp_path / 'swept'} cannot be written: File too large;" in called.err


def test_a_variant_that_fails_is_told_of_and_the_others_are_measured(warm, tmp_path, monkeypatch):
    real = propagate_module._settle

    def fail(given, points, sightings, params):
        if params.tau_label == 0.9:
            raise ArithmeticError("no label is left")
        return real(given, points, sightings, params)

    monkeypatch.setattr(propagate_module, "_settle", fail)
    called = sweep_tiny(warm, "--set", "tau_label=0.7,0.9", out=tmp_path / "swept")
    assert called.code == 3
    good, bad = called.document()
    assert good["status"] == "ok" and good["metrics"]["splat.pq"] > 0
    assert (bad["status"], bad["metrics"]) == ("failed", {})
    assert bad["error"] == "split.propagate: ArithmeticError: no label is left"


def test_an_interrupted_sweep_goes_on_where_it_was(warm, tmp_path, monkeypatch):
    class Interrupt(Reporter):
        def event(self, kind, **details):
            if kind == "finished" and "0.5" in details["label"]:
                raise KeyboardInterrupt

    before = len(list(Store(warm.store).actions()))
    arguments = ["--until", "propagate", "--jobs", "1", "--set", "tau_label=0.4,0.5,0.6"]
    with monkeypatch.context() as patch:
        patch.setattr(sweep_module, "display", lambda out: contextlib.nullcontext(Interrupt()))
        assert sweep_tiny(warm, *arguments, out=tmp_path / "swept").code == 130
    assert not (tmp_path / "swept").exists()
    kept = len(list(Store(warm.store).actions())) - before
    rows = sweep_tiny(warm, *arguments, out=tmp_path / "swept").document()
    assert 1 <= kept <= 3 and sum(row["misses"] for row in rows) == 3 - kept


def test_words_for_people_hold_a_table_and_where_the_files_are(warm, tmp_path):
    options = ["--out", tmp_path / "swept", "--cache", warm.store, "--preset", "fast"]
    told = ss_flow("sweep", warm.scene, *options, *SHORT, "--set", "tau_label=0.7,0.71", "--metric", "splat.pq")
    assert told.code == 0, told.err
    lines = [line.split() for line in told.out.splitlines()]
    head = lines.index(["tau_label", "pq", "reused", "computed", "seconds"])
    assert [line[0] for line in lines[head + 1 : head + 3]] == ["0.7", "0.71"]
    assert told.out.splitlines()[-1] == f"see {tmp_path / 'swept'}: sweep.json, sweep.csv, sweep.png"


def test_a_scene_that_is_named_twice_is_swept_once(tiny):
    options = ["--cache", tiny.store, "--preset", "fast", "--dry-run", "--json", "--set", "tau_label=0.7,0.8"]
    rows = ss_flow("sweep", tiny.scene, f"{tiny.scene}/../{tiny.scene.name}", *options).document()
    assert [row["scene"] for row in rows] == [str(tiny.scene)] * 2


def test_a_value_that_is_named_twice_is_swept_once(tiny):
    options = ["--cache", tiny.store, "--preset", "fast", "--dry-run", "--json", "--set", "tau_label=0.7,0.70,0.8"]
    rows = ss_flow("sweep", tiny.scene, *options).document()
    assert [row["params"] for row in rows] == [{"split.propagate.tau_label": value} for value in (0.7, 0.8)]


def test_no_sweep_takes_the_place_of_another(warm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ["--cache", warm.store, "--preset", "fast", *SHORT, "--until", "propagate", "--json"]

    def swept(*more) -> Called:
        return ss_flow("sweep", warm.scene, *options, *more)

    first = swept("--set", "tau_label=0.7,0.8")
    assert (tmp_path / "ss-flow-out/room-sweep/sweep.json").is_file(), first.err
    kept = (tmp_path / "ss-flow-out/room-sweep/sweep.csv").read_bytes()
    for other in (["tau_label=0.7,0.9"], ["tau_label=0.7,0.8", "--set", "tau_depth=0.03"]):
        called = swept("--set", *other)
        assert called.code == 0, called.err
    assert [len(json.loads(p.read_text())) for p in sorted(tmp_path.glob("ss-flow-out/*/sweep.json"))] == [2, 2, 2]
    assert (tmp_path / "ss-flow-out/room-sweep/sweep.csv").read_bytes() == kept
    again = swept("--set", "tau_label=0.7,0.8")  # the same once more: nothing is lost
    assert len(list((tmp_path / "ss-flow-out").iterdir())) == 3
    assert "see ss-flow-out/room-sweep:" in again.err
    refused(swept("--set", "tau_label=0.6,0.8", "--out", "ss-flow-out/room-sweep"), "holds another sweep, or")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/sweep.png").write_bytes(b"mine")
    refused(swept("--set", "tau_label=0.6,0.8", "--out", "mine"), "something else under the names of its files")
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["sweep.png"]


def test_a_sweep_that_stops_before_all_figures_says_which_steps_give_some(warm, tmp_path):
    options = ["--set", "tau_label=0.7,0.8", "--until"]
    called = sweep_tiny(warm, *options, "observe", out=tmp_path / "none")
    assert called.code == 0 and [row["metrics"] for row in called.document()] == [{}, {}]
    assert "--until observe gives no figures; these steps do: propagate, reproject, masks_split" in called.err
    masks = sweep_tiny(warm, *options, "masks_split", out=tmp_path / "masks")
    assert "no figures" not in masks.err
    for row, called in zip(masks.document(), (0.7, 0.8), strict=True):
        assert 0 < row["metrics"]["split.covered"] < 1 and row["params"]["split.propagate.tau_label"] == called


def test_every_figure_is_listed_under_the_step_that_gives_it(tiny):
    document = tiny.called.document()
    found = measures(Store(tiny.store), document)
    assert sorted(found) == sorted(names_of(document["results"]))
    assert set(HEADLINE) <= {name for names in NAMES.values() for name in names}
    assert found["split.num_predicted"] == found["split.instances"]
    entries = json.loads((tiny.out / "instances.json").read_text())["instances"]
    assert found["splat.instances"] == sum(entry["file"] is not None for entry in entries)


def drawn(rows, params, metrics):
    """The lines of one panel by label, and the kind of its horizontal axis."""
    from matplotlib.figure import Figure

    axis = Figure().subplots()
    sweep_plot._lines(axis, rows, params, metrics, {"room": "room"})
    return {line.get_label(): list(zip(*line.get_data(), strict=True)) for line in axis.lines}, axis.get_xscale()


def test_the_papers_curve_stands_beside_ours_over_its_own_parameter_only():
    rows = [{"scene": "room", "params": {TAU: x}, "metrics": {"split.miou": x}} for x in (0.01, 0.02)]
    lines, scale = drawn(rows, [TAU], ["split.miou"])
    assert lines["split"] == [(0.01, 0.01), (0.02, 0.02)]
    published = [number for point in lines["paper, ScanNet 0062_00"] for number in point]
    assert published == pytest.approx([0.001, 0.5198, 0.02, 0.6398, 0.1, 0.6233])
    assert scale == "log"
    other = [{**row, "params": {"split.propagate.tau_label": row["params"][TAU]}} for row in rows]
    assert list(drawn(other, ["split.propagate.tau_label"], ["split.miou"])[0]) == ["split"]


def test_the_papers_curves_are_of_parameters_and_figures_that_there_are():
    from ss_flow.flows import settings
    from ss_flow.flows.params import Params

    for (parameter, metric), curve in paper.curves().items():
        assert parameter in settings.flat(Params())
        assert metric in {name for names in NAMES.values() for name in names}
        assert curve.values == sorted(curve.values) and all(0 <= value <= 1 for value in curve.figures)


@pytest.mark.parametrize(
    ("values", "scale"), [([1, 2, 3], "linear"), ([1, 2, 4], "log"), ([0, 1, 200], "linear"), ([1, 7, 100], "log")]
)
def test_the_axis_is_logarithmic_where_the_values_are(values, scale):
    rows = [{"scene": "room", "params": {"a": x}, "metrics": {"split.pq": 0.5}} for x in values]
    assert drawn(rows, ["a"], ["split.pq"])[1] == scale


@pytest.mark.parametrize("zipped", [True, False])
def test_words_and_pairs_of_parameters_are_drawn_too(zipped):
    rows = [
        {"scene": "room", "params": {"a": a, "b": b}, "metrics": {"split.pq": 0.5} if a == "x" else {}}
        for a in ("x", "y")
        for b in (1, None)
    ]
    assert sweep_plot.plot(rows, ["split.pq"], zipped=zipped).startswith(b"\x89PNG")
    assert sweep_plot.plot(rows, [], zipped=zipped) is None
