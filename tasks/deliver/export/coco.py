"""The final id images as a COCO instance file, in the pixels of the user's own photos."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ss_flow.running import progress
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Bool
from ss_flow.tasks.capture.id_images import written_ids
from ss_flow.tasks.deliver.export.content import FileContent
from ss_flow.tasks.packed import bounds


@task(name="deliver.export.coco")
def coco(
    *, masks: tuple[FileRef, ...], photos: tuple[str, ...], names: Mapping[str, str], instances: tuple[int, ...]
) -> FileContent:
    """An image for each photo, an annotation for each instance that it shows, as plain run lengths.

    Every instance is a category of its own, so that it keeps its identity over the photos; annotations name it as
    `instance_id` too. masks: uint16 PNG files of ids. photos: the file name of each photo. names: of the instances, by
    their ids as text. instances: the ids that are wanted.
    Raises InputError when a mask cannot be read.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for done, (mask, photo) in enumerate(zip(masks, photos, strict=True)):
        progress(done, len(masks), photo)
        ids = written_ids(mask.path)
        images.append({"id": done + 1, "file_name": photo, "width": ids.shape[1], "height": ids.shape[0]})
        for instance_id in np.intersect1d(ids, instances).tolist():
            annotation = {"id": len(annotations) + 1, "image_id": done + 1, "category_id": instance_id}
            annotations.append(annotation | {"instance_id": instance_id, **_shape(ids == instance_id)})
    categories = [{"id": i, "name": names.get(str(i), "background"), "supercategory": "instance"} for i in instances]
    document = {"images": images, "annotations": annotations, "categories": categories}
    return FileContent.of(json.dumps(document, separators=(",", ":")).encode(), b"\n")


def _shape(mask: Bool) -> dict[str, Any]:
    """What COCO says of a mask [H, W] that is not empty."""
    flat = np.concatenate([[False], mask.T.ravel(), [False]])  # runs go down the columns
    borders = np.flatnonzero(flat[1:] != flat[:-1])
    counts = np.diff(np.concatenate([[0], borders, [mask.size]]))
    lengths = counts[:-1] if counts[-1] == 0 else counts
    x0, y0, x1, y1 = bounds(mask)
    return {
        "segmentation": {"size": list(mask.shape), "counts": lengths.tolist()},
        "area": int(mask.sum()),
        "bbox": [x0, y0, x1 - x0, y1 - y0],
        "iscrowd": 0,
    }
