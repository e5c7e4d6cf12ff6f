"""Small captures on disk in every layout, for tests to open and to damage."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Cameras, Frame
from ss_flow.tasks.capture import ingest
from ss_flow.tasks.capture.scene_files import SceneFiles

WIDTH, HEIGHT = 32, 24
NAMES = ("2", "10", "11")


def ref(path: Path | None) -> FileRef | None:
    """A reference to a file; tests of tasks need no digest that is true."""
    return None if path is None else FileRef(path, path.name)


def refs(paths) -> tuple:
    return tuple(ref(p) for p in paths)


def ingested(scene: SceneFiles, **changes) -> tuple[Frame, ...]:
    """The frames of an opened capture, as a run reads them."""
    return ingest.frames(
        names=scene.names,
        photos=refs(scene.photos),
        valid=refs(scene.valid),
        lenses=scene.lenses,
        params=ingest.IngestParams(**changes),
    )


def photo(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)
    return path


def depth_image(millimetres: int = 2000, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.full((height, width), millimetres, np.uint16)


def cameras_of(frames: tuple[Frame, ...], radial: float = 0.0) -> Cameras:
    """Cameras of frames as structure from motion finds them, with this radial distortion of their photos."""
    return Cameras(
        names=tuple(frame.name for frame in frames),
        sizes=np.array([(frame.width, frame.height) for frame in frames], np.int32),
        intrinsics=np.array([(frame.width, frame.width, frame.width / 2, frame.height / 2) for frame in frames], float),
        world_to_camera=np.tile(np.eye(4), (len(frames), 1, 1)),
        metric=False,
        radial=np.full(len(frames), radial) if radial else np.zeros(0),
    )


def pose(x: float) -> np.ndarray:
    """Camera-to-world, turned by 90 degrees about y and moved."""
    return np.array([[0, 0, 1, x], [0, 1, 0, 0.5], [-1, 0, 0, -1], [0, 0, 0, 1]], float)


WORLD_TO_CAMERA = np.stack([np.linalg.inv(pose(i)) for i in range(3)])
"""[3, 4, 4] of the views of most layouts."""


def photos(root: Path) -> Path:
    for i, name in enumerate(NAMES):
        write(root / f"{name}.jpg", photo(i))
    return root


def scannet(root: Path) -> Path:
    for i, name in enumerate(NAMES):
        write(root / "color" / f"{name}.jpg", photo(i))
        write(root / "depth" / f"{name}.png", depth_image(1000 + i, WIDTH // 2, HEIGHT // 2))
        write(root / "valid" / f"{name}.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
        write(root / "instance" / f"{name}.png", np.full((HEIGHT, WIDTH), 3, np.uint16))
        (root / "pose").mkdir(exist_ok=True)
        np.savetxt(root / "pose" / f"{name}.txt", pose(i))
    (root / "intrinsic").mkdir()
    color = np.diag([30.0, 30.0, 1.0, 1.0])
    color[0, 2], color[1, 2] = 15.5, 11.5
    depth = np.diag([15.0, 15.0, 1.0, 1.0])
    depth[0, 2], depth[1, 2] = 7.5, 5.5
    np.savetxt(root / "intrinsic" / "intrinsic_color.txt", color)
    np.savetxt(root / "intrinsic" / "intrinsic_depth.txt", depth)
    return root


def nerfstudio(root: Path, **changes) -> Path:
    frames = []
    for i, name in enumerate(NAMES):
        write(root / "images" / f"{name}.png", photo(i))
        write(root / "depth" / f"{name}.png", depth_image())
        opengl = pose(i) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "depth_file_path": f"depth/{name}.png",
                "transform_matrix": opengl.tolist(),
            }
        )
    document = {"w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 31.0, "cx": 16.0, "cy": 12.0, "frames": frames}
    (root / "transforms.json").write_text(json.dumps({**document, **changes}))
    return root


def tum(root: Path) -> Path:
    rgb, depth, track = ["# time file"], ["# time file"], ["# time tx ty tz qx qy qz qw"]
    for i, name in enumerate(NAMES):
        write(root / "rgb" / f"{name}.png", photo(i))
        write(root / "depth" / f"{name}.png", depth_image(5000))
        rgb.append(f"{100 + i}.00 rgb/{name}.png")
        depth.append(f"{100 + i}.01 depth/{name}.png")
        track.append(f"{100 + i}.005 {i} 0.5 -1 0 {np.sqrt(0.5)} 0 {np.sqrt(0.5)}")
    (root / "rgb.txt").write_text("\n".join(rgb))
    (root / "depth.txt").write_text("\n".join(depth))
    (root / "groundtruth.txt").write_text("\n".join(track))
    return root


def replica(root: Path, **changes) -> Path:
    """A room in the form of NICE-SLAM; changes: of its camera."""
    for i in range(len(NAMES)):
        write(root / "results" / f"frame{i:06d}.jpg", photo(i))
        write(root / "results" / f"depth{i:06d}.png", depth_image(13107))
    rows = [" ".join(map(str, pose(i).ravel())) for i in range(len(NAMES))]
    (root / "traj.txt").write_text("\n".join(rows))
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5, **changes}
    (root / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return root


def colmap(root: Path, binary: bool = True, registered: int = 3) -> Path:
    """A workspace with two models: `sparse/0` with one image, `sparse/1` with all."""
    for i, name in enumerate(NAMES):
        write(root / "images" / f"{name}.png", photo(i))
    _colmap_model(root / "sparse" / "0", 1, binary)
    _colmap_model(root / "sparse" / "1", registered, binary)
    return root


def _colmap_model(folder: Path, count: int, binary: bool) -> None:
    folder.mkdir(parents=True)
    half = np.sqrt(0.5)
    rows = []
    for i, name in list(enumerate(NAMES))[:count]:
        inverse = np.linalg.inv(pose(i))
        rows.append((i + 1, (half, 0.0, -half, 0.0), inverse[:3, 3], f"{name}.png"))
    points = [(1, (0.5, 1.5, 2.5)), (2, (3.0, 4.0, 5.0))]
    if binary:
        parameters = (30.0, 16.0, 12.0, 0.0)
        (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 7, 2, WIDTH, HEIGHT, *parameters))
        images = struct.pack("<Q", len(rows))
        for image, quaternion, translation, name in rows:
            images += struct.pack("<I7dI", image, *quaternion, *translation, 7) + name.encode() + b"\0"
            images += struct.pack("<Q", 2) + struct.pack("<ddQ", 1, 2, 1) * 2
        (folder / "images.bin").write_bytes(images)
        data = struct.pack("<Q", len(points))
        for number, xyz in points:
            data += struct.pack("<Q3d3BdQ", number, *xyz, 1, 2, 3, 0.5, 2) + struct.pack("<II", 1, 0) * 2
        (folder / "points3D.bin").write_bytes(data)
        return
    (folder / "cameras.txt").write_text(f"# cameras\n7 SIMPLE_RADIAL {WIDTH} {HEIGHT} 30 16 12 0.0\n")
    lines = ["# images"]
    for image, quaternion, translation, name in rows:
        numbers = " ".join(repr(float(x)) for x in (*quaternion, *translation))
        lines += [f"{image} {numbers} 7 {name}", "" if image == 2 else "1 2 1 3 4 -1"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("# points\n1 0.5 1.5 2.5 1 2 3 0.5 1 0 3 0\n2 3 4 5 1 2 3 0.5\n")


def sens(path: Path, count: int = 3) -> Path:
    color, depth = np.eye(4), np.eye(4)
    color[0, 0] = color[1, 1] = 30
    color[0, 2], color[1, 2] = 15.5, 11.5
    depth[0, 0] = depth[1, 1] = 15
    depth[0, 2], depth[1, 2] = 7.5, 5.5
    data = struct.pack("<IQ", 4, 4) + b"test"
    for matrix in (color, np.eye(4), depth, np.eye(4)):
        data += struct.pack("<16f", *matrix.ravel())
    data += struct.pack("<iiIIIIfQ", 2, 1, WIDTH, HEIGHT, WIDTH // 2, HEIGHT // 2, 1000.0, count)
    for i in range(count):
        jpeg = cv2.imencode(".jpg", photo(i))[1].tobytes()
        packed = zlib.compress(depth_image(1000 + i, WIDTH // 2, HEIGHT // 2).tobytes())
        matrix = np.full((4, 4), -np.inf) if i == 1 else pose(i)
        data += struct.pack("<16fQQQQ", *matrix.ravel(), i, i, len(jpeg), len(packed)) + jpeg + packed
    path.write_bytes(data)
    return path


def video(path: Path, count: int = 40) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for i in range(count):
        image = cv2.resize(photo(i, 16, 12), (64, 48), interpolation=cv2.INTER_NEAREST)
        writer.write(image if i % 4 == 1 else cv2.GaussianBlur(image, (0, 0), 4))
    writer.release()
    return path


def phone_pose(x: float, turns: int) -> np.ndarray:
    """Camera-to-world (x right, y down, z forward) of a phone in a world with y up, whose stored photo must be turned
    so many quarters counterclockwise to stand upright."""
    forward = np.array([0.0, 0.0, -1.0])
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    for _ in range(turns):  # what is up in the world lies to the right of a photo that misses one turn
        right, down = -down, right
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, down, forward, (x, 1.5, 4.0)])
    return matrix


def lying_lens() -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of that phone, for a photo that is WIDTH x HEIGHT when it lies as it is stored."""
    return 30.0, 31.0, 16.5, 11.0


