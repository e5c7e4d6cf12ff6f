"""report.html: one file that shows a run, with its pictures inside; it loads nothing from anywhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import PurePath
from typing import Any

import numpy as np

from ss_flow.tasks.artifacts import PointLabels
from ss_flow.tasks.deliver.compressed import Picture, Thumbnail, data_uri
from ss_flow.tasks.deliver.edit_words import EditWords
from ss_flow.tasks.deliver.instances_json import DOUBTFUL, is_doubtful
from ss_flow.tasks.deliver.timeline import timeline

_KINDS = {
    "photo": "Photo",
    "masks_split": "Masks after Split",
    "masks": "Masks after Splat",
    "render": "Rendering",
    "depth": "Depth",
}
_METRIC_NAMES = {
    "miou": "mIoU",
    "macc25": "mAcc @ 0.25",
    "macc50": "mAcc @ 0.5",
    "pq": "PQ",
    "pq_things": "PQ of things",
    "sq": "SQ",
    "rq": "RQ",
    "psnr": "PSNR",
    "psnr_neighbour_colours": "PSNR, colours of the photos beside",
    "psnr_colour_fitted": "PSNR, colours fitted to each view",
    "ssim": "SSIM",
    "lpips": "LPIPS (VGG)",
    "lpips_unscaled": "LPIPS (VGG) of pictures 0..1, as in 3DGS",
    "ap": "AP",
    "ap50": "AP @ 0.5",
    "ap25": "AP @ 0.25",
    "hungarian_miou": "mIoU, one-to-one",
    "whole": "Instances in one piece",
    "over_segmentation": "Instances split up",
    "under_segmentation": "Predictions that mix instances",
    "num_truth": "True instances",
    "num_predicted": "Predicted instances",
}
_STAGES = {"split": "After Split", "refined": "Refined masks", "splat": "After Splat", "novel_view": "Novel views"}
_BINS = 10
_OF_ANY_CAPTURE = ("color", "frames", "images", "input", "photos", "rgb", "transforms.json")


@dataclass(frozen=True)
class Votes:
    """How far the views agree on the dense points (Split&Splat, Sec. 3.1.3)."""

    labelled: float
    """Share of the points that got a label."""
    contested: float
    """Share of which the best label has less than tau_label of the votes."""
    without: float
    """Share that no mask voted for."""
    tau_label: float
    histogram: tuple[float, ...]
    """Of the points with votes, the share in each tenth of agreement, 0..1, relative to the largest."""

    @classmethod
    def of(cls, pieces: PointLabels, tau_label: float) -> Votes:
        """pieces: the points as `split.propagate` labels them."""
        voted = pieces.confidence[pieces.confidence > 0]
        counts, _ = np.histogram(voted, _BINS, (0, 1))
        return cls(
            float((pieces.label > 0).mean()),
            float((voted < tau_label).sum() / max(len(pieces.label), 1)),
            1 - len(voted) / max(len(pieces.label), 1),
            tau_label,
            tuple((counts / max(counts.max(), 1)).tolist()),
        )


@dataclass(frozen=True)
class Insight:
    """What a report tells of a run besides its documents."""

    thumbnails: Sequence[Thumbnail]
    """Of the instances that a view shows."""
    suspects: Sequence[Mapping[str, Any]]
    """What `suspects.suspects` found."""
    votes: Votes


@dataclass(frozen=True)
class Comparison:
    """How a run differs from another one; in each pair the other's value comes first."""

    name: str
    """Of the other."""
    changed: Mapping[str, Sequence[Any]]
    """Parameters and networks that are not the same."""
    metrics: Mapping[str, Sequence[float | None]]
    """By "stage.name"; None where one was not measured."""
    agreement: float | None
    """Mean IoU of the objects of both, one without a partner counting 0; None where no view is in both."""
    objects: Sequence[str]
    """What became of objects, in words; "the first" is the other run."""


