"""Dask clusters, for the tests that run on one."""

from __future__ import annotations

import pytest
from dask_clusters import Servers, dask_cluster


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
