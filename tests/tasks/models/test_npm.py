"""Packages from an npm registry, served here by a small HTTP server."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from ss_flow.errors import InputError
from ss_flow.running import Surroundings, running
from ss_flow.tasks.models import npm

ARCHIVE = bytes(range(256)) * 4096


@pytest.fixture
def settings(monkeypatch, tmp_path):
    """No settings of npm but those that a test makes: its home and folder are empty."""
    for name in ("npm_config_registry", "NPM_CONFIG_REGISTRY", "npm_config_userconfig", "NPM_CONFIG_USERCONFIG"):
        monkeypatch.delenv(name, raising=False)
    for name in ("http_proxy", "HTTP_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "project").mkdir()
    monkeypatch.chdir(tmp_path / "project")
    return tmp_path


@pytest.fixture
def served(settings, monkeypatch):
    """A registry: what it answers by path; it is the configured one."""
    answers: dict[str, bytes] = {}
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            body = answers.get(self.path)
            self.send_response(404 if body is None else 200)
            self.send_header("Content-Length", str(len(body or b"") + (self.path == "/cut")))
            self.end_headers()
            self.wfile.write(body or b"")

        def log_message(self, *_):
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/"
    monkeypatch.setenv("npm_config_registry", address)
    yield answers, asked, address
    server.shutdown()
    server.server_close()


def about(tarball: str, archive: bytes = ARCHIVE) -> bytes:
    """What a registry says of a package."""
    digest = base64.b64encode(hashlib.sha512(archive).digest()).decode()
    return json.dumps({"dist": {"tarball": tarball, "integrity": f"sha512-{digest}"}}).encode()


@pytest.mark.parametrize("own", [True, False], ids=["its own address", "the public one's address"])
def test_a_package_comes_from_the_configured_registry_even_where_it_names_the_public_one(served, tmp_path, own):
    answers, asked, address = served
    answers["/tiny/1.0.0"] = about((address if own else npm.PUBLIC) + "tiny/-/tiny-1.0.0.tgz")
    answers["/tiny/-/tiny-1.0.0.tgz"] = ARCHIVE
    told: list[tuple[int, int]] = []
    with running(Surroundings(lambda done, total, note: told.append((done, total)))):
        npm.download("tiny@1.0.0", tmp_path / "a.tgz")
    assert (tmp_path / "a.tgz").read_bytes() == ARCHIVE
    assert asked == ["/tiny/1.0.0", "/tiny/-/tiny-1.0.0.tgz"]
    assert told[-1] == (len(ARCHIVE), len(ARCHIVE)) and len(told) > 1


def test_another_archive_than_the_registry_states_is_refused(served, tmp_path):
    answers, _, address = served
    answers["/@some%2Ftiny/1.0.0"] = about(f"{address}a.tgz", b"what it should be")
    answers["/a.tgz"] = ARCHIVE
    with pytest.raises(InputError, match="is not what this registry says"):
        npm.download("@some/tiny@1.0.0", tmp_path / "a.tgz")


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, "HTTP 404"),
        (b"<html>", "Expecting value"),
        (b"[]", "list indices"),
        (about("file:///etc/hostname"), "names the archive 'file:"),
        (about("http://127.0.0.1:9/a.tgz"), "refused"),
    ],
)
def test_a_registry_that_has_no_such_package_or_speaks_otherwise_is_one_sentence(served, tmp_path, answer, words):
    answers, _, address = served
    if answer is not None:
        answers["/tiny/1.0.0"] = answer
    with pytest.raises(InputError, match=rf"tiny@1\.0\.0 cannot be downloaded from {address} \(.*{words}"):
        npm.download("tiny@1.0.0", tmp_path / "a.tgz")


def test_an_archive_that_breaks_off_is_refused(served, tmp_path):
    answers, _, address = served
    answers["/tiny/1.0.0"] = about(f"{address}cut")
    answers["/cut"] = ARCHIVE
    with pytest.raises(InputError, match=rf"broke off after {len(ARCHIVE)} of {len(ARCHIVE) + 1} bytes"):
        npm.download("tiny@1.0.0", tmp_path / "a.tgz")


def test_the_registry_is_the_variables_then_the_folders_then_the_users_then_the_public_one(settings, monkeypatch):
    assert npm.registry() == npm.PUBLIC
    monkeypatch.setenv("MIRROR", "mirror.example.org")
    (settings / ".npmrc").write_text("; mine\n//other/:_authToken=x=y\nalways-auth\nregistry = https://${MIRROR}/npm\n")
    assert npm.registry() == "https://mirror.example.org/npm/"
    (settings / "project" / ".npmrc").write_text("registry=https://project.example.org")
    assert npm.registry() == "https://project.example.org/"
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", "https://variable.example.org/")
    assert npm.registry() == "https://variable.example.org/"
    monkeypatch.delenv("NPM_CONFIG_REGISTRY")
    (settings / "project" / ".npmrc").unlink()
    (settings / "elsewhere").write_text("registry=https://elsewhere.example.org")
    monkeypatch.setenv("npm_config_userconfig", str(settings / "elsewhere"))
    assert npm.registry() == "https://elsewhere.example.org/"


def test_settings_that_cannot_be_meant_are_refused(settings):
    (settings / ".npmrc").write_text("registry=/srv/npm")
    with pytest.raises(InputError, match=r"\.npmrc names the npm registry '/srv/npm', which is no address"):
        npm.registry()
    (settings / ".npmrc").write_bytes(b"registry=\xff\xfe")
    with pytest.raises(InputError, match=r"\.npmrc cannot be read as npm's settings"):
        npm.registry()