def report_html(
    run: Mapping[str, Any],
    *,
    pictures: Sequence[Picture],
    instances: Mapping[str, Any] | None = None,
    insight: Insight | None = None,
    comparison: Comparison | None = None,
) -> str:
    """The report of a run.

    run: the document of run.json ("status", "scene", "params", "models", "metrics", "nodes", "warnings", "failures",
    "edit"; any may be missing). pictures: named "VIEW/KIND" with the kinds photo, masks_split, masks, render, depth,
    which are shown in one row a view ("VIEW/KIND, NOTE" adds to the caption), or by their caption. instances: the
    document of instances.json. Those that fill most of the views come first, walls and floors after things; what is
    doubtful, and crumbs, are folded away.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = resources.files(__package__ or "").joinpath("report.html.jinja").read_text(encoding="utf-8")
    views, others = _views(pictures)
    nodes = list(run.get("nodes") or ())
    thumbnails = {one.instance_id: one for one in insight.thumbnails} if insight else {}
    shares = {i: one.share for i, one in thumbnails.items()}
    listed = sorted(
        (instances or {}).get("instances", []),
        key=lambda e: (e["kind"] == "stuff", -shares.get(e["id"], 0.0), -e["num_points"]),
    )
    return environment.from_string(template).render(
        scene=title_of(PurePath(str(run.get("scene") or ""))),
        status=run.get("status") or "unknown",
        edit=EditWords.of(run["edit"]) if "edit" in run else None,
        models=_flat(run.get("models") or {}),
        metrics=_metrics(run.get("metrics") or {}),
        stages=_stages(run.get("metrics") or {}),
        params=_flat(run.get("params") or {}),
        failures=[_failure(failure) for failure in run.get("failures") or ()],
        warnings=run.get("warnings") or (),
        steps=_steps(nodes),
        hits=sum(bool(node.get("hit")) for node in nodes),
        misses=sum(not node.get("hit") for node in nodes),
        seconds=_duration(sum(float(node.get("seconds") or 0) for node in nodes if not node.get("hit"))),
        peak=max((float(node.get("peak_rss_mb") or 0) for node in nodes), default=0.0),
        views=views,
        others=others,
        instances=[entry for entry in listed if not (entry["crumb"] or is_doubtful(entry))],
        doubtful=[entry for entry in listed if is_doubtful(entry)],
        doubtful_below=DOUBTFUL,
        crumbs=[entry for entry in listed if entry["crumb"]],
        shares=shares,
        thumbnails={i: data_uri(one.content) for i, one in thumbnails.items()},
        suspects=insight.suspects if insight else (),
        votes=insight.votes if insight else None,
        timeline=timeline(nodes),
        comparison=comparison,
        differences=_differences(comparison.metrics if comparison else {}),
    )


def title_of(scene: PurePath) -> str:
    """What a capture is called for people: its last name; where many captures have that one, the folder around it."""
    return (scene.parent.name if scene.name.lower() in _OF_ANY_CAPTURE else "") or scene.name or "scene"


def _views(pictures: Sequence[Picture]) -> tuple[list[dict[str, Any]], list[dict[str, str]]]:
    rows: dict[str, dict[str, dict[str, str]]] = {}
    others = []
    for picture in pictures:
        view, _, last = picture.name.rpartition("/")
        kind, comma, note = last.partition(", ")
        if view and kind in _KINDS:
            shown = {"caption": _KINDS[kind] + comma + note, "uri": data_uri(picture.content)}
            rows.setdefault(view, {})[kind] = shown
        else:
            others.append({"caption": picture.name, "uri": data_uri(picture.content)})
    views = [
        {"name": view, "pictures": [found[kind] for kind in _KINDS if kind in found]} for view, found in rows.items()
    ]
    return views, others


_BY_STAGE = ("split", "refined", "splat")


def _stages(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """What was measured of the masks after each stage, as one table: heads, and a row a figure."""
    found = {stage: metrics[stage] for stage in _BY_STAGE if isinstance(metrics.get(stage), Mapping)}
    names = dict.fromkeys(name for values in found.values() for name in values)
    rows = [
        (_words(name), [_figure(name, values[name]) if name in values else "" for values in found.values()])
        for name in names
    ]
    return {"heads": [_STAGES[stage] for stage in found], "rows": rows}


def _metrics(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What else was measured, a group each."""
    groups: list[dict[str, Any]] = []
    loose = []
    for stage, values in metrics.items():
        if isinstance(values, Mapping):
            if stage in _BY_STAGE:
                continue
            figures = [(_words(name), _figure(name, value)) for name, value in values.items()]
            if stage == "novel_view" and "lpips" not in values:
                figures.append((_words("lpips"), "not measured (no network)"))
            groups.append({"stage": _STAGES.get(stage) or _words(stage), "figures": figures})
        else:
            loose.append((_words(stage), _figure(stage, values)))
    return groups + ([{"stage": "Measured", "figures": loose}] if loose else [])


