"""CPU milliseconds of rendering, its gradient, the colour loss and Adam; run as a script."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ss_flow.tasks.gaussians.library import instruction_set
from ss_flow.tasks.gaussians.losses import photometric
from ss_flow.tasks.gaussians.native_pass import NativePass, Settings
from ss_flow.tasks.geometry.cameras import Camera

CASES = (
    (1_000, 100, 100, 0),
    (2_000, 160, 120, 0),
    (10_000, 320, 240, 0),
    (10_000, 320, 240, 3),
    (50_000, 640, 480, 0),
)


def scene(n: int, degree: int) -> tuple[np.ndarray, ...]:
    """Gaussians of 5 cm all through the view."""
    rng = np.random.default_rng(0)
    z = rng.uniform(2, 6, n)
    means = np.stack([rng.uniform(-0.7, 0.7, n) * z, rng.uniform(-0.5, 0.5, n) * z, z], axis=1)
    arrays = (
        means,
        rng.normal(size=(n, 4)),
        np.log(0.05) + 0.4 * rng.normal(size=(n, 3)) - np.log(n / 2000) / 3,
        rng.normal(size=n),
        0.3 * rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )
    return tuple(np.ascontiguousarray(a, np.float32) for a in arrays)


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """The median of the thread's CPU time."""
    taken = []
    for _ in range(repeats):
        start = time.thread_time()
        call()
        taken.append(time.thread_time() - start)
    return 1e3 * float(np.median(taken))


def main() -> None:
    print(f"instruction set: {instruction_set()}")
    for n, width, height, degree in CASES:
        parameters = scene(n, degree)
        camera = Camera(width, height, 0.75 * width, 0.75 * width, width / 2, height / 2, np.eye(4))
        settings = Settings((0.1, 0.2, 0.3), 0, degree, 0.01, False, winners=False)
        done = NativePass(parameters, None, camera, settings)
        towards = np.full_like(done.rgb, 1e-3)
        image, weight = np.zeros_like(done.rgb), np.ones_like(done.alpha)
        repeats = max(5, 100_000 // n)
        forward = milliseconds(lambda: NativePass(parameters, None, camera, settings), repeats)  # noqa: B023
        backward = milliseconds(lambda: done.backward(towards, None, None, None), repeats)  # noqa: B023
        loss = milliseconds(lambda: photometric(done.rgb, image, weight), repeats)  # noqa: B023
        print(
            f"{n:6} Gaussians {width}x{height} SH{degree}: forward {forward:6.1f}, backward {backward:6.1f}, "
            f"colour loss {loss:5.1f} ms"
        )


if __name__ == "__main__":
    main()
