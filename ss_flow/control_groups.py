"""What Linux's control groups leave of the machine: a container, a pod or a queue's job may use a part of it.

Limits are those of the process's own group and of all above it, of version 2 or 1; without such groups there are none.
"""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

GROUPS, OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")

_MEMORY = (
    ("", "memory.max", "memory.current", "inactive_file"),
    ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""Of each version: the controller, the files of limit and use, and which part of the use is given up when need be."""


def usable_cores() -> int:
    """Cores this process may use: those it may run on, or what its container's share of time keeps busy."""
    return within_quota(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def within_quota(cores: int) -> int:
    """Of so many cores, how many this process's share of processor time keeps busy; at least one."""
    for controller in ("", "cpu"):
        for folder in _folders(controller):
            with contextlib.suppress(OSError, ValueError):  # no such group; "max" = no limit
                if controller:
                    quota, period = (int((folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
                else:
                    quota, period = map(int, (folder / "cpu.max").read_text().split())
                if quota > 0:  # -1 = no limit
                    cores = min(cores, math.ceil(quota / period))
    return cores


def within_limit(free: int) -> int:
    """Of so many free bytes of the machine, how many this process may still use."""
    for controller, limit, used, cached in _MEMORY:
        for folder in _folders(controller):
            with contextlib.suppress(OSError, ValueError):  # no such group; "max" = no limit
                left = int((folder / limit).read_text()) - int((folder / used).read_text())
                lines = (folder / "memory.stat").read_text().splitlines()
                free = min(free, left + sum(int(line.split()[1]) for line in lines if line.split()[0] == cached))
    return max(free, 0)


def _folders(controller: str) -> list[Path]:
    """The folders of this process's group and of those above it; a container may see only the last, which is its own.

    controller: of version 1; "" = version 2, which has one tree for all.
    """
    top = GROUPS / controller
    with contextlib.suppress(OSError):
        for line in OWN.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controller in controllers.split(","):
                own = top / path.lstrip("/")
                return [folder for folder in (own, *own.parents) if folder.is_relative_to(top)]
    return [top]