def _differences(metrics: Mapping[str, Sequence[float | None]]) -> list[tuple[str, str, str, str]]:
    """A row a figure that is told differently: what it is, the other's, this one's, and the difference."""
    rows = []
    for name, (other, own) in metrics.items():
        stage, _, metric = name.partition(".")
        told = _figure(metric, other), _figure(metric, own)
        if told[0] != told[1]:
            when = _STAGES.get(stage) or _words(stage)
            difference = "" if own is None or other is None else f"{own - other:+.3f}"
            rows.append((f"{_words(metric)} ({when[:1].lower()}{when[1:]})", *told, difference))
    return rows


def _words(name: str) -> str:
    """What a metric is called: its field's name for it, or its key as words."""
    text = name.replace("_", " ")
    return _METRIC_NAMES.get(name, text[:1].upper() + text[1:])


def _figure(name: str, value: object) -> str:
    if not isinstance(value, int | float):
        return "–" if value is None else str(value)
    if name.startswith("num_") or isinstance(value, int):
        return f"{value:.0f}"
    return f"{value:.2f} dB" if name.startswith("psnr") else f"{value:.3f}"


def _steps(nodes: list[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Nodes of one step together, in the order in which the steps first appear."""
    found: dict[str, dict[str, Any]] = {}
    for node in nodes:
        step = found.setdefault(str(node.get("step", "?")), {"hits": 0, "misses": 0, "seconds": 0.0, "peak": 0.0})
        step["peak"] = max(step["peak"], float(node.get("peak_rss_mb") or 0))
        if node.get("hit"):
            step["hits"] += 1
        else:
            step["misses"] += 1
            step["seconds"] += float(node.get("seconds") or 0)
    longest = max((step["seconds"] for step in found.values()), default=0.0)
    return [
        {
            "name": name,
            "nodes": step["hits"] + step["misses"],
            "hits": step["hits"],
            "time": _duration(step["seconds"]) if step["misses"] else "from the cache",
            "share": 100 * step["seconds"] / longest if longest > 0 else 0.0,
            "peak": f"{step['peak']:.0f} MB" if step["peak"] else "",
        }
        for name, step in found.items()
    ]


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.2f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _flat(values: object, prefix: str = "") -> list[tuple[str, str]]:
    """Nested parameters as dotted names and text, in their own order."""
    if isinstance(values, Mapping):
        rows = []
        for name, value in values.items():
            rows += _flat(value, f"{prefix}.{name}" if prefix else str(name))
        return rows
    if isinstance(values, list | tuple):  # a tuple comes back from run.json as a list
        text = str(tuple(values))
    else:
        text = "–" if values is None else f"{values:g}" if isinstance(values, float) else str(values)
    return [(prefix, text)]


def _failure(failure: object) -> str:
    if not isinstance(failure, Mapping):
        return str(failure)
    place = " ".join(str(failure[key]) for key in ("label", "step", "item") if failure.get(key) not in (None, ""))
    reason = str(failure.get("error") or failure.get("reason") or failure.get("message") or "failed")
    return f"{place}: {reason}" if place else reason
