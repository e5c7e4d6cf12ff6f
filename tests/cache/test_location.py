"""Where a store is: a folder or a bucket, and what is said of a place or a server that is none."""

from __future__ import annotations

import http.server
import sys
import threading

import pytest
from remote_stores import label_map, run, serve
from tiny_runs import ss_flow

from ss_flow.cache.bucket import Bucket
from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.location import open_store
from ss_flow.cache.remote import RemoteStore, default_folder
from ss_flow.cache.store import Store


def test_a_path_is_a_folder_and_a_url_a_bucket(location, tmp_path):
    assert type(open_store(tmp_path / "store")) is type(open_store(str(tmp_path / "store"))) is Store
    store = open_store(f"{location}/")
    assert isinstance(store, RemoteStore)
    assert store.location == location


def test_every_location_and_endpoint_has_a_folder_of_its_own(monkeypatch):
    for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT"):
        monkeypatch.delenv(name, raising=False)
    folders = [default_folder("s3://a/b"), default_folder("s3://a-b")]
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9000")
    folders.append(default_folder("s3://a/b"))
    monkeypatch.delenv("AWS_ENDPOINT_URL")
    monkeypatch.setenv("AWS_ENDPOINT", "http://127.0.0.1:9001")
    folders.append(default_folder("s3://a/b"))
    assert len({*folders}) == 4


@pytest.mark.parametrize(
    ("location", "expected"),
    [
        ("s3://key:hidden@bucket/x", "credentials belong into the environment"),
        ("s3://bucket/x?token=hidden", "credentials belong into the environment"),
        ("s3://", "name a folder, or s3://BUCKET/PREFIX"),
        ("s3:///x", "name a folder, or s3://BUCKET/PREFIX"),
        ("https://bucket/x", "name a folder, or s3://BUCKET/PREFIX"),
    ],
)
def test_a_location_that_is_none_is_refused_without_a_secret(location, expected, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    called = ss_flow("status", "--cache", location)
    assert called.code == 2
    assert expected in called.err.replace("\n", " ")
    assert "hidden" not in called.err
    assert list(tmp_path.iterdir()) == []


def test_without_obstore_the_extra_to_install_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(ValueError, match=r"pip install 'ss-flow\[s3\]'"):
        open_store("s3://bucket/x")


def test_missing_credentials_are_told(location, tmp_path, monkeypatch):
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(StoreFailure, match="there are no credentials"):
        RemoteStore(location, tmp_path / "here").now()


def test_a_bucket_that_is_not_there_is_told_by_what_the_server_says(location, tmp_path):
    store = RemoteStore("s3://elsewhere/x", tmp_path / "here")
    with pytest.raises(StoreFailure, match="s3://elsewhere/x cannot be used: The specified bucket does not exist"):
        store.put(label_map())


class Cutting(http.server.BaseHTTPRequestHandler):
    """Holds nothing. Cuts the first `cut` answers of its server; `told` is the length that it tells of them, 0 = that
    of what is left."""

    def do_GET(self):
        listing = "list-type" in self.path
        answer = (
            b"<ListBucketResult><IsTruncated>false</IsTruncated></ListBucketResult>" if listing else b"<Error/>" * 9
        )
        self.server.asked += 1
        told = len(answer)
        if self.server.asked <= self.server.cut:
            answer = answer[:9]
            told = self.server.told or len(answer)
        self.send_response(200 if listing else 404)
        self.send_header("Content-Length", str(told))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *_):
        pass


@pytest.mark.parametrize(
    ("ask", "told", "answer"),
    [
        (Bucket.files, 80, []),
        (Bucket.files, 0, []),
        (Bucket.folders, 80, []),
        (Bucket.folders, 0, []),
        (Bucket.get, 80, None),
    ],
)
def test_what_was_asked_is_asked_again_where_the_answer_was_cut(location, monkeypatch, ask, told, answer):
    with http.server.HTTPServer(("127.0.0.1", 0), Cutting) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
        server.asked, server.cut, server.told = 0, 1, told
        assert ask(Bucket(location), "objects") == answer
        server.asked, server.cut = 0, 9
        with pytest.raises(StoreFailure, match="cannot be used"):
            ask(Bucket(location), "objects")
        assert server.asked == 2, "no more often than other requests"
        server.shutdown()


def test_a_server_that_has_gone_is_told_in_one_sentence_that_names_the_store(location, tmp_path, monkeypatch):
    server, address = serve()
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    store = RemoteStore(location, tmp_path / "here")
    claims = store.open_claims()
    assert claims.take("held")
    object_digest = store.put(label_map())
    server.stop()
    for call in (
        lambda: store.put(label_map(8)),
        lambda: "00" * 32 in store,
        lambda: store.get("00" * 32),
        lambda: store.action("ab" * 32),
        lambda: list(store.objects()),
        lambda: store.discard(object_digest),
        lambda: claims.take("k"),
        store.now,
        lambda: run(store),
    ):
        with pytest.raises(StoreFailure) as failure:
            call()
        text = str(failure.value)
        assert text.startswith(f"the store {location} cannot be used: ")
        assert "\n" not in text and len(text) < 300
    claims.release_all()
