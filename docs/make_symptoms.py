"""Draw the pictures of troubleshooting.md: what faults look like, and what mends them.

`python docs/make_symptoms.py granularity|depth FILE.jpg --cache DIR --capture DIR --view NAME`, where NAME is that of a
photo; `python docs/make_symptoms.py poses|fog|side|missing FILE.jpg --cache DIR`, in generated rooms. Preset `fast`, as
far as the picture needs it; what is in the store is not computed again.

`granularity`: the photo, and its masks at three values of split.granularity. `depth`: edges of measured depth on the
photo, as they are with a wrong focal length, and as they should be. `poses`: the dense points as they should be, with
poses that jitter, and with depth of another scale. `fog`: a gripper that moves along with the camera, with and without
`valid` masks. `side`: a room that was photographed from one side only. `missing`: a photo, its masks, and its masks
after Split, where one thing has a mask in this photo alone.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ss_flow.cache.location import open_store
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.generated import Room, RoomParams, generate, write_scene
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import DepthMap, Frame, Gaussians, UInt8
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.deliver.palette import paint_ids
from ss_flow.tasks.deliver.point_view import draw_points, orbit_camera
from ss_flow.tasks.evaluate.novel_view import to_8bit
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, camera_of, looking

WIDTH = 380
"""Of one picture, pixels."""
GAP, QUALITY = 6, 70
WRONG_FOCAL = 1.12
"""A depth sensor's focal length over that of its camera, where the capture says that they are the same."""
WRONG_SCALE = 1.3
"""Depth over what it should be."""
ROOM = RoomParams(objects=8, width=256, height=192, held_out=0)
CEILING = 1.9
"""Height above which points hide what is below, metres."""
TURN = 75.0
"""Degrees between where photos were taken from and where the room is looked at, at last."""


def results(capture: Path, assignments: Sequence[str], store: Store, *names: str) -> dict[str, Any]:
    """Some results of a run."""
    params = settings.apply(settings.preset(Params(), "fast"), assignments)
    run = prepare(open_scene(capture), params, RunOptions(), file_digests(store))

    def build() -> dict[str, Any]:
        outputs = run.build()
        return {name: outputs[name] for name in names}

    values = run_flow(build, store, scene=run.name, header={}).values
    return {
        name: [store.get(one) for one in found] if isinstance(found, tuple | list) else store.get(found)
        for name, found in values.items()
    }


def of_room(room: Room, store: Store, *names: str) -> dict[str, Any]:
    """Some results of a room with its own masks, photographed as it stands here, with its poses as they are."""
    with tempfile.TemporaryDirectory() as folder:
        write_scene(room, Path(folder, "room"), masks="truth")
        return results(Path(folder, "room"), ("capture.refine_poses=never",), store, *names)


