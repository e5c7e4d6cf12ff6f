"""A run in a notebook."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ss_flow.errors import InputError
from ss_flow.flows.results import open_finished

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebooks" / "finished_run.ipynb"


@pytest.fixture(scope="module")
def run(tiny):
    return open_finished(tiny.out)


def test_a_result_is_read_by_its_name(run, tiny):
    results = tiny.called.results()
    assert run.artifact("propagate") is run.store.get(results["propagate"])
    assert [mask.name for mask in run.artifact("masks")] == [f"{k:04d}" for k in range(5)]
    with pytest.raises(InputError, match="has no result 'propagated'; it has ingest, cameras"):
        run.artifact("propagated")


def test_a_run_and_what_it_shows_are_one_line_in_a_terminal(run):
    assert max(len(repr(one)) for one in (run, run.show("propagate"), run.show("masks"))) < 200 + len(str(run.folder))


def test_a_result_that_the_run_never_had_is_missing(run):
    assert run.results.missing(["scene", "truth_held_out"]) == ["truth_held_out"]


def test_a_store_that_is_gone_is_named(tiny, tmp_path):
    document = json.loads((tiny.out / "run.json").read_text())
    (tmp_path / "run.json").write_text(json.dumps(document | {"store": "/nowhere/at/all"}))
    with pytest.raises(InputError, match="there is no store /nowhere/at/all"):
        open_finished(tmp_path)


def test_a_shown_result_has_a_picture_its_fields_and_its_history(run):
    html = run.show("propagate")._repr_html_()
    assert "<img src='data:image/" in html and "num_labels" in html and "made by split.propagate" in html
    assert run.show("masks")._repr_png_().startswith(b"\x89PNG")
    assert "... and 4 more" in run.show("masks")._repr_html_()


def test_a_run_shows_a_row_a_result(run):
    html = run._repr_html_()
    assert all(f"<td style='text-align:left'>{name}</td>" in html for name in run.results.digests)


def test_artifacts_load_nothing_for_notebooks():
    code = "import ss_flow.tasks.artifacts, ss_flow.flows.results, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"IPython", "cv2", "ss_flow.flows.notebook", "ss_flow.flows.describe"} & set(loaded)


def test_the_example_runs_from_top_to_bottom(tiny, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="needs the extra `test`")
    nbformat = pytest.importorskip("nbformat", reason="needs the extra `test`")
    (tmp_path / "ss-flow-out").mkdir()
    (tmp_path / "ss-flow-out" / "capture").symlink_to(tiny.out)
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "clear the outputs before committing"
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output["data"] for cell in notebook.cells for output in cell.get("outputs", ()) if "data" in output]
    assert sum("<img src='data:image/" in data.get("text/html", "") for data in shown) == 2
    assert sum("image/png" in data for data in shown) == 2
    printed = "".join(o["text"] for c in notebook.cells for o in c.get("outputs", ()) if o["output_type"] == "stream")
    assert "labels; the views agree on" in printed and "Gaussians, confidence" in printed
