"""Dask clusters of somebody else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import ss_flow_toy as toy
from executor_calls import wait_for

SUPPORT = str(Path(toy.__file__).parent)


def dask_cluster(scheduler=None, **options):
    """A Dask cluster of somebody else."""
    distributed = pytest.importorskip("distributed")
    quiet = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    return distributed.LocalCluster(
        **{"n_workers": 2, "threads_per_worker": 1, "memory_limit": None, "silence_logs": 51, **options},
        scheduler_kwargs={**quiet, **(scheduler or {})},
    )


def at(cluster):
    """The name of the executor for a cluster."""
    return cluster.scheduler_address.replace("tcp", "dask")


class Servers:
    """A scheduler and a worker in processes of their own, as on other hosts."""

    def __init__(self, folder):
        self.environment = {**os.environ, "PYTHONPATH": os.pathsep.join([SUPPORT, os.environ.get("PYTHONPATH", "")])}
        self.file = folder / "scheduler.json"
        self.scheduler = self.start("scheduler", "--port", "0", "--scheduler-file", str(self.file))
        wait_for(lambda: self.file.exists() and self.file.read_text())
        self.address = json.loads(self.file.read_text())["address"].removeprefix("tcp://")
        self.worker = self.start("worker", self.address, "--nthreads", "1", "--no-nanny")

    def start(self, what, *options):
        command = [sys.executable, "-m", "distributed.cli.dask_" + what, *options, "--host", "127.0.0.1"]
        return subprocess.Popen(
            [*command, "--no-dashboard"], env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def end(self):
        for process in (self.worker, self.scheduler):
            process.kill()
            process.wait()