def photo_of(frame: Frame) -> UInt8:
    return cv2.cvtColor(cv2.imdecode(frame.encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def outlined(photo: UInt8, depth: DepthMap, zoom: float) -> UInt8:
    """The photo with the edges of its depth in red; zoom: by how much the depth is too large."""
    height, width = photo.shape[:2]
    middle = (width / 2, height / 2)
    known = cv2.resize(depth.depth, (width, height), interpolation=cv2.INTER_NEAREST)
    known = cv2.warpAffine(known, cv2.getRotationMatrix2D(middle, 0, zoom), (width, height), flags=cv2.INTER_NEAREST)
    smooth = cv2.medianBlur(known, 5)
    jump = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)) > 0.15 * smooth
    red = cv2.dilate((jump & (smooth > 0)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.where(red[..., None], np.uint8([230, 20, 20]), photo // 2 + 100)


def save(pictures: list[UInt8], file: Path) -> None:
    """The pictures side by side, as a JPEG."""
    height = WIDTH * pictures[0].shape[0] // pictures[0].shape[1]
    small = [cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA) for picture in pictures]
    gap = np.full((height, GAP, 3), 255, np.uint8)
    row = np.hstack([part for picture in small for part in (picture, gap)][:-1])
    cv2.imwrite(str(file), cv2.cvtColor(row, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def of_capture(args: argparse.Namespace, store: Store) -> list[UInt8]:
    """The pictures of `granularity` and of `depth`."""

    def cut(granularity: float, *names: str) -> dict[str, Any]:
        return results(args.capture, [f"split.granularity={granularity}"], store, *names)

    found = cut(1.0, "ingest", "depth")
    number = [frame.name for frame in found["ingest"]].index(args.view)
    photo = photo_of(found["ingest"][number])
    if args.what == "depth":
        return [outlined(photo, found["depth"][number], zoom) for zoom in (WRONG_FOCAL, 1.0)]
    cuts = [cut(granularity, "masks_split")["masks_split"] for granularity in (1.0, 0.45, 0.2)]
    return [photo, *(paint_ids(one[number].ids, photo) for one in cuts)]


def poses(store: Store) -> list[UInt8]:
    """The dense points from above: right, with poses that jitter, with depth of another scale."""
    room = generate(replace(ROOM, views=16))
    rng, moved = np.random.default_rng(0), room.cameras.world_to_camera.copy()
    for pose in moved:
        shaken = np.eye(4)
        shaken[:3, :3], shaken[:3, 3] = cv2.Rodrigues(rng.normal(0, np.radians(2), 3))[0], rng.normal(0, 0.06, 3)
        pose[:] = shaken @ pose
    jittered = replace(room, cameras=replace(room.cameras, world_to_camera=moved))
    pictures = []
    camera = orbit_camera(room.points[room.points[:, 2] < CEILING], elevation_deg=50)
    for one, scale in ((room, 1.0), (jittered, 1.0), (replace(room, depth=WRONG_SCALE * room.depth), WRONG_SCALE)):
        cloud = of_room(one, store, "dense")["dense"]
        below = cloud.points[:, 2] < CEILING * scale
        pictures.append(draw_points(cloud.points[below], cloud.colors[below], camera, cloud.spacing))
    return pictures


def fog(store: Store) -> list[UInt8]:
    """A photo with a gripper, and what a view kept back shows: without `valid` masks, and with them."""
    room = generate(replace(ROOM, views=16, held_out=1, gripper=True))
    unmasked = replace(room, valid=np.ones_like(room.valid))
    camera = camera_of(room.held_out.cameras, 0)
    scenes = [of_room(one, store, "scene")["scene"] for one in (unmasked, room)]
    return [room.rgb[0], *(drawn(scene, camera) for scene in scenes)]


def side(store: Store) -> list[UInt8]:
    """A photo of a room that was taken from one side, its rendering, and the room rendered from another side."""
    room = generate(replace(ROOM, views=24))
    kept = slice(0, 5)
    cameras = replace(
        room.cameras,
        names=room.cameras.names[kept],
        **{name: getattr(room.cameras, name)[kept] for name in ("sizes", "intrinsics", "world_to_camera")},
    )
    views = {name: getattr(room, name)[kept] for name in ("rgb", "depth", "ids", "parts", "valid")}
    scene = of_room(replace(room, cameras=cameras, **views), store, "scene")["scene"]
    middle = camera_of(cameras, 2)
    return [room.rgb[2], drawn(scene, middle), drawn(scene, beside(middle, TURN))]


def missing(store: Store) -> list[UInt8]:
    """A photo, its masks, and its masks after Split: one thing has a mask in this photo alone."""
    room = generate(replace(ROOM, views=16))
    areas = np.array([[int((ids == thing.instance_id).sum()) for thing in room.objects] for ids in room.ids])
    view, thing = np.unravel_index(areas.argmax(), areas.shape)
    ids = np.where(room.ids == room.objects[thing].instance_id, 0, room.ids)
    ids[view] = room.ids[view]
    after = of_room(replace(room, ids=ids), store, "masks_split")["masks_split"][view].ids
    return [room.rgb[view], *(paint_ids(one.astype(np.int32), room.rgb[view]) for one in (ids[view], after))]


def beside(camera: Camera, degrees: float) -> Camera:
    """A camera as far from the middle of the room, turned about the vertical through it."""
    turn = cv2.Rodrigues(np.radians([0, 0, degrees]))[0]
    eye = turn @ camera.center
    forward = turn @ camera.world_to_camera[2, :3]
    return replace(camera, world_to_camera=looking(eye, forward, np.array([0.0, 0.0, 1.0])))


def drawn(scene: Gaussians, camera: Camera) -> UInt8:
    return to_8bit(render(scene, camera).rgb)


IN_ROOMS = {"poses": poses, "fog": fog, "side": side, "missing": missing}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("granularity", "depth", *IN_ROOMS))
    parser.add_argument("file", type=Path)
    parser.add_argument("--cache", required=True)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--view")
    args = parser.parse_args()
    store = open_store(args.cache)
    save(IN_ROOMS[args.what](store) if args.what in IN_ROOMS else of_capture(args, store), args.file)


if __name__ == "__main__":
    main()
