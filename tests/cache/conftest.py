"""A bucket, and two machines that have their store in it."""

from __future__ import annotations

import uuid
from collections import Counter

import pytest
from remote_stores import serve

from ss_flow.cache import bucket as bucket_module
from ss_flow.cache.bucket import Bucket
from ss_flow.cache.remote import RemoteStore


@pytest.fixture(scope="module")
def address():
    server, address = serve()
    yield address
    server.stop()


@pytest.fixture
def location(address, monkeypatch, tmp_path):
    """An empty prefix of a bucket."""
    settings = {
        "AWS_ENDPOINT_URL": address,
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
        "NO_PROXY": "127.0.0.1",
        "XDG_CACHE_HOME": str(tmp_path / "user"),
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setitem(bucket_module.RETRIES, "max_retries", 1)
    return f"s3://bucket/{uuid.uuid4().hex}"


@pytest.fixture
def opened(location, tmp_path):
    """Opens the store of one more machine, which has a folder of its own."""
    return lambda name: RemoteStore(location, tmp_path / name)


@pytest.fixture
def here(opened):
    return opened("here")


@pytest.fixture
def there(opened):
    return opened("there")


@pytest.fixture
def bucket(location):
    return Bucket(location)


@pytest.fixture
def asked(monkeypatch):
    """Counts what the bucket is asked, by method."""
    counts = Counter()
    for name in ("get", "head", "files", "put", "create", "blocks"):
        method = getattr(Bucket, name)

        def counting(self, *arguments, name=name, method=method):
            counts[name] += 1
            return method(self, *arguments)

        monkeypatch.setattr(Bucket, name, counting)
    return counts
