"""The parts of a machine that containers get, as Linux tells them in files."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from ss_flow import control_groups, engine

MANY, GB = 64, 1 << 30


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Writes what the process's groups are, and their files."""
    monkeypatch.setattr(control_groups, "GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(control_groups, "OWN", tmp_path / "own")

    def write(own: str, files: dict[str, str]) -> None:
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            file = tmp_path / "cgroup" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)

    return write


def memory(limit: object, used: int, cached: int, version: int = 2) -> dict[str, str]:
    names = ("max", "current") if version == 2 else ("limit_in_bytes", "usage_in_bytes")
    row = "inactive_file" if version == 2 else "total_inactive_file"
    stat = f"anon {used - cached}\n{row} {cached}\nactive_file 0\n"
    return {f"memory.{names[0]}": f"{limit}\n", f"memory.{names[1]}": f"{used}\n", "memory.stat": stat}


def under(folder: str, files: dict[str, str]) -> dict[str, str]:
    return {str(Path(folder, name)): text for name, text in files.items()}


def found() -> tuple[int, int]:
    return control_groups.within_quota(MANY), control_groups.within_limit(MANY * GB)


def test_a_container_of_version_2_is_left_its_quota_and_what_its_limit_leaves(groups):
    groups("0::/\n", {"cpu.max": "150000 100000\n", **memory(8 * GB, 3 * GB, GB)})
    assert found() == (2, 6 * GB)


def test_a_container_of_version_1_that_sees_the_hosts_path_is_left_what_its_own_root_says(groups):
    files = {"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}
    groups("3:cpu,cpuacct:/docker/1f\n2:memory:/docker/1f\n", files | under("memory", memory(8 * GB, 3 * GB, GB, 1)))
    assert found() == (4, 6 * GB)


def test_the_narrowest_of_a_group_and_those_above_it_counts(groups):
    job, above = memory(9 * GB, 2 * GB, 0), memory(6 * GB, 2 * GB, 0)
    files = {"slurm/job/cpu.max": "max 100000\n", "slurm/cpu.max": "800000 100000\n"}
    groups("0::/slurm/job\n", files | under("slurm/job", job) | under("slurm", above))
    assert found() == (8, 4 * GB)


def test_another_group_does_not_count(groups):
    groups("0::/slurm/job\n", {"slurm/other/cpu.max": "100000 100000\n", **under("slurm/other", memory(GB, 0, 0))})
    assert found() == (MANY, MANY * GB)


def test_without_limits_the_whole_machine_is_left(groups):
    assert found() == (MANY, MANY * GB)
    none = {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n", "cpu.max": "max 100000\n"}
    limit = under("memory", memory(9223372036854771712, 3 * GB, 0, 1))
    groups("3:cpu:/\n2:memory:/\n0::/\n", none | memory("max", GB, 0) | limit)
    assert found() == (MANY, MANY * GB)


def test_more_in_use_than_the_limit_leaves_nothing(groups):
    groups("0::/\n", {"cpu.max": "1000 100000\n", **memory(GB, 2 * GB, 0)})
    assert found() == (1, 0)


def test_a_run_takes_no_more_than_its_container_has(groups, monkeypatch):
    monkeypatch.setattr(control_groups.os, "sched_getaffinity", lambda process: range(MANY), raising=False)
    assert control_groups.usable_cores() == MANY
    groups("0::/\n", {"cpu.max": "300000 100000\n", **memory(GB // 2, 0, 0)})
    assert psutil.virtual_memory().available > GB // 2
    there = engine._this_machine(0)
    assert (there.cores, there.memory_mb) == (3, 512)
