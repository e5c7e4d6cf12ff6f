"""Structure from motion of frames in memory, as a run does it."""

from __future__ import annotations

from ss_flow.cache.store import Store
from ss_flow.engine import Report, run_flow
from ss_flow.flows.poses import poses
from ss_flow.graph import stored
from ss_flow.tasks.artifacts import Cameras, Frame
from ss_flow.tasks.capture.sfm import SfmParams


def find_poses(frames: tuple[Frame, ...], store: Store, params: SfmParams = SfmParams(), **options) -> Report:
    """Run the flow; its result is "cameras"."""
    digests = [store.put(frame) for frame in frames]

    def build():
        return {"cameras": poses(stored("frames", digests), params, None)}

    return run_flow(build, store, scene="frames", **options)


def cameras_of(report: Report, store: Store) -> Cameras:
    """What a run came to; raises what made it fail."""
    for failure in report.failures:
        raise failure.error
    return store.get(report.values["cameras"])
