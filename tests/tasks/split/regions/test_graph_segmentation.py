"""RGB-D segmentation without weights, on ray-cast rooms with exact labels."""

import numpy as np
import pytest

from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame
from ss_flow.tasks.geometry.cameras import Camera, camera_of, looking
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.split.regions.graph_segmentation import Boundary, RegionGraph, boundaries, find_planes, surface_of
from ss_flow.tasks.split.segment_rgbd import SegmentRgbdParams, segment_rgbd

WIDTH, HEIGHT, FOCAL = 320, 240, 290.0
CAMERA = Camera(80, 60, 70.0, 70.0, 40.0, 30.0, np.eye(4))


def cameras_at(eye, target) -> Cameras:
    forward = np.subtract(target, eye)
    pose = looking(np.array(eye, float), forward / np.linalg.norm(forward), np.array([0, 0, 1.0]))
    return Cameras(
        ("view",),
        np.array([[WIDTH, HEIGHT]], np.int32),
        np.array([[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]]),
        pose[None],
        True,
    )


def ray_cast(cameras: Cameras, boxes, spheres, noise=0.0):
    """A checkered room: floor z = 0 (id 1), wall y = 2 (id 2), then axis-aligned boxes (centre, size) and spheres
    (centre, radius) in this order. Returns rgb, z-depth, ids."""
    camera = camera_of(cameras, 0)
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(u - camera.cx) / FOCAL, (v - camera.cy) / FOCAL, np.ones_like(u)], axis=-1)
    d, o = rays @ camera.world_to_camera[:3, :3], camera.center
    hits = []
    with np.errstate(all="ignore"):
        for axis, place, sign in ((2, 0.0, 1), (1, 2.0, -1)):
            hits.append(((place - o[axis]) / d[..., axis], sign * np.eye(3)[axis] + 0 * d))
        for centre, size in boxes:
            near, far = ((np.array(centre) + s * np.array(size) / 2 - o) / d for s in (-1, 1))
            low, high = np.minimum(near, far), np.maximum(near, far)
            enter = low.max(axis=-1)
            normal = -np.sign(d) * (low == enter[..., None])
            hits.append((np.where(enter < high.min(axis=-1), enter, np.inf), normal))
        for centre, radius in spheres:
            a, b, c = (d * d).sum(-1), d @ (o - centre), (o - centre) @ (o - centre) - radius**2
            t = (-b - np.sqrt(b * b - a * c)) / a
            hits.append((t, (o + d * t[..., None] - centre) / radius))
    distance = np.stack([np.where(t > 1e-3, t, np.inf) for t, _ in hits])
    nearest = distance.argmin(axis=0)
    z = np.take_along_axis(distance, nearest[None], 0)[0]
    normal = np.take_along_axis(np.stack([n for _, n in hits]), nearest[None, ..., None], 0)[0]
    palette = np.random.default_rng(3).uniform(60, 220, (len(hits), 3))
    checker = 0.8 + 0.3 * (np.floor((o + d * z[..., None]) * 8 + 1e-4).sum(axis=-1) % 2)
    light = 0.55 + 0.45 * np.clip(normal @ np.array([0.4, -0.5, 0.77]), 0, 1)
    rng = np.random.default_rng(0)
    rgb = palette[nearest] * (checker * light)[..., None] + rng.normal(0, 3, d.shape)
    depth = z + rng.normal(0, noise, z.shape) * z**2
    return np.clip(rgb, 0, 255).astype(np.uint8), depth.astype(np.float32), nearest + 1


TABLE = [((0, 0.6, 0.36), (1.6, 0.9, 0.08)), ((0, 0.6, 0.16), (0.3, 0.3, 0.32))]
BOXES = [
    *TABLE,
    ((-0.5, 0.5, 0.52), (0.25, 0.2, 0.24)),
    ((0.15, 0.75, 0.55), (0.2, 0.25, 0.3)),
    ((1.2, 0.9, 0.25), (0.5,) * 3),
]
SPHERES = [(np.array([0.5, 0.4, 0.52]), 0.12), (np.array([-0.1, 0.35, 0.5]), 0.1), (np.array([-1.2, 0.2, 0.25]), 0.25)]
EYES = [(1.2, -1.6, 1.5), (-0.8, -1.7, 1.3), (0.2, -1.9, 1.0)]


