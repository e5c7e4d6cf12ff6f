"""What a correction costs: a generated room with a joined pair and a broken thing, four clicks, and the run again.

    python tests/bench/bench_corrections.py [--preset fast] [--jobs 1]

The vase and the table have one mask in all views, the sofa two; Split's union of what touches is off, since it would
mend the sofa. The clicks are made and saved as the viewer does it. Tells of both runs the processor seconds (of the
whole command), the results that are computed, the instances that are trained, and what comes out, against the truth.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from faulty_masks import places_to_click, write_faulty_masks

from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.flows.results import open_finished
from ss_flow.flows.view.corrections import Corrections
from ss_flow.flows.view.picking import Picker, pixel_met
from ss_flow.flows.view.session import Session
from ss_flow.tasks.geometry.cameras import camera_of

FAULTS: dict[str, Any] = {"joined": (1, 10), "broken": 3}
"""Table and vase; sofa: as the room with seed 0 numbers them."""


def run(scene: Path, store: Path, out: Path, *more: str) -> dict[str, Any]:
    """Run the scene in a process of its own; returns what is told of it."""
    command = [sys.executable, "-c", "from ss_flow.flows.cli.main import entry; entry()", "run", str(scene)]
    options = ["--cache", str(store), "--out", str(out), "--json", "--set=propagate.touching_merge=false", *more]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    document = json.loads(done.stdout)
    made = [node["step"] for node in document["nodes"] if not node["hit"]]
    return {
        "processor seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "computed": len(made),
        "reused": len(document["nodes"]) - len(made),
        "instances trained": made.count("splat.reconstruct"),
        **{
            f"{name} after {stage}": document["metrics"][stage][name]
            for stage in ("split", "splat")
            for name in ("miou", "macc50", "pq")
        },
    }


def click(out: Path, hints: Path) -> list[str]:
    """Click what is wrong, save it, and return what the viewer says that it will do."""
    finished = open_finished(out)
    picker = Picker(Session(finished.results.one("scene"), finished.instances, Path()).visible())
    corrections, cameras = Corrections(finished, hints), finished.results.one("cameras")
    for thing, view, row, column in places_to_click(finished, **FAULTS):
        if thing > corrections.thing:
            corrections.next_thing()
        camera = camera_of(cameras, view)
        turn = camera.world_to_camera[:3, :3]
        ray = turn.T @ [(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1]
        pixel = pixel_met(camera.center, ray, _wxyz(turn), camera.fx, (camera.width, camera.height))
        met = picker.met(pixel) if pixel is not None else None
        assert met is not None
        corrections.pick(*met)
    corrections.save()
    return corrections.told()


def _wxyz(turn: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(turn.T).as_quat(scalar_first=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--jobs", default="1")
    options = parser.parse_args()
    how = ("--preset", options.preset, "--jobs", options.jobs)
    with tempfile.TemporaryDirectory() as folder:
        scene, store, out = (Path(folder, name) for name in ("room", "store", "out"))
        room = generate(RoomParams())
        write_scene(room, scene)
        write_faulty_masks(room, scene / "instance_masks", **FAULTS)
        hints = Path(folder, "hints.json")
        first = run(scene, store, out, *how)
        told = click(out, hints)
        second = run(scene, store, Path(folder, "again"), *how, "--correct", str(hints))
    for name, row in (("first run", first), ("corrected", second)):
        print(json.dumps({"run": name} | {key: round(value, 4) for key, value in row.items()}))
    print("; ".join(told))


if __name__ == "__main__":
    main()
