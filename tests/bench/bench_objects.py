"""Do objects hold from where no photo was taken? Each alone, from 35 degrees off all views that saw it.

    python tests/bench/bench_objects.py room:10 room:50 CAPTURE [--preset default] [--set STEP.PARAM=VALUE ...]
                                        [--masks degraded] [--seed 0] [--degrees 35] [--objects] [--look DIR]
                                        [--store DIR] [--sensor]

Of a generated room (room:N, or composite) every true object is rendered alone by the room's own renderer, and so are
the Gaussians of the instance that covers it best, if with an IoU of at least 0.5; eight views an object, of those at
least half of whose pixels some training view saw. PSNR inside the union of both outlines, before white, and the IoU of
the outlines: of what was seen (pixels of the true object that no training view saw count in neither), and of all; mean
over objects, and worst. Beside it the same from the training views themselves, the share of needles, fog, held-out
PSNR, and the mIoU of masks after Split and in the end. Fog is what an object covers, from as far off, more than four
spacings beside its labelled points, as a share of what these cover; mean over objects of 200 Gaussians and more, and
worst. A capture has no true objects: needles, fog and held-out PSNR alone. --sensor gives rooms the depth of a camera
as the first Kinect. --look draws every object from its best view and from 35 degrees
off, before magenta.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench_splat import MAGENTA, Outcome, cell, folder_of, outcome, room_of
from scipy.ndimage import distance_transform_edt

from ss_flow.cache.store import Store
from ss_flow.flows import settings
from ss_flow.flows.generated import Room, generate, renderer_of
from ss_flow.flows.generated.render import Renderer
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import Bool, Float32, Float64, Gaussians, LabelMap, UInt8
from ss_flow.tasks.deliver.contact_sheet import contact_sheet
from ss_flow.tasks.evaluate.instances import pooled
from ss_flow.tasks.evaluate.novel_view import to_8bit
from ss_flow.tasks.evaluate.objects import Likeness, cameras_beside, needles
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, pixels_in_view
from ss_flow.tasks.geometry.clustering import nearest_spacing
from ss_flow.tasks.geometry.images import decode_rgb, encode_png
from ss_flow.tasks.geometry.shape import box_diagonal

LEAST_SEEN = 30
"""Pixels of a view from which it counts as seeing an object."""
SAME_SURFACE = 0.01
"""Metres between two depths of one surface of a room, whose depth is exact."""
LEAST_GAUSSIANS = 200
"""Of an object whose fog is looked at."""
BESIDE = 4
"""Spacings of its points beside which an object's alpha is fog."""


@dataclass(frozen=True)
class Held:
    """How one object looks."""

    name: str
    seen: Likeness
    """From 35 degrees off, where some training view saw the true surface."""
    all: Likeness
    """The same, wherever."""
    training: Likeness
    """From the training views, where the object is not hidden."""
    needles: float
    """Share of its Gaussians."""


def true_id_of(found: Outcome, room: Room) -> dict[int, int]:
    """By true id, the predicted one that covers it with an IoU of at least 0.5 in the finished scene's masks."""
    truth = [LabelMap(n, ids) for n, ids in zip(room.cameras.names, room.ids, strict=True)]
    table = pooled(found.masks, truth).without(truth=0, predicted=0)
    best = table.iou.argmax(axis=1)
    return {
        int(i): int(table.predicted_ids[b])
        for i, b, iou in zip(table.truth_ids, best, table.iou.max(axis=1), strict=True)
        if iou >= 0.5
    }


def sphere(points: Float32) -> tuple[Float64, float]:
    """The middle of an object and the radius that shows it whole."""
    low, high = np.quantile(points.astype(np.float64), (0.005, 0.995), axis=0)
    return (low + high) / 2, 0.6 * max(box_diagonal(points), 1e-6)


def seen_by(room: Room, views: Sequence[int], depth: Float32, camera: Camera) -> Bool:
    """[H, W] the pixels whose surface point at least one of a room's views sees."""
    points = backproject(depth, camera)
    seen = np.zeros(len(points), bool)
    for view in views:
        rows, column, row, z = pixels_in_view(points, camera_of(room.cameras, view))
        seen[rows] |= np.abs(room.depth[view][row, column] - z) < SAME_SURFACE
    return seen.reshape(depth.shape) & (depth > 0)


