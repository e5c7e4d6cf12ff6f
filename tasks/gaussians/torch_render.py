"""Renderings of arrays by torch: on CUDA, and on the CPU to test that (imports torch: import it inside functions)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch

from ss_flow.tasks.artifacts import Float32, Int32
from ss_flow.tasks.gaussians.native_pass import Settings
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, Rendered, renderer_on
from ss_flow.tasks.geometry.cameras import Camera


@contextmanager
def memory_of(device: torch.device) -> Iterator[None]:
    """Within this, a device without memory is told as the host is: by MemoryError, which no error of torch is."""
    try:
        yield
    except RuntimeError as error:  # not all of them are OutOfMemoryError: a context may not fit, either
        if "out of memory" not in str(error):
            raise
        raise MemoryError(f"not enough memory on {device}") from error


def draw(
    device: str, parameters: Sequence[Float32], labels: Int32 | None, camera: Camera, settings: Settings
) -> Rendered:
    """A rendering without gradients. parameters: in the order of `PARAMETERS`. labels: [N], < 0 = none.

    Raises MemoryError.
    """
    with torch.no_grad(), memory_of(torch.device(device)):
        gaussians = GaussianTensors(*(torch.tensor(a, device=device) for a in parameters))
        drawn = _drawn(gaussians, labels, camera, settings)
        # NumPy goes through each mask by itself, and gsplat has them side by side in each pixel.
        return replace(drawn, label_masks=drawn.label_masks.contiguous())


def _drawn(gaussians: GaussianTensors, labels: Int32 | None, camera: Camera, settings: Settings) -> Rendered:
    means = gaussians.means
    renderer = renderer_on(means.device)
    channels = None if labels is None else torch.tensor(labels, device=means.device)
    background = means.new_tensor(settings.background)
    seen_from = renderer.camera_on(means.device, camera)
    return renderer.draw(gaussians, seen_from, background, channels, settings, means.new_zeros(len(gaussians), 2))
