"""Every command of README and docs is run, on a tiny room under the names of the pages; or it is listed why not."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from docs_blocks import BLOCKS, commands
from tiny_runs import ROOM, SHORT, ss_flow, write_room

from ss_flow.flows.cli import view
from ss_flow.flows.generated import generate

PAGES = sorted({block.page for block in BLOCKS if list(commands(block))})
INSTALLS = "it installs, from the network"
CLUSTER = "it needs a cluster; tests/ss_flow/test_dask.py runs one"
NOT_RUN = {
    "python3 -m venv": INSTALLS,
    ".venv/bin/": "it installs, or is what runs this test",
    "source": "it belongs to an installation",
    "pip install": INSTALLS,
    "ss-flow models fetch": "it asks the network; tests/tasks/models serve archives of their own",
    "dask": CLUSTER,
    "kubectl": CLUSTER,
    "python on_slurm.py": CLUSTER,
    "ss-flow run SCENE --executor dask": CLUSTER,
    "ss-flow run /shared/kitchen": CLUSTER,
    "ss-flow run /scenes/kitchen": CLUSTER,
    "export AWS_ACCESS_KEY_ID": "it names a bucket",
    "ss-flow run SCENE --cache s3:": "it needs a bucket; tests/cache/test_remote_flows.py serves one",
    "ss-flow demo": "its room takes minutes; test_demo.py runs it with fewer photos",
    "ss-flow reproduce": "it runs many rooms or a data set; test_reproduce.py runs it with fewer",
    "ss-flow run kitchen --hints": "it needs the weights of a segmenter",
    "ss-flow run scans/office --refine-poses": "its photos are too small; test_refine_poses.py has larger ones",
    "ss-flow view ss-flow-out/kitchen --rerun": "it needs the extra `rerun`; with it test_rerun_file.py writes one",
    "python -m pytest": "it needs a CUDA device",
    "python tests/bench/bench_device.py": "it needs a CUDA device",
}
"""The beginnings of commands, and why they are not run."""


def reason(words: list[str]) -> str | None:
    """Why a command is not run; None where it is."""
    line = " ".join(words)
    return next((why for start, why in NOT_RUN.items() if line.startswith(start)), None)


@pytest.mark.parametrize("start", NOT_RUN)
def test_what_is_not_run_is_still_on_a_page(start):
    assert any(" ".join(words).startswith(start) for block in BLOCKS for words in commands(block))


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the pages speak of: captures, finished runs of them, and files of their user."""
    base = tmp_path_factory.mktemp("docs")
    kitchen = write_room(base / "kitchen")
    for name in ("path/to/capture", "SCENE", "ss-flow-demo/scene"):
        shutil.copytree(kitchen, base / name)
    write_room(base / "scans/kitchen", masks=None)
    write_room(base / "scans/office", params=replace(ROOM, views=11))
    (base / "scans/hall").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        prepare(patch, base)
        assert run(["run", "kitchen"]).code == 0
        finished = base / "ss-flow-out/kitchen"
        for name in ("room", "capture", "other", "scene0000_00", "kitchen-paper"):
            shutil.copytree(finished, base / "ss-flow-out" / name)
        shutil.copytree(finished, base / "ss-flow-demo/result")
    listed = json.loads((finished / "instances.json").read_text())
    listed["instances"][0]["name"] = "red mug"
    (base / "ss-flow-out/room/instances.json").write_text(json.dumps(listed))
    for place in ("splat.ply", "kitchen-3dgs/point_cloud/iteration_30000/point_cloud.ply"):
        (base / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(finished / "scene.ply", base / place)
    script = json.dumps({"operations": [{"op": "remove", "instances": [1]}]})
    for place in ("script.json", "ss-flow-out/kitchen.edit.json"):
        (base / place).write_text(script)
    return base


def prepare(patch: pytest.MonkeyPatch, base: Path) -> None:
    """Be there, with a store and a home of its own."""
    patch.chdir(base)
    patch.setenv("SS_FLOW_CACHE", str(base / "store"))
    patch.setenv("SS_FLOW_MODELS", "")
    patch.setenv("HOME", str(base / "home"))
    patch.setenv("XDG_CACHE_HOME", str(base / "home/.cache"))


def run(arguments: list[str]):
    """Call the command line; what trains does so for a few steps."""
    if arguments and arguments[0] in ("run", "sweep", "batch"):
        arguments = [*arguments, *SHORT, *([] if "--preset" in arguments else ["--preset", "fast"])]
    return ss_flow(*arguments)


def clicks(base: Path) -> None:
    """Points on the two largest things of the first photo, as the viewer saves them."""
    ids = cv2.imread(str(base / "kitchen/instance_masks/0000.png"), cv2.IMREAD_UNCHANGED)
    largest = sorted(set(ids.ravel().tolist()) - {0}, key=lambda i: -(ids == i).sum())[:2]
    inside = [np.argwhere(cv2.erode((ids == i).astype(np.uint8), np.ones((5, 5))))[0, ::-1].tolist() for i in largest]
    points = {f"thing {number}": [place] for number, place in enumerate(inside)}
    (base / "ss-flow-out/kitchen.hints.json").write_text(json.dumps({"0000": points}))


def annotated(base: Path) -> None:
    """The annotation of a scan, as ScanNet has it."""
    room, folder = generate(ROOM), base / "scans/scene0000_00"
    folder.mkdir(exist_ok=True)
    np.savetxt(
        folder / "scene0000_00_vh_clean_2.ply", room.points, "%.6f", comments="", header="ply\nformat ascii 1.0\n"
        f"element vertex {len(room.points)}\nproperty float x\nproperty float y\nproperty float z\nend_header",
    )  # fmt: skip
    ids = room.point_ids.tolist()
    (folder / "scene0000_00_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"segIndices": ids}))
    things = [{"segments": [i]} for i in sorted(set(ids)) if i > 0]
    (folder / "scene0000_00.aggregation.json").write_text(json.dumps({"segGroups": things}))


BEFORE: dict[str, Callable[[Path], object]] = {
    "ss-flow run kitchen --correct": clicks,
    "ss-flow eval ss-flow-out/scene0000_00": annotated,
    "ss-flow batch scans/*/ --preset fast": lambda base: shutil.rmtree(base / "scans/scene0000_00", ignore_errors=True),
    "ss-flow batch scans/*/ --preset fast --retry-failed": lambda base: write_room(base / "scans/hall"),
}
"""What a person does before a command."""
CODES = {"ss-flow batch scans/*/ --preset fast": 3}
"""Exit codes other than 0: of a batch with a folder that holds no photo."""


@pytest.fixture
def looked(shelf: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The addresses of viewers that were opened; each is asked for its page, and ended."""
    prepare(monkeypatch, shelf)
    asked: list[str] = []

    def start(*arguments: object):
        server, address = started(*arguments)
        asked.append(address)
        return server, address

    def wait() -> None:
        with urllib.request.urlopen(asked[-1], timeout=60) as page:
            assert page.status == 200

    pytest.importorskip("viser", reason="needs the extra `view`")
    from ss_flow.flows.view import server, viewer

    started = server.start
    monkeypatch.setattr(server, "start", start)
    monkeypatch.setattr(viewer, "start", start)
    monkeypatch.setattr(view, "_ctrl_c_put_off", lambda: nullcontext(wait))
    yield asked


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_run_one_after_the_other(page, shelf, looked):
    for block in (block for block in BLOCKS if block.page == page and not block.marked):
        for words in commands(block):
            if reason(words):
                continue
            line, target = " ".join(words), None
            if ">" in words:
                words, target = words[: words.index(">")], Path(words[-1]).expanduser()
            for start, does in BEFORE.items():
                if line.startswith(start):
                    does(shelf)
            if words[0] != "ss-flow":
                subprocess.run([os.path.expanduser(word) for word in words], check=True)
                continue
            if words[1] == "run" and not Path(words[2]).exists():
                pytest.fail(f"{block}: the shelf has no {words[2]}")
            before = len(looked)
            done = run(words[1:])
            assert done.code == CODES.get(line, 0), f"{block}: {line}\n{done.err}"
            if words[1] == "view" and not {"--html", "--rerun"} & set(words):
                assert len(looked) == before + 1, f"{block}: {line}"
            if target:
                target.write_text(done.out)
            check_files(words, str(block))


def check_files(words: list[str], where: str) -> None:
    """What a command is told to write is there."""
    for option, value in itertools.pairwise(words):
        if option in ("--out", "--png", "--html", "--rerun") and words[1] != "run":
            assert Path(value).exists(), f"{where}: {value}"