def polycam(root: Path, turns: int = 0, corrected: bool = True, **changes) -> Path:
    """Photos, depth and confidence stored lying; the phone stands upright after so many quarter turns."""
    for i, name in enumerate(NAMES):
        for prefix in ("", "corrected_") if corrected else ("",):
            write(root / "keyframes" / f"{prefix}images" / f"{name}.jpg", photo(i + 10 * bool(prefix)))
            moved = phone_pose(i + 5 * (not prefix and corrected), turns) @ np.diag([1.0, -1.0, -1.0, 1.0])
            values = {f"t_{r}{c}": moved[r, c] for r in range(3) for c in range(4)}
            lens = dict(zip(("fx", "fy", "cx", "cy"), lying_lens(), strict=True))
            document = {"width": WIDTH, "height": HEIGHT, **lens, **values, "blur_score": 100.0, **changes}
            folder = root / "keyframes" / f"{prefix}cameras"
            folder.mkdir(exist_ok=True)
            (folder / f"{name}.json").write_text(json.dumps(document))
        depth = depth_image(1000 + i, 16, 12)
        depth[0, :4] = 3000
        confidence = np.full((12, 16), 255, np.uint8)
        confidence[0, :3], confidence[0, 3] = 0, 127
        write(root / "keyframes" / "depth" / f"{name}.png", depth)
        write(root / "keyframes" / "confidence" / f"{name}.png", confidence)
    return root


