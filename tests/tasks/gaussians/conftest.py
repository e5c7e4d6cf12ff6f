"""The backends of a trainer that are not the native one.

The torch backend runs on torch's CPU device, once with the native rasterizer behind it and once with the adapter to
gsplat, which a dense stand-in completes; where there is CUDA, on that.
"""

from __future__ import annotations

import sys

import gsplat_on_the_cpu
import pytest
from trainer_backends import CUDA, through_gsplat

from ss_flow.tasks.gaussians import trainer
from ss_flow.tasks.gaussians.torch_backend import TorchBackend


@pytest.fixture
def stand_in(monkeypatch):
    """Have the module `gsplat` be its stand-in."""
    monkeypatch.setitem(sys.modules, "gsplat", gsplat_on_the_cpu)


@pytest.fixture(params=["torch", "adapter", CUDA])
def backend(request, monkeypatch) -> TorchBackend:
    """Each of the backends that are not the native one."""
    if request.param == "adapter":
        request.getfixturevalue("stand_in")
        return through_gsplat("cpu")
    return TorchBackend("cpu" if request.param == "torch" else "cuda")


@pytest.fixture
def native(monkeypatch):
    """Train on the CPU wherever the tests run: only there the same inputs give the same bytes."""
    monkeypatch.setattr(trainer, "device_for", lambda pixels: "cpu")
