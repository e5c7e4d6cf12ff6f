"""One HTML file that shows a finished run: its Gaussians, and a list of its objects. It loads nothing from anywhere.

The Gaussians are in the file as SPZ (which keeps position, scale, rotation, opacity and base colour in 20 bytes before
compression), the instance of each as 16-bit numbers; page.js reads and draws them.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping
from dataclasses import replace
from importlib import resources
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from ss_flow.cache.files import write_atomically
from ss_flow.flows.results import BACKGROUND, FinishedRun
from ss_flow.flows.view.looking import Viewpoint, start_view
from ss_flow.tasks.artifacts import Float32, Gaussians
from ss_flow.tasks.deliver.compressed import Thumbnail, compressed, data_uri
from ss_flow.tasks.deliver.export.content import morton_order
from ss_flow.tasks.deliver.export.spz import spz
from ss_flow.tasks.deliver.instances_json import is_doubtful
from ss_flow.tasks.deliver.palette import instance_colors
from ss_flow.tasks.deliver.report import title_of
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE

SHOWN = ("scene", "cameras")
"""The results of a run that its page cannot do without."""
_LARGEST_SCALE = 100.0
"""Standard deviation of the largest Gaussian in the page's units: SPZ holds from e^-10 to e^5.9 of them."""
_FAINTEST = 1 / 255
"""Gaussians of less opacity change no pixel."""
_TURNED = np.array([1, -1, -1])
"""From right, down, forward to SPZ's right, up, back."""


def write_page(file: Path, run: FinishedRun) -> None:
    """Write the page of a run, whole or not at all."""
    results = run.results
    scene, cameras = results.one("scene"), results.one("cameras")
    pictured = {one.instance_id: one for one in results.thumbnails()}
    start = start_view(cameras, scene.means)
    objects = [(entry, pictured.get(entry["id"])) for entry in run.instances["instances"]]
    objects.sort(key=lambda of: (is_doubtful(of[0]), -of[1].share if of[1] else 0.0))
    title = title_of(PurePath(str(run.document["scene"])))
    write_atomically(file, page_html(title, scene, start, objects))


def page_html(
    title: str, scene: Gaussians, start: Viewpoint, objects: list[tuple[Mapping[str, Any], Thumbnail | None]]
) -> str:
    """The page of a scene.

    objects: entries of instances.json with a small picture, in the order of the list. Those without
    Gaussians are left out; the background comes last.
    """
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    seen = select(scene, scene.opacities >= _FAINTEST)
    seen = select(seen, np.lexsort((np.argsort(morton_order(seen.means)), seen.instance_id)))
    scales = np.exp(seen.log_scales.max(initial=-np.inf)) if len(seen) else 1.0
    unit = _LARGEST_SCALE / float(scales)
    origin = start.look_at
    fields: list[dict[str, Any]] = []
    for entry, picture in objects:
        own = seen.means[seen.instance_id == entry["id"]]
        if len(own):
            about = f"{_counted(len(own), 'Gaussian')}, confidence {entry['confidence']:.2f}"
            fields.append(_object(entry["id"], entry["name"], about, picture) | _place(own, origin, unit))
    behind = seen.means[seen.instance_id == BACKGROUND]
    if len(behind):
        fields.append(
            _object(BACKGROUND, "background", _counted(len(behind), "Gaussian"), None) | _place(behind, origin, unit)
        )
    colors = instance_colors(-(-(int(seen.instance_id.max(initial=0)) + 1) // 256) * 256)
    document = {
        "objects": fields,
        "palette": np.insert(colors, 3, 255, axis=1).ravel().tolist(),
        "start": {
            "position": ((start.position - origin) * unit * _TURNED).tolist(),
            "look_at": [0.0, 0.0, 0.0],
            "up": (start.up * _TURNED).tolist(),
            "fov": start.fov,
            "near": NEAR_PLANE * unit,
        },
    }
    moved = replace(
        seen,
        means=((seen.means - origin) * unit).astype(np.float32),
        log_scales=seen.log_scales + np.float32(np.log(unit)),
        sh=seen.sh[:, :1],
    )
    template = resources.files(__package__ or "").joinpath("page.html.jinja").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template).render(
        title=title,
        counts=f"{_counted(sum(f['id'] != BACKGROUND for f in fields), 'object')}, {_counted(len(seen), 'Gaussian')}",
        document=document,
        script=Markup(resources.files(__package__ or "").joinpath("page.js").read_text(encoding="utf-8")),
        instances=_text(gzip.compress(seen.instance_id.astype("<u2").tobytes(), mtime=0)),
        gaussians=_text(spz(moved).content.tobytes()),
    )


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'s' * (count != 1)}"


def _object(instance_id: int, name: str, about: str, picture: Thumbnail | None) -> dict[str, Any]:
    """What the list says of an object."""
    color = instance_colors(instance_id + 1)[instance_id]
    content = compressed(np.full((1, 1, 3), color, np.uint8)) if picture is None else picture.content
    fields = {"id": instance_id, "name": name, "about": about}
    return fields | {"color": color.tolist(), "thumbnail": data_uri(content)}


def _place(means: Float32, origin: np.ndarray, unit: float) -> dict[str, Any]:
    """Where an object is and how large, in the page's units; a few Gaussians that lie far off do not count."""
    low, high = np.percentile(means, (5, 95), axis=0)
    center = ((low + high) / 2 - origin) * unit * _TURNED
    return {"center": center.tolist(), "size": float(np.linalg.norm(high - low)) * unit}


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
