"""Gaussians as a PLY file in the layout of the original 3DGS code, with or without labels."""

from __future__ import annotations

import tempfile
from pathlib import Path

from ss_flow.task import task
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver import ply
from ss_flow.tasks.deliver.export.content import FileContent


@task(name="deliver.export.gaussian_ply")
def gaussian_ply(gaussians: Gaussians, *, labelled: bool) -> FileContent:
    """The file; labelled: with `instance_id`, `instance_conf` and `part_id` at the end of each row."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "gaussians.ply"
        ply.write_gaussians(file, gaussians, labelled=labelled)
        return FileContent.of(file.read_bytes())