STRAY_HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"


def stray(root: Path, turns: int = 0, frames: int = 4, lens_of_rows: bool = False, size=(64, 48)) -> Path:
    """A recording whose frame n has the gray level 40 n on its left half, and black on its right one."""
    from scipy.spatial.transform import Rotation

    root.mkdir(parents=True, exist_ok=True)
    width, height = size
    video = cv2.VideoWriter(str(root / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, size)
    lines = [STRAY_HEADER + (", fx, fy, cx, cy, distortion_center_x" if lens_of_rows else "")]
    for i in range(frames):
        image = np.zeros((height, width, 3), np.uint8)
        image[:, : width // 2] = 40 * (i + 1) % 256
        video.write(image)
        write(root / "depth" / f"{i:06d}.png", depth_image(1000 + i, 16, 12))
        confidence = np.full((12, 16), 2, np.uint8)
        confidence[0, 0] = 0
        write(root / "confidence" / f"{i:06d}.png", confidence)
        matrix = phone_pose(i, turns)
        quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        numbers = [*matrix[:3, 3], *quaternion, *((60.0 + i, 60.0, 32.0, 24.0) if lens_of_rows else ())]
        lines.append(f"{100 + i / 30}, {i:06d}, " + ", ".join(map(repr, map(float, numbers))) + ", " * lens_of_rows)
    video.release()
    (root / "odometry.csv").write_text("\n".join(lines))
    (root / "camera_matrix.csv").write_text("60.0, 0.0, 32.0\n0.0, 60.0, 24.0\n0.0, 0.0, 1.0")
    return root
