"""Small captures that are spoilt, and how they are refused."""

import json
from pathlib import Path

import capture_folders as made
import pytest
from capture_folders import ref, refs

from ss_flow.errors import InputError
from ss_flow.tasks.capture.id_images import ground_truth, ready_masks
from ss_flow.tasks.capture.ingest import cameras, frames
from ss_flow.tasks.capture.recordings import sens_depth, sens_frames
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.sensor_depth import depth
from ss_flow.tasks.capture.video import video_frames


def read_all(path: Path) -> None:
    """What a run does first: open the capture and read everything of it."""
    scene = open_scene(path)
    if scene.kind == "video":
        video_frames(video=ref(scene.recording))
        return
    if scene.kind == "sens":
        entries = {"recording": ref(scene.recording), "names": scene.names, "entries": scene.entries}
        sens_depth(sens_frames(**entries), **entries)
        return
    names, lenses = scene.names, scene.lenses
    views = frames(names=names, photos=refs(scene.photos), valid=refs(scene.valid), lenses=lenses)
    if scene.poses:
        cameras(views, names=names, lenses=lenses, poses=scene.poses, metric=scene.metric, sparse=ref(scene.sparse))
    if scene.depths:
        depth(
            views,
            names=names,
            files=refs(scene.depths),
            scale=scene.depth_scale,
            metric=scene.metric,
            lenses=lenses,
            depth_lens=scene.depth_lens,
        )
    if scene.ready_masks:
        ready_masks(views, made.cameras_of(views), names=names, files=refs(scene.ready_masks), lenses=lenses)
    if scene.ground_truth:
        ground_truth(views, made.cameras_of(views), names=names, files=refs(scene.ground_truth), lenses=lenses)


class Cases:
    """Ways to spoil a capture, by name: each makes one below a folder, and returns the path to open."""

    def __init__(self) -> None:
        self.known = {}

    def __call__(self, named: str, says: str):
        """Register a way, what its refusal names, and what it says."""

        def register(spoil):
            self.known[spoil.__name__] = (spoil, named, says)
            return spoil

        return register

    def assert_refused(self, name: str, folder: Path) -> None:
        """Spoil a capture in this way, and read it."""
        spoil, named, says = self.known[name]
        root = folder / "scene"
        root.mkdir()
        path = spoil(root)
        with pytest.raises(InputError) as refusal:
            read_all(path)
        sentence = str(refusal.value)
        assert says in sentence, sentence
        assert named in sentence, sentence
        assert "\n" not in sentence and sentence.endswith("."), sentence


def cut(path: Path, keep: float = 0.6) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def edit_json(root: Path, change) -> None:
    document = json.loads((root / "transforms.json").read_text())
    change(document)
    (root / "transforms.json").write_text(json.dumps(document))