def likenesses(
    room: Room, renderer: Renderer, true_id: int, gaussians: Gaussians, degrees: float
) -> tuple[Likeness, Likeness, Likeness]:
    """Of one object: from the side where it was seen, from the side, from the training views."""
    views = [v for v in range(len(room)) if (room.ids[v] == true_id).sum() >= LEAST_SEEN]
    cameras = [camera_of(room.cameras, v) for v in views]
    seen, everywhere, training = Likeness(), Likeness(), Likeness()
    for camera in cameras_beside(cameras, *sphere(room.points[room.point_ids == true_id]), degrees=degrees):
        rgb, alpha, depth = renderer.alone(camera, true_id)
        known = seen_by(room, range(len(room)), depth, camera)
        if known.sum() * 2 < (depth > 0).sum():
            continue
        drawn = render(gaussians, camera)
        seen += Likeness.of(drawn.rgb, drawn.alpha, rgb, alpha, known | (alpha < 0.5))
        everywhere += Likeness.of(drawn.rgb, drawn.alpha, rgb, alpha, np.ones_like(known))
    for view, camera in list(zip(views, cameras, strict=True))[:: -(-len(views) // 6)]:
        rgb, alpha, depth = renderer.alone(camera, true_id)
        in_front = (room.ids[view] != true_id) & (room.depth[view] < np.where(depth > 0, depth, np.inf))
        drawn = render(gaussians, camera)
        training += Likeness.of(drawn.rgb, drawn.alpha, rgb, alpha, ~in_front | (depth == 0))
    return seen, everywhere, training


def held(found: Outcome, room: Room, renderer: Renderer, degrees: float) -> Iterator[Held]:
    """Every object that Split found."""
    predicted = true_id_of(found, room)
    for thing in room.objects:
        if thing.instance_id in predicted:
            own = select(found.scene, found.scene.instance_id == predicted[thing.instance_id])
            three = likenesses(room, renderer, thing.instance_id, own, degrees)
            if three[0].either:
                yield Held(thing.name, *three, needle_share(own))


def needle_share(gaussians: Gaussians) -> float:
    """Needles among the Gaussians that are not faint."""
    solid = gaussians.opacities >= 0.05
    return float(needles(gaussians)[solid].mean()) if solid.any() else 0.0


def fog(found: Outcome, degrees: float) -> Iterator[float]:
    """Of each object: alpha beside its points, as a share of the pixels near them."""
    for instance in found.instances:
        own = select(found.scene, found.scene.instance_id == instance.instance_id)
        if not instance.instance_id or not instance.views or len(own) < LEAST_GAUSSIANS:
            continue
        cameras = [camera_of(found.cameras, found.cameras.names.index(name)) for name in instance.views]
        beside = near = 0.0
        for camera in cameras_beside(cameras, *sphere(instance.points), degrees=degrees):
            _, column, row, z = pixels_in_view(instance.points, camera)
            if not len(z):
                continue
            shown = np.zeros((camera.height, camera.width), bool)
            shown[row, column] = True
            reach = BESIDE * nearest_spacing(instance.points) * camera.fx / np.median(z)
            close = distance_transform_edt(~shown) <= reach
            beside += float(render(own, camera).alpha[~close].sum())
            near += np.count_nonzero(close)
        if near:
            yield beside / near


def look(found: Outcome, degrees: float) -> UInt8:
    """Every object: its best photo, and alone before magenta from there and from four of the views beside."""
    pictures, captions = [], []
    for instance in found.instances:
        own = select(found.scene, found.scene.instance_id == instance.instance_id)
        if not instance.instance_id or len(own) < 10 or not instance.views:
            continue
        rows = [found.cameras.names.index(name) for name in instance.views]
        sizes = instance.areas()
        best = int(sizes.argmax())
        y, x = np.nonzero(instance.mask(best))
        box = x.min(), y.min(), x.max() + 1, y.max() + 1
        front = camera_of(found.cameras, rows[best])
        beside = cameras_beside([camera_of(found.cameras, r) for r in rows], *sphere(own.means), degrees=degrees)
        pictures.append(decode_rgb(found.frames[rows[best]])[box[1] : box[3], box[0] : box[2]])
        captions.append(f"{instance.instance_id}: photo")
        for camera in (front.cropped(*(int(n) for n in box)), *(beside[:4] or [front] * 4)):
            shrink = 320 / max(camera.width, camera.height)
            larger = camera.scaled(round(shrink * camera.width), round(shrink * camera.height))
            pictures.append(to_8bit(render(own, larger, background=MAGENTA).rgb))
            captions.append("")
    return contact_sheet(pictures, captions, columns=12) if pictures else np.zeros((8, 8, 3), np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--masks", default="degraded", help="of rooms")
    parser.add_argument("--sensor", action="store_true", help="rooms with the depth of a depth camera")
    parser.add_argument("--degrees", type=float, default=35.0)
    parser.add_argument("--objects", action="store_true", help="a line for every object")
    parser.add_argument("--look", type=Path)
    parser.add_argument("--store", type=Path)
    args = parser.parse_args()
    print("| scene | objects | PSNR of seen, worst | IoU of seen, worst | PSNR, worst | IoU, worst |"
          " PSNR, IoU training | needles % | fog %, worst | held out |"
          " mIoU Split, final | Gaussians | Splat s |")  # fmt: skip
    print("|---" * 13 + "|")
    with tempfile.TemporaryDirectory() as temporary:
        place = args.store or Path(temporary)
        for scene in args.scenes:
            measured(scene, place, args)


def measured(scene: str, place: Path, args: argparse.Namespace) -> None:
    """Run, measure, print a line."""
    params = settings.apply(settings.preset(Params(), args.preset), args.set)
    folder = folder_of(scene, args.seed, args.masks, place, args.sensor)
    of = room_of(scene, args.seed)
    params = replace(params, evaluate=replace(params.evaluate, zero_is_void=of is None))
    found = outcome(folder, params, args.jobs, Store(place))
    objects: list[Held] = []
    if of is not None:
        objects = list(held(found, generate(of), renderer_of(of), args.degrees))
    ids = np.unique(found.scene.instance_id)
    shares = [needle_share(select(found.scene, found.scene.instance_id == i)) for i in ids if i]
    fogs = list(fog(found, args.degrees)) or [0.0]
    columns = [f"{np.mean(v):.{d}f}, {min(v):.{d}f}" for v, d in (
        ([o.seen.psnr for o in objects] or [0], 2), ([o.seen.iou for o in objects] or [0], 3),
        ([o.all.psnr for o in objects] or [0], 2), ([o.all.iou for o in objects] or [0], 3),
    )]  # fmt: skip
    training = [(o.training.psnr, o.training.iou) for o in objects] or [(0, 0)]
    mean = np.mean(training, axis=0)
    print(
        f"| {folder.name} | {len(objects)} | {' | '.join(columns)} | {mean[0]:.2f}, {mean[1]:.3f} | "
        f"{100 * np.mean(shares):.1f} | {100 * np.mean(fogs):.1f}, {100 * max(fogs):.1f} | "
        f"{cell(found.metrics, 'novel_view', 'psnr', 1, 2)} | "
        f"{cell(found.metrics, 'metrics_split', 'miou')}, "
        f"{cell(found.metrics, 'metrics_splat', 'miou')} | {len(found.scene)} | {found.splat_seconds:.0f} |",
        flush=True,
    )
    if args.objects:
        for o in objects:
            three = (("seen", o.seen), ("all", o.all), ("training", o.training))
            told = "; ".join(f"{name} {like.psnr:.2f} dB, {like.iou:.3f}" for name, like in three)
            print(f"  {o.name}: {told}; needles {100 * o.needles:.1f} %")
    if args.look:
        args.look.mkdir(parents=True, exist_ok=True)
        (args.look / f"{folder.name}.png").write_bytes(encode_png(look(found, args.degrees)).tobytes())


if __name__ == "__main__":
    main()