def segmented(eye, noise=0.0, lines=0, **params):
    cameras = cameras_at(eye, (0, 0.6, 0.3))
    rgb, depth, ids = ray_cast(cameras, BOXES, SPHERES, noise)
    if lines:
        depth[::lines], depth[:, ::lines] = 0, 0
    frame = Frame("view", WIDTH, HEIGHT, encode_png(rgb), np.zeros(0, np.uint8), WIDTH, HEIGHT)
    depth_map, camera = DepthMap("view", depth, "sensor"), camera_of(cameras, 0)
    return segment_rgbd(frame, depth_map, camera, params=SegmentRgbdParams(**params)), ids


@pytest.mark.parametrize(
    ("noise", "lines"),
    [(0.0, 0), (0.003, 0), (0.0, 9)],
    ids=["exact depth", "depth noise of 3 mm at 1 m", "every ninth row and column unknown, as after a warp"],
)
def test_objects_of_a_room_are_found(noise, lines):
    best = []
    for eye in EYES:
        masks, ids = segmented(eye, noise, lines)
        dense = masks.dense()
        for instance in np.unique(ids):
            truth = ids == instance
            if truth.mean() >= 0.01:
                best.append(((dense & truth).sum(axis=(1, 2)) / (dense | truth).sum(axis=(1, 2))).max())
    assert len(best) >= 20
    assert np.mean(best) > 0.8
    assert np.mean(np.array(best) > 0.5) > 0.85


def test_same_view_gives_the_same_masks():
    first, second = segmented(EYES[0])[0], segmented(EYES[0])[0]
    for field in ("packed", "predicted_iou", "stability", "grid", "parent"):
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))


def test_masks_come_in_order_of_area_with_parents_that_hold_them():
    masks, _ = segmented(EYES[0])
    dense = masks.dense()
    areas = dense.sum(axis=(1, 2))
    assert (np.diff(areas) <= 0).all() and areas.min() >= 0.0025 * WIDTH * HEIGHT
    children = np.flatnonzero(masks.parent >= 0)
    assert children.size
    for child in children:
        assert (dense[child] & dense[masks.parent[child]]).sum() >= 0.9 * areas[child]
    assert ((masks.predicted_iou >= 0) & (masks.predicted_iou <= 1)).all()
    assert ((masks.stability > 0) & (masks.stability <= 1)).all()


def test_view_without_any_depth_still_gives_masks_and_ignored_pixels_are_in_none():
    rgb = np.full((60, 80, 3), 60, np.uint8)
    rgb[20:50, 30:60] = (220, 40, 40)
    valid = np.full((60, 80), 255, np.uint8)
    valid[:, 70:] = 0
    frame = Frame("v", 80, 60, encode_png(rgb), encode_png(valid), 80, 60)
    empty = DepthMap("v", np.zeros((30, 40), np.float32), "sensor")
    dense = segment_rgbd(frame, empty, CAMERA, params=SegmentRgbdParams()).dense()
    truth = rgb[..., 0] > 200
    assert ((dense & truth).sum(axis=(1, 2)) / (dense | truth).sum(axis=(1, 2))).max() > 0.9
    assert not dense[:, :, 70:].any()


def test_frame_in_which_no_pixel_counts_has_no_masks():
    frame = Frame(
        "v", 80, 60, encode_png(np.zeros((60, 80, 3), np.uint8)), encode_png(np.zeros((60, 80), np.uint8)), 80, 60
    )
    depth = DepthMap("v", np.ones((60, 80), np.float32), "sensor")
    assert len(segment_rgbd(frame, depth, CAMERA, params=SegmentRgbdParams())) == 0


def plane_depth(normal, offset):
    """z-depth of the plane normal . X = offset in the camera's frame."""
    v, u = np.mgrid[:60, :80] + 0.5
    return (offset / (np.stack([(u - 40) / 70, (v - 30) / 70, np.ones_like(u)], -1) @ np.array(normal))).astype(
        np.float32
    )


