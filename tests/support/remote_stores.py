"""A real server of S3's protocol on this machine, and stores in its bucket."""

from __future__ import annotations

import urllib.request
import uuid

import numpy as np
import pytest
import ss_flow_toy as toy

from ss_flow.cache.remote import RemoteStore
from ss_flow.cache.store import Action
from ss_flow.engine import run_flow
from ss_flow.tasks.artifacts import LabelMap


def serve():
    """Start a server with a bucket; returns it and its address."""
    pytest.importorskip("obstore", reason="needs the extra s3")
    moto = pytest.importorskip("moto.server", reason="needs moto[server], of the extra test")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    address = "http://{}:{}".format(*server.get_host_and_port())
    urllib.request.urlopen(urllib.request.Request(f"{address}/bucket", method="PUT")).close()
    return server, address


def label_map(n=64):
    return LabelMap("x", np.eye(n, dtype=np.uint16))


def names(bucket, folder):
    return sorted(meta.name for meta in bucket.files(folder))


def action_of(*outputs, key="ab" * 32):
    return Action(key, "step", outputs, True, {"parameters": {"p": 1}, "code": "c"}, 1.5, 10.0, warnings=("w",))


def emptied(store):
    """The same store as another process sees it that has nothing at hand."""
    return RemoteStore(store.location, store.root.with_name(uuid.uuid4().hex))


def run(store, **options):
    return run_flow(toy.flow, store, scene="toy", **options)


def computed(report):
    return sum(node["event"] == "finished" for node in report.nodes)
