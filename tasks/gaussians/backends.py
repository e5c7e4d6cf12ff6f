"""Loss and gradients of one view: by the native library on the CPU, or by torch and gsplat on CUDA."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from ss_flow.tasks.artifacts import Float32, Int32
from ss_flow.tasks.gaussians.library import Workspace
from ss_flow.tasks.gaussians.losses import gradients_of
from ss_flow.tasks.gaussians.native_pass import NativePass, Settings
from ss_flow.tasks.gaussians.objective import Target, Weights

Arrays = tuple[Float32, Float32, Float32, Float32, Float32]


class Descent(NamedTuple):
    """What one view says about the parameters."""

    loss: float
    gradients: dict[str, Float32]
    """By parameter, and "centers" [N, 2] towards the projected means, per pixel. Valid until the next call."""
    radii: Float32
    """[N] reach on the screen in pixels, 0 = not in view."""


class Backend(Protocol):
    """Renders, compares and goes back."""

    def descent(
        self, parameters: Arrays, labels: Int32 | None, target: Target, settings: Settings, weights: Weights
    ) -> Descent:
        """labels: [N] the label of each Gaussian, < 0 = none; None without mask loss."""


class NativeBackend:
    """On the CPU; the number of threads changes no byte."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._workspace = Workspace()
        self._gradients: dict[str, Float32] | None = None

    def descent(
        self, parameters: Arrays, labels: Int32 | None, target: Target, settings: Settings, weights: Weights
    ) -> Descent:
        rendered = NativePass(
            parameters, labels, target.camera, settings,
            ids=target.ids, workspace=self._workspace, threads=self._threads,
        )  # fmt: skip
        loss, towards = gradients_of(rendered, target, weights, self._workspace, self._threads)
        if self._gradients is not None and len(self._gradients["means"]) != len(parameters[0]):
            self._gradients = None
        self._gradients = rendered.backward(*towards, out=self._gradients)
        return Descent(loss, self._gradients, rendered.radii)


def backend_for(device: str, threads: int) -> Backend:
    """The backend of a device, "cpu" or "cuda"."""
    if device == "cpu":
        return NativeBackend(threads)
    from ss_flow.tasks.gaussians.torch_backend import TorchBackend

    return TorchBackend(device)
