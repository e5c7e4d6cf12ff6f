"""Any artifact of a store, shown the way that suits it: in space, as a page of pictures and figures, or as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ss_flow.cache.files import write_atomically
from ss_flow.cache.store import Store
from ss_flow.flows.describe import as_html, provenance
from ss_flow.flows.results import Results, of_type
from ss_flow.flows.view.drawing import Around, draw, is_spatial
from ss_flow.flows.view.looking import look_from, start_view
from ss_flow.runs import Run
from ss_flow.tasks.artifacts import Cameras, Frame, PointCloud
from ss_flow.tasks.deliver.draw import draw as picture_of
from ss_flow.tasks.geometry.images import encode_png

if TYPE_CHECKING:
    import viser

_MOST_ON_A_PAGE = 60
_STYLE = (
    "body{font:14px/1.4 system-ui,sans-serif;color:#23262d;background:#f4f5f7;margin:2em auto;max-width:60em}"
    "section{background:#fff;border:1px solid #dfe2e8;border-radius:8px;padding:1em;margin:1em 0;overflow-x:auto}"
    "td,th{padding:2px 10px 2px 0}small{color:#6a7080;overflow-wrap:anywhere}"
)


def around_of(store: Store, run: Run) -> Around:
    """What the artifacts of a run are drawn with: its photos, cameras and dense points, as far as it has them."""
    cameras, points = (next(iter(of_type(store, run, kind)), None) for kind in (Cameras, PointCloud))
    return Around(of_type(store, run, Frame), cameras, points)


def around_results(results: Results) -> Around:
    """The same of a finished run's results."""

    def held(name: str) -> bool:
        return not results.missing([name])

    return Around(
        results.all("ingest") if held("ingest") else (),
        results.one("cameras") if held("cameras") else None,
        results.one("dense") if held("dense") else None,
    )


def placed(values: Sequence[Any], around: Around) -> bool:
    """Whether artifacts of one type can be drawn in space with what is known around them."""
    return is_spatial(list(values)) and around.cameras is not None


def show(server: viser.ViserServer, values: Sequence[Any], around: Around) -> None:
    """Draw artifacts in a server's scene, and let the browser look from where the photos show most of it."""
    draw(server.scene, "/artifact", values[0] if len(values) == 1 else list(values), around)
    if around.cameras is None:
        return
    points = np.zeros((0, 3), np.float32) if around.points is None else around.points.points
    look_from(server, start_view(around.cameras, points))


def write_artifact_page(
    file: Path,
    title: str,
    digests: Sequence[str],
    store: Store,
    around: Around,
    run: Run | None,
    asked: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Write one HTML file about some artifacts, whole or not at all: a picture, the fields and the history of each.

    run, asked: where to look for what made them.
    """
    parts = []
    for object_digest in digests[:_MOST_ON_A_PAGE]:
        value = store.get(object_digest)
        made = provenance(store, object_digest, run, asked)
        parts.append(f"<section>{as_html(value, artifact_picture(value, around), made)}</section>")
    if len(digests) > len(parts):
        parts.append(f"<p>... and {len(digests) - len(parts)} more</p>")
    page = (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{escape(title)}</title>"
        "<meta http-equiv='Content-Security-Policy' content=\"default-src 'none'; img-src data:; "
        f"style-src 'unsafe-inline'\"><style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>"
        f"{''.join(parts)}</body></html>"
    )
    write_atomically(file, page)


def artifact_picture(value: Any, around: Around, view: int | None = None) -> bytes:
    """A picture of an artifact, or of a list of them, as a PNG; over its photo where it is about one view.

    view: the position of the view that looks at points and Gaussians; None = that which the artifact is about.
    """
    name = getattr(value, "name", "")
    if view is None:
        view = around.cameras.names.index(name) if around.cameras and name in around.cameras.names else 0
    picture = picture_of(
        value,
        frame=around.frame(name),
        frames=around.frames,
        cameras=around.cameras,
        view=view,
        points=around.points,
    )
    return encode_png(picture).tobytes()