def test_normals_of_an_oblique_plane_are_its_own():
    normal = np.array([0.3, -0.5, -0.8]) / np.linalg.norm([0.3, -0.5, -0.8])
    surface = surface_of(plane_depth(normal, -2.0), CAMERA)
    inner = surface.normals[6:-6, 6:-6]
    assert np.degrees(np.arccos(np.clip(inner @ normal, -1, 1))).max() < 2
    # The plane's points satisfy its equation.
    np.testing.assert_allclose(surface.points[6:-6, 6:-6] @ normal, -2.0, rtol=5e-3)


@pytest.mark.parametrize(("combine", "ended"), [(np.minimum, True), (np.maximum, False)], ids=["concave", "convex"])
def test_concave_creases_end_a_surface_and_convex_ones_do_not(combine, ended):
    """Two walls that meet at a right angle: the nearer of them at each pixel is a corner of a room, the farther of
    them the edge of a box."""
    left, right = plane_depth([0.7071, 0, -0.7071], -2.0), plane_depth([-0.7071, 0, -0.7071], -2.0)
    boundary = boundaries(surface_of(combine(left, right), CAMERA), np.ones((60, 80), bool), 0.02, 45.0)
    columns = boundary.first % 80
    middle = (columns == 39) & (boundary.second == boundary.first + 1)
    assert (boundary.strength[middle].mean() > 0.8) == ended
    assert boundary.strength[(columns < 25) | (columns > 55)].max() < 0.2


def test_step_in_depth_ends_a_surface_and_slope_does_not():
    depth = plane_depth([0.3, 0, -0.95], -2.0)
    depth[:, 40:] += 0.3
    boundary = boundaries(surface_of(depth, CAMERA), np.ones((60, 80), bool), 0.02, 45.0)
    across = (boundary.first % 80 == 39) & (boundary.second == boundary.first + 1)
    assert boundary.strength[across].min() > 0.9
    assert boundary.strength[~across & (np.abs(boundary.first % 80 - 39) > 6)].max() < 0.2


def test_planes_of_a_room_corner_are_told_apart():
    depth = np.minimum(plane_depth([0.7071, 0, -0.7071], -2.0), plane_depth([-0.7071, 0, -0.7071], -2.0))
    planes = find_planes(surface_of(depth, CAMERA), np.ones((60, 80), bool), 0.1, 0.01)
    assert len(planes) == 2
    sides = sorted(float(np.flatnonzero(plane.any(axis=0)).mean()) for plane in planes)
    assert sides[0] < 30 and sides[1] > 50
    assert not (planes[0] & planes[1]).any()


def test_regions_merge_from_the_weakest_boundary_up_by_the_mean_of_all_they_share():
    """Three pixels in a row, 0 - 1 - 2, of one colour: strength 0.2 then 0.6; then 0 and 1 are one region."""
    regions = np.array([[0, 1, 2]], np.int32)
    boundary = Boundary(
        np.array([0, 1], np.int32),
        np.array([1, 2], np.int32),
        np.array([0.2, 0.6], np.float32),
        np.array([True, True]),
    )
    graph = RegionGraph(regions, np.zeros((1, 3, 3), np.float32), boundary, color_weight=0.2, color_scale=30.0)
    assert graph.strength(0, 1) == pytest.approx(0.2) and graph.strength(1, 2) == pytest.approx(0.6)
    graph.merge(0.5)
    assert graph.owners().tolist() == [0, 0, 2]
    assert graph.enclosures() == pytest.approx({0: 0.6, 2: 0.6})
    graph.merge(0.7)
    assert len(set(graph.owners().tolist())) == 1


def test_colour_decides_alone_where_depth_is_unknown():
    lab = np.array([[[0, 0, 0], [30, 0, 0]]], np.float32)
    pair = np.array([0], np.int32), np.array([1], np.int32), np.zeros(1, np.float32)
    unknown = RegionGraph(np.array([[0, 1]], np.int32), lab, Boundary(*pair, np.array([False])), 0.2, 30.0)
    known = RegionGraph(np.array([[0, 1]], np.int32), lab, Boundary(*pair, np.array([True])), 0.2, 30.0)
    assert unknown.strength(0, 1) == pytest.approx(1 - np.exp(-1))
    assert known.strength(0, 1) == pytest.approx(0.2 * (1 - np.exp(-1)))
