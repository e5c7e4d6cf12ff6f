"""No command that writes a folder takes a user's files, its own inputs or the store away with an earlier one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from tiny_runs import SHORT, run_tiny, ss_flow


def refused(called, says: str) -> None:
    assert called.code == 2, called
    assert called.err.count("\n") == 1 and says in called.err, called.err


def everything(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def script(folder: Path, *operations: dict[str, object]) -> Path:
    file = folder / "script.json"
    file.write_text(json.dumps({"version": 1, "operations": operations}))
    return file


def earlier(command: str, warm, tmp_path: Path) -> tuple[list[str | Path], Path]:
    """What a command was called with, and the folder that it wrote."""
    store = ["--cache", warm.store]
    if command in ("run", "batch"):
        if command == "run":
            return ["run", warm.scene, "--out", warm.out, *store, "--preset", "fast", *SHORT], warm.out
        out = tmp_path / "all" / warm.scene.name
        shutil.copytree(warm.out, out)
        return ["batch", warm.scene, "--out", out.parent, *store, "--preset", "fast", *SHORT], out
    asked: dict[str, list[str | Path]] = {
        "query": ["query", warm.out, "white"],
        "export": ["export", warm.out, "--format", "mesh-ply"],
        "workspace": ["export", warm.out, "--format", "nerfstudio"],
        "render": ["render", warm.out, "--frames", "1"],
        "edit": ["edit", warm.out, script(tmp_path)],
    }
    out = tmp_path / "there"
    whole = [*asked[command], "--out", out, *store]
    assert ss_flow(*whole).code == 0
    return whole, out


@pytest.mark.parametrize("command", ["run", "batch", "query", "export", "workspace", "render", "edit"])
def test_what_a_user_put_into_a_folder_stays(command, warm, tmp_path):
    whole, out = earlier(command, warm, tmp_path)
    lost = min(file for file in out.rglob("*.*") if file.suffix in (".png", ".jpg", ".ply"))
    lost.unlink()  # so that the folder is written anew
    (out / "mine").mkdir()
    (out / "mine/0001.jpg").write_text("a photo")
    called = ss_flow(*whole)
    assert called.code == 0, called.err
    assert lost.is_file()
    assert (out / "mine/0001.jpg").read_text() == "a photo"


@pytest.mark.parametrize("command", ["run", "batch", "query", "export", "workspace", "render", "edit", "sweep"])
@pytest.mark.parametrize("place", ["objects/out", ""])
def test_nothing_is_written_into_the_store(command, place, warm, tmp_path):
    whole = ["sweep", warm.scene, "--set=tau_label=0.6,0.8", "--out", "x", "--cache", warm.store]
    if command != "sweep":
        whole, _ = earlier(command, warm, tmp_path)
    whole[whole.index("--out") + 1] = warm.store / place
    before = everything(warm.store)
    called = ss_flow(*whole)
    assert called.code == 2 and called.err.count("\n") == 1, called.err
    if place:
        assert f"lies in the store {warm.store}, which is for results alone; name another with --out" in called.err
    assert everything(warm.store) == before


@pytest.mark.parametrize("place", ["film.mp4", "scene.ply"])
def test_no_film_and_no_file_is_written_into_the_store(place, tiny):
    what = ["render"] if place == "film.mp4" else ["export", "--format", "ply"]
    called = ss_flow(*what, tiny.out, "--out", tiny.store / place, "--cache", tiny.store)
    refused(called, "lies in the store")
    assert not (tiny.store / place).exists()


def test_a_store_in_the_folder_of_a_result_is_refused_before_it_is_made(room, tmp_path):
    out = tmp_path / "out"
    refused(run_tiny(room, out / "store", out=out), f"{out} holds the store {out / 'store'}, which would be lost")
    refused(run_tiny(room, out, out=out), "lies in the store")
    assert not out.exists()


@pytest.mark.parametrize("command", ["run", "batch"])
def test_a_capture_in_the_result_of_another_run_stays(command, warm):
    scene = shutil.copytree(warm.scene, warm.out / "photos")
    place = warm.out if command == "run" else warm.out.parent
    scenes = [scene] if command == "run" else [scene, shutil.copytree(warm.scene, warm.out.parent / "in/out")]
    called = ss_flow(command, *scenes, "--out", place, "--cache", warm.store, "--preset", "fast", *SHORT)
    if command == "run":
        refused(called, f"{warm.out} holds {scene}, which is read here; name another folder with --out")
    else:
        assert called.code == 3, called.err
        assert f"{warm.out} holds {scene}, which is read here" in called.out
    assert (scene / "color/0000.jpg").is_file()


def test_masks_of_the_result_that_would_be_replaced_are_not_read(warm):
    called = run_tiny(warm.scene, warm.store, "--masks", warm.out / "masks", out=warm.out)
    refused(called, "which is read here; name another folder with --out")


def test_an_edit_does_not_replace_the_run_that_it_takes_an_object_from(warm, tmp_path):
    other = shutil.copytree(warm.out, tmp_path / "other")
    first, second = [e["id"] for e in json.loads((other / "instances.json").read_text())["instances"]][:2]
    swap = script(tmp_path, {"op": "replace", "instance": first, "run": "other", "by": second, "name": "new"})
    called = ss_flow("edit", warm.out, swap, "--out", other, "--cache", warm.store)
    refused(called, f"other holds {other}, which is read here")


def test_what_other_commands_wrote_into_a_result_stays(warm):
    store = ["--cache", warm.store]
    for written in (
        ["view", warm.out, "--html", warm.out / "page.html"],
        ["export", warm.out, "--format", "mesh-ply", "--out", warm.out / "meshes"],
    ):
        called = ss_flow(*written, *store)
        assert called.code == 0, called.err
    called = run_tiny(warm.scene, warm.store, "--undistorted", out=warm.out)
    assert called.code == 0, called.err
    assert (warm.out / "undistorted").is_dir()
    assert (warm.out / "page.html").is_file() and (warm.out / "meshes/export.json").is_file()
    document = json.loads((warm.out / "run.json").read_text())
    assert "page.html" not in document["files"]
