"""Whole trainings on every backend: the same as the native ones, repeatable, and within the memory of a device."""

from __future__ import annotations

import gc
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from trainer_backends import NATIVE, tolerance, trained

from ss_flow.running import Surroundings, running
from ss_flow.tasks.gaussians.densification import Schedule
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.gaussians.native_pass import PARAMETERS
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.torch_backend import TorchBackend
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.geometry.cameras import Camera


def test_a_training_is_the_same_on_every_backend(backend):
    params = TrainParams(iterations=60, densify="none")
    ours, theirs = trained(NATIVE, params), trained(backend, params)
    # Rounding grows from step to step: native trainings that only round otherwise are a thousandth apart in the end.
    np.testing.assert_allclose(theirs.loss, ours.loss, rtol=20 * tolerance(backend))
    assert len(ours.gaussians) == len(theirs.gaussians)


def test_a_training_that_densifies_is_the_same_until_rounding_parts_them(backend):
    # A millionth of the gradients decides, some steps later, who is split: then all goes other ways, here too.
    params = TrainParams(iterations=40, schedule=Schedule(10, 30, 10, 25, shorten=False), max_length=1.5)
    ours, theirs = (trained(one, replace(params, densify_grad=1e-5)) for one in (NATIVE, backend))
    np.testing.assert_allclose(theirs.loss[:20], ours.loss[:20], rtol=0.5 * tolerance(backend))
    assert len(theirs.gaussians) > 100
    assert abs(len(ours.gaussians) - len(theirs.gaussians)) <= 0.05 * len(ours.gaussians)


def test_a_training_by_torch_repeats_to_the_byte_and_goes_on_after_a_kill(tmp_path):
    params = TrainParams(iterations=120, schedule=Schedule(10, 90, 10, 60, shorten=False), densify_grad=1e-5)
    alone = trained(TorchBackend("cpu"), params)

    class Killed(Exception):
        pass

    def stop(done, total, note):
        if done == 50:
            raise Killed

    here = Surroundings(stop, checkpoint=tmp_path / "kept.npz")
    with running(here), pytest.raises(Killed):
        trained(TorchBackend("cpu"), params)
    with running(replace(here, listener=lambda *_: None)):
        resumed = trained(TorchBackend("cpu"), params)
    for name in PARAMETERS:
        assert getattr(resumed.gaussians, name).tobytes() == getattr(alone.gaussians, name).tobytes()
    assert resumed.loss.tobytes() == alone.loss.tobytes()


def test_targets_that_would_fill_the_device_are_carried_there_step_by_step(monkeypatch):
    params = TrainParams(iterations=40, densify="none")
    alone = trained(TorchBackend("cpu"), params)
    full = TorchBackend("cpu")
    monkeypatch.setattr(full, "_room", lambda: 1000)
    carried = []
    put = full.target
    monkeypatch.setattr(full, "target", lambda target, labels: carried.append(target) or put(target, labels))
    again = trained(full, params)
    assert len(carried) >= params.iterations
    assert again.loss.tobytes() == alone.loss.tobytes()
    for name in PARAMETERS:
        assert getattr(again.gaussians, name).tobytes() == getattr(alone.gaussians, name).tobytes()


def test_a_training_by_torch_keeps_no_tensor():
    def alive() -> int:
        gc.collect()
        return sum(isinstance(some, torch.Tensor) for some in gc.get_objects())

    params = TrainParams(iterations=60, schedule=Schedule(10, 40, 10, 25, shorten=False), densify_grad=1e-5)
    trained(TorchBackend("cpu"), params)
    before = alive()
    trained(TorchBackend("cpu"), params)
    assert alive() <= before


def no_memory(*_):
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3 GiB.")


def no_room_for_a_context(*_):
    raise RuntimeError("CUDA error: out of memory")


def another_error(*_):
    raise RuntimeError("CUDA error: an illegal memory access was encountered")


@pytest.mark.parametrize(
    ("fails", "told", "match"),
    [
        (no_memory, MemoryError, "not enough memory on cpu"),
        (no_room_for_a_context, MemoryError, "not enough memory on cpu"),
        (another_error, RuntimeError, "illegal memory access"),
    ],
)
def test_a_device_without_memory_is_told_as_the_host_is(fails, told, match):
    backend = TorchBackend("cpu")
    backend.descent = fails
    with pytest.raises(told, match=match):
        trained(backend, TrainParams(iterations=3, densify="none"))


def test_what_a_device_has_no_memory_for_is_trained_on_the_cpu_in_the_last_try(monkeypatch):
    full = TorchBackend("cpu")
    full.descent = no_memory
    training = sys.modules[train.__module__]
    monkeypatch.setattr(training, "device_for", lambda pixels: "small")
    monkeypatch.setattr(training, "backend_for", lambda device, threads: full if device == "small" else NATIVE)
    params = TrainParams(iterations=3, densify="none")
    with pytest.raises(MemoryError):
        trained(None, params)
    heard: list[str] = []
    with running(Surroundings(warned=heard, last_try=True)):
        again = trained(None, params)
    assert again.loss.tobytes() == trained(NATIVE, params).loss.tobytes()
    assert heard == ["small has not enough memory for a training of 4 views: it ran on the CPU."]


def test_what_a_device_has_no_memory_for_is_drawn_on_the_cpu(monkeypatch):
    made = initialise(np.array([[0, 0, 2.0]]), np.full((1, 3), 200, np.uint8), 1, 1.0)
    camera = Camera(32, 24, 30, 30, 16, 12, np.eye(4))
    drawing = sys.modules[render.__module__]
    monkeypatch.setattr(drawing, "device_for", lambda pixels: "cpu")
    expected = render(made, camera)
    monkeypatch.setattr(drawing, "device_for", lambda pixels: torch.device("cpu"))
    by_torch = sys.modules["ss_flow.tasks.gaussians.torch_render"]
    monkeypatch.setattr(by_torch, "_drawn", no_memory)
    for name, image in expected._asdict().items():
        assert np.array_equal(getattr(render(made, camera), name), image), name
