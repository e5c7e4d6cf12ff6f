"""How near the exported meshes of a generated room are to its true surfaces.

    ss-flow demo --masks truth --out DEMO
    python tests/bench/bench_mesh.py DEMO

For each thing of the room, as shares of its diagonal: `accuracy`, the mean distance of the mesh from the true surface;
`seen`, that of the points that some view sees (one in each 2 cm) from the mesh; and their mean, the chamfer distance
over what was seen; whether the mesh is watertight, with holes open and closed.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from ss_flow.flows.cli.context import StoreOptions, open_run
from ss_flow.flows.demo import RECIPE
from ss_flow.flows.generated import RoomParams, generate
from ss_flow.flows.generated.layout import furnish
from ss_flow.tasks.deliver.export.content import chosen
from ss_flow.tasks.deliver.export.mesh import TriangleMesh, mesh
from ss_flow.tasks.geometry.open3d import load_open3d

SAMPLES = 20_000


def distances(surface: TriangleMesh | tuple[np.ndarray, np.ndarray], points: np.ndarray) -> np.ndarray:
    """[N] how far points are from a surface."""
    o3d = load_open3d()
    vertices, triangles = surface if isinstance(surface, tuple) else (surface.vertices, surface.triangles)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    return scene.compute_distance(points.astype(np.float32)).numpy()


def samples(surface: TriangleMesh, seed: int = 0) -> np.ndarray:
    """Points on a mesh, evenly by area: [SAMPLES, 3]."""
    a, b, c = surface.vertices[surface.triangles].transpose(1, 0, 2).astype(np.float64)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(seed)
    row = rng.choice(len(area), SAMPLES, p=area / area.sum())
    u, v = rng.random((2, SAMPLES, 1))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    return a[row] + u * (b - a)[row] + v * (c - a)[row]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path)
    demo = parser.parse_args().demo
    run = open_run(demo / "result", StoreOptions(), ("scene", "cameras"))
    scene, cameras = run.results.one("scene"), run.results.one("cameras")
    params = RoomParams(**json.loads((demo / "scene" / RECIPE).read_text())["room"])
    room = generate(params)
    things: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for thing in furnish(params.objects, np.random.default_rng(params.seed)):
        vertices, triangles = things.get(thing.instance_id, (np.zeros((0, 3)), np.zeros((0, 3), int)))
        joined = np.concatenate([triangles, thing.mesh.triangles + len(vertices)])
        things[thing.instance_id] = np.concatenate([vertices, thing.mesh.vertices]), joined
    names = {entry.instance_id: entry.name for entry in room.objects}
    rows = []
    for instance_id in run.all_ids():
        own = chosen.function(scene, instances=(instance_id,))
        truth_id = min(names, key=lambda i: np.median(distances(things[i], own.means)))
        truth = things[truth_id]
        diagonal = float(np.linalg.norm(np.ptp(truth[0], axis=0)))
        seen = room.points[room.point_ids == truth_id]
        for holes in ("open", "closed"):
            surface = mesh.function(own, cameras, instance_id=instance_id, holes=holes)
            accuracy = distances(truth, samples(surface)).mean() / diagonal
            completeness = distances(surface, seen).mean() / diagonal
            rows.append((holes, accuracy, completeness, surface.watertight))
            print(
                f"{names[truth_id]:16} {holes:6}  accuracy {accuracy:.2%}  seen {completeness:.2%}  "
                f"chamfer {(accuracy + completeness) / 2:.2%}  watertight {surface.watertight}  "
                f"{len(surface.triangles)} triangles",
                flush=True,
            )
    for holes in ("open", "closed"):
        own_rows = np.array([row[1:] for row in rows if row[0] == holes], float)
        accuracy, completeness, watertight = own_rows.mean(axis=0)
        print(
            f"{'mean':16} {holes:6}  accuracy {accuracy:.2%}  seen {completeness:.2%}  "
            f"chamfer {(accuracy + completeness) / 2:.2%}  watertight {watertight:.0%}"
        )


if __name__ == "__main__":
    main()
