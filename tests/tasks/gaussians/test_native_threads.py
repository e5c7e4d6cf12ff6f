"""The native library's threads, which sleep from one call to the next: after a fork, and beside other callers."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, NativePass, Settings
from ss_flow.tasks.geometry.cameras import Camera


def drawn(threads: int, count: int = 5_000) -> bytes:
    """A view of many bands and chunks."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 2), (1, 1, 4), (count, 3)).astype(np.float32)
    made = initialise(points, np.full((count, 3), 100, np.uint8), 1, 1.0, opacity=0.5)
    arrays = tuple(getattr(made, name) for name in PARAMETERS)
    camera = Camera(160, 200, 150, 150, 80, 100, np.eye(4))
    return NativePass(arrays, None, camera, Settings((0, 0, 0), 0, 0, winners=False), threads=threads).rgb.tobytes()


def test_a_forked_process_draws_the_same_and_ends_as_any_other():
    script = """
        import os, sys
        from test_native_threads import drawn
        before = drawn(3)
        child = os.fork()
        assert drawn(3) == drawn(2) == before
        if child:
            sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        print("drawn again")
    """
    done = subprocess.run(
        [sys.executable, "-P", "-W", "ignore", "-c", textwrap.dedent(script)],
        env={"PYTHONPATH": __file__.rpartition("/")[0]}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "drawn again\n", "")


def test_callers_side_by_side_each_have_threads_of_their_own():
    alone = drawn(1)
    with ThreadPoolExecutor(4) as callers:
        assert set(callers.map(drawn, [2, 3, 5, 1] * 12)) == {alone}
