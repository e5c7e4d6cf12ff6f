"""Dask clusters, for the tests that run on one, and packages that are written for closures."""

from __future__ import annotations

import importlib
import sys
import textwrap

import pytest
from dask_clusters import Servers, dask_cluster

from ss_flow import closure


@pytest.fixture(scope="module")
def cluster():
    with dask_cluster({"allowed_failures": 0}) as cluster:
        yield cluster


@pytest.fixture
def servers(tmp_path):
    pytest.importorskip("distributed")
    started = Servers(tmp_path)
    yield started
    started.end()


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Write modules of a package `probe`, and get the closure of `probe.step.run`."""
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "probe"
    folder.mkdir()
    (folder / "__init__.py").touch()

    def closure_of(**modules: str) -> dict[str, str]:
        for name, text in modules.items():
            (folder / f"{name}.py").write_text(textwrap.dedent(text))
        for name in [n for n in sys.modules if n.partition(".")[0].endswith("probe")]:
            del sys.modules[name]
        importlib.invalidate_caches()
        closure.forget()
        return closure.closure_of(importlib.import_module("probe.step").run).definitions

    return closure_of
