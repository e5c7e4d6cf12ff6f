"""Where Gaussians are trained: what a backend gives, and the backend of the CPU.

A training is one code on every device. It holds a backend's arrays and works on them with the functions that NumPy and
torch share by name (`Backend.xp`); what they do not share, it asks of the backend.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Float32
from ss_flow.tasks.gaussians.library import Learnt, Workspace, address, library
from ss_flow.tasks.gaussians.losses import gradients_of
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, NativePass, Settings
from ss_flow.tasks.gaussians.objective import Target, Targets, Weights

Array = Any
"""An array of a backend's device."""
Values = dict[str, Array]
"""By the names of `PARAMETERS`, float32, one row for each Gaussian."""

EPSILON = 1e-15
"""Of Adam, as in 3DGS."""


class Descent(NamedTuple):
    """What one view says about the parameters."""

    loss: Array
    """One number."""
    gradients: Values
    """By parameter, and "centers" [N, 2] towards the projected means, per pixel. Valid until the next call."""
    radii: Array
    """[N] reach on the screen in pixels, 0 = not in view."""


@dataclass(frozen=True)
class AdamStep:
    """What a step of Adam depends on besides the gradients."""

    number: int
    """1 for the first."""
    rates: Mapping[str, Any]
    """Learning rates by parameter, and "sh_rest" for the colours above degree 0; of the means [N], world units."""
    sh_degree: int
    """The colours above it have had no gradient yet."""


class Backend(Protocol):
    """The arrays of a device, and what a training asks for there. No step waits for the host, or carries to it."""

    @property
    def xp(self) -> ModuleType:
        """NumPy or torch."""

    def stream(self) -> AbstractContextManager[Any]:
        """What a training runs in, so that several that share a device do not wait for each other.

        Raises MemoryError when the device has not enough.
        """

    def put(self, array: NDArray[Any]) -> Array:
        """A copy on the device."""

    def host(self, array: Array) -> NDArray[Any]:
        """The same as a NumPy array."""

    def target(self, target: Target, num_labels: int) -> Any:
        """A view as `descent` and `strongest` take it."""

    def targets(self, targets: Targets) -> Any:
        """All views of a training, by their rows; on a device of its own they are all there from the start."""

    def descent(
        self, values: Values, labels: Array | None, target: Any, settings: Settings, weights: Weights
    ) -> Descent:
        """The loss of one view, and its gradients.

        labels: [N] the label of each Gaussian, < 0 = none; None without mask loss.
        """

    def towards_parts(
        self, values: Values, parts: Sequence[tuple[slice, Any]], weight: float
    ) -> Iterable[tuple[slice, Values]]:
        """For the rows of each part, the gradients of `weight` times the error of the alpha of these rows alone.

        parts: rows, and a target whose alpha alone counts. They may be found while a `descent` is that is called before
        they are looked at; until then, values must stay.
        """

    def adam(self, values: Values, gradients: Values, first: Values, second: Values, step: AdamStep) -> None:
        """One step down the gradients, in place; first, second: Adam's moments (Kingma and Ba 2015, Alg. 1)."""

    def strongest(self, values: Values, target: Any) -> Array:
        """[N] the largest weight of each Gaussian in a view."""


class NativeBackend:
    """The native library on NumPy arrays; the number of threads changes no byte."""

    xp = np

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._workspace = Workspace()
        self._gradients: dict[str, Float32] | None = None
        self._beside = ThreadPoolExecutor(1, "parts")  # its thread starts when there is something to do

    def stream(self) -> AbstractContextManager[None]:
        return nullcontext()

    def put(self, array: NDArray[Any]) -> NDArray[Any]:
        return np.array(array, order="C")

    def host(self, array: NDArray[Any]) -> NDArray[Any]:
        return array

    def target(self, target: Target, num_labels: int) -> Target:
        return target

    def targets(self, targets: Targets) -> Targets:
        return targets

    def descent(
        self, values: Values, labels: Array | None, target: Target, settings: Settings, weights: Weights
    ) -> Descent:
        rendered = NativePass(
            _arrays(values), None if target.ids is None else labels, target.camera, settings,
            ids=target.ids, workspace=self._workspace, threads=self._threads,
        )  # fmt: skip
        loss, towards = gradients_of(rendered, target, weights, self._workspace, self._threads)
        if self._gradients is not None and len(self._gradients["means"]) != len(values["means"]):
            self._gradients = None
        self._gradients = rendered.backward(*towards, out=self._gradients)
        return Descent(loss, self._gradients, rendered.radii)

    def towards_parts(
        self, values: Values, parts: Sequence[tuple[slice, Target]], weight: float
    ) -> Iterable[tuple[slice, Values]]:
        if self._threads == 1 or not parts:
            return self._towards_parts(values, parts, weight)
        # A view of one thing is too small to be shared by threads, and so drawn beside that of the whole scene.
        return _once_there(self._beside.submit(self._towards_parts, values, parts, weight))

    def _towards_parts(
        self, values: Values, parts: Sequence[tuple[slice, Target]], weight: float
    ) -> list[tuple[slice, Values]]:
        settings = Settings((0.0, 0.0, 0.0), 0, 0, winners=False)
        weights = Weights(ssim=0.0, alpha=1.0, depth=0.0, mask=0.0)
        towards = []
        for rows, target in parts:
            own = {name: value[rows] for name, value in values.items()}
            found = self._alone.descent(own, None, target, settings, weights)
            # The product is a copy, too: the next descent writes where this one did.
            towards.append((rows, {name: weight * found.gradients[name] for name in own}))
        return towards

    @functools.cached_property
    def _alone(self) -> NativeBackend:
        """For the views of parts."""
        return NativeBackend(1)

    def adam(self, values: Values, gradients: Values, first: Values, second: Values, step: AdamStep) -> None:
        paces = np.ascontiguousarray(step.rates["means"], np.float32)
        learnt = []
        for name, value in values.items():
            width, head = value[:1].size, 0
            active, rate = width, 0.0 if name == "means" else step.rates[name]
            if name == "sh":
                active, head = 3 * (step.sh_degree + 1) ** 2, 3
            arrays = (value, gradients[name], first[name], second[name], paces if name == "means" else None)
            of_rest = step.rates["sh_rest"] if name == "sh" else rate
            learnt.append(Learnt(*(address(a) for a in arrays), width, active, head, rate, of_rest))
        rows = len(values["means"])
        if library().ss_adam(rows, len(learnt), (Learnt * len(learnt))(*learnt), step.number, EPSILON, self._threads):
            raise MemoryError("not enough memory for a step of Adam")

    def strongest(self, values: Values, target: Target) -> Float32:
        settings = Settings((0.0, 0.0, 0.0), 0, 0, winners=True)
        rendered = NativePass(
            _arrays(values), None, target.camera, settings, workspace=self._workspace, threads=self._threads
        )
        assert rendered.strongest is not None
        return rendered.strongest


def _once_there(found: Future[list[tuple[slice, Values]]]) -> Iterator[tuple[slice, Values]]:
    yield from found.result()


def _arrays(values: Values) -> tuple[Float32, Float32, Float32, Float32, Float32]:
    means, quaternions, log_scales, opacity_logits, sh = (values[name] for name in PARAMETERS)
    return means, quaternions, log_scales, opacity_logits, sh


def backend_for(device: str, threads: int) -> Backend:
    """The backend of a device: "cpu" or "cuda"."""
    if device == "cpu":
        return NativeBackend(threads)
    from ss_flow.tasks.gaussians.torch_backend import TorchBackend

    return TorchBackend(device)
