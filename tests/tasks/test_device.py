"""Where Gaussians are trained and drawn."""

from __future__ import annotations

import pytest

from ss_flow.distributions import ABSENT
from ss_flow.errors import InputError
from ss_flow.tasks import device
from ss_flow.tasks.gaussians import rasterize


@pytest.fixture
def machine(monkeypatch):
    """Have this machine be one with some of what CUDA needs, and somebody ask for a device."""

    def be(*, gsplat: bool = True, torch: str = "2.13.0+cu130", driver: bool = True, asked: str = "") -> None:
        monkeypatch.setenv(device.VARIABLE, asked)
        versions = {"torch": torch, "gsplat": "1.5.3" if gsplat else ABSENT}
        monkeypatch.setattr(rasterize, "version", versions.__getitem__)
        monkeypatch.setattr(rasterize, "has_device", lambda: driver)
        device.wanted.cache_clear()
        rasterize.device_here.cache_clear()

    yield be
    monkeypatch.undo()
    device.wanted.cache_clear()
    rasterize.device_here.cache_clear()


def test_cuda_is_taken_where_all_of_it_is_there_and_counts_in_keys(machine):
    machine()
    assert rasterize.device_here() == "cuda"
    assert rasterize.backend_identity()["device"] == "CUDA, gsplat 1.5.3"
    machine(asked="cpu")
    assert rasterize.device_here() == "cpu" and "device" not in rasterize.backend_identity()


@pytest.mark.parametrize(
    ("lacking", "why"),
    [
        ({"gsplat": False}, "gsplat is not installed"),
        ({"torch": "2.13.0+cpu"}, r"torch 2\.13\.0\+cpu was built without it"),
        ({"driver": False}, "there is no device with a driver"),
    ],
)
def test_without_a_part_of_cuda_the_cpu_does_it_unless_cuda_was_asked_for(machine, lacking, why):
    machine(**lacking)
    assert rasterize.device_here() == "cpu"
    machine(**lacking, asked="cuda")
    with pytest.raises(InputError, match=f"^SS_FLOW_DEVICE asks for CUDA, but {why}"):
        rasterize.device_here()


@pytest.mark.parametrize(("size", "processes"), [(80 << 30, 57), (8 << 30, 5), (1 << 30, 1)])
def test_a_device_has_room_for_as_many_processes_as_its_memory_is_enough_for(monkeypatch, size, processes):
    class Driver:
        def cuInit(self, flags):
            return 0

        def cuDeviceGet(self, device, number):
            return 0

        def cuDeviceTotalMem_v2(self, found, device):
            found._obj.value = size
            return 0

    monkeypatch.setattr(device.ctypes, "CDLL", lambda name: Driver())
    assert device.processes_with_room() == processes


def test_another_device_is_refused(machine):
    machine(asked="tpu")
    with pytest.raises(InputError, match="must be cpu, cuda or empty, not 'tpu'"):
        rasterize.device_here()
