"""Who may talk to the viewer, and what it makes of malformed, huge and foreign input."""

from __future__ import annotations

import http.client
import json
import socket
import time
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import pytest

viser = pytest.importorskip("viser", reason="needs the extra `view`")
import zstandard  # noqa: E402 - a package of viser's
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402
from websockets.sync.client import ClientConnection, connect  # noqa: E402
from websockets.typing import Subprotocol  # noqa: E402

from ss_flow.flows.view.server import start, understood  # noqa: E402
from ss_flow.flows.view.viewer import Viewer  # noqa: E402

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 0], "fov": 1.0, "near": 0.1, "far": 9.0,
    "image_height": 90, "image_width": 120, "look_at": [0, 0, 1], "up_direction": [0, -1, 0],
}  # fmt: skip
CLICK = {
    "type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1],
    "screen_pos": [[0.5, 0.5]], "modifier": None,
}  # fmt: skip


@pytest.fixture(scope="module")
def address():
    """Of a server that stands in no run."""
    server, address = start("127.0.0.1", 0, "nothing")
    yield address
    server.stop()


def ask(address: str, path: str | None = None, *, method: str = "GET", **headers: str) -> http.client.HTTPResponse:
    """What the server answers; path: that of the address unless another is given."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=20)
    connection.request(method, parts.path if path is None else path, headers=headers)
    return connection.getresponse()


def talk(address: str, origin: str | None = None) -> ClientConnection:
    """A websocket as the page opens it."""
    parts = urlsplit(address)
    own = f"http://{parts.netloc}" if origin is None else origin
    return connect(
        address.replace("http://", "ws://").rstrip("/"),
        origin=own or None,
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
    )


def is_alive(address: str) -> bool:
    """Whether the server still serves its page, and talks to it."""
    with talk(address) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))
        return ask(address).status == 200 and bool(socket.recv(timeout=20))


def test_the_page_comes_with_a_policy_that_keeps_it_from_loading_anything_from_elsewhere(address):
    answer = ask(address)
    assert answer.status == 200 and b"<html" in answer.read()[:2000].lower()
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["Content-Security-Policy"].split(";"))
    assert policy["default-src"] == "'none'" and policy["connect-src"] == "'self' data: blob:"
    assert not any("http" in sources or "*" in sources for sources in policy.values())
    assert answer.headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize("path", ["/", "/index.html", "//", "/x/", "/?token=", "/%00/", "/" + "a" * 7000, "/%C3%A9/"])
def test_nothing_is_served_without_the_token(address, path):
    token = urlsplit(address).path.strip("/")
    assert ask(address, path).status == 403
    assert ask(address, f"/{token[:-1]}/").status == 403
    assert ask(address, f"/{token}x/").status == 403


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://127.0.0.1", "file://"]
)
def test_pages_of_other_origins_get_nothing(address, origin):
    assert ask(address, Origin=origin).status == 403
    with pytest.raises(InvalidStatus, match="403"):
        talk(address, origin)


def test_a_websocket_without_an_origin_or_token_is_refused(address):
    with pytest.raises(InvalidStatus, match="403"):
        talk(address, "")
    with pytest.raises(InvalidStatus, match="403"):
        talk(address.rstrip("/")[:-3] + "abc/")


@pytest.mark.parametrize(("below", "status"), [("", b"403"), ("TOKEN/", b"404")])
def test_a_path_that_is_no_ascii_is_refused_like_any_other(address, below, status):
    parts = urlsplit(address)
    path = ("/" + below.replace("TOKEN", parts.path.strip("/"))).encode() + b"\xff\xfe"
    with socket.create_connection((parts.hostname, parts.port), timeout=20) as plain:
        plain.sendall(b"GET " + path + b" HTTP/1.1\r\nHost: " + parts.netloc.encode() + b"\r\n\r\n")
        assert plain.recv(1000).split()[1] == status


def test_a_foreign_name_that_was_made_to_lead_here_is_refused(address):
    port = urlsplit(address).port
    assert ask(address, Host=f"evil.example:{port}").status == 403
    assert ask(address, Host="[").status == ask(address, Host=f"[::1:{port}").status == 403
    assert ask(address, Host=f"localhost:{port}").status == 200


@pytest.mark.parametrize(
    "path",
    ["../../etc/passwd", "..%2f..%2f..%2fetc%2fpasswd", "/etc/passwd", "%2e%2e/__init__.py", "..\\..\\x", "client",
     "%00", "index.html/..", "~root", "a" * 300],
)  # fmt: skip
def test_no_file_of_the_machine_is_read(address, path):
    assert ask(address, urlsplit(address).path + path).status == 404


@pytest.mark.parametrize(
    "raw",
    [
        b"\0" * 4000,
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET /\r\n" * 2000,
        b"POST /x HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999999\r\n\r\n" + b"x" * 100_000,
        b"GET / HTTP/1.1\r\nHost: a\r\n" + b"X: " + b"y" * 1_000_000,
        b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 100_000 + b"\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\nUpgrade: websocket\r\nUpgrade: x\r\n\r\n",
    ],
    ids=["zeros", "no host", "no version", "huge body", "long header", "many headers", "twice"],
)
def test_what_is_no_request_ends_its_connection_and_nothing_else(address, raw):
    parts = urlsplit(address)
    with socket.create_connection((parts.hostname, parts.port), timeout=20) as plain:
        try:
            plain.sendall(raw)
            plain.shutdown(socket.SHUT_WR)
            assert b"200 OK" not in plain.recv(1000)
        except (ConnectionError, TimeoutError):
            pass
    assert is_alive(address)


GUI = {"type": "GuiUpdateMessage", "uuid": "x"}
WRONG = {
    "text": "hello",
    "no msgpack": b"\xc1\xc1",
    "empty": b"",
    "a list": msgspec.msgpack.encode([1]),
    "no text": b"\x81\xa4type\xa1\x85",
    "no type": msgspec.msgpack.encode({}),
    "a type that is no text": msgspec.msgpack.encode({"type": [1]}),
    "a call home": msgspec.msgpack.encode({"type": "ShareUrlRequest"}),
    "an upload": msgspec.msgpack.encode({"type": "FileTransferStartUpload", "source_component_uuid": "x"}),
    "a message of the server": msgspec.msgpack.encode({"type": "RunJavascriptMessage", "source": "1"}),
    "a missing field": msgspec.msgpack.encode({**CAMERA, "fov": None}),
    "a field too many": msgspec.msgpack.encode({**CAMERA, "more": 1}),
    "a vector too short": msgspec.msgpack.encode({**CAMERA, "position": [0, 0]}),
    "no number": msgspec.msgpack.encode({**CAMERA, "position": [0, 0, float("nan")]}),
    "infinite": msgspec.msgpack.encode({**CLICK, "ray_direction": [0, float("inf"), 0]}),
    "a state of the program": msgspec.msgpack.encode({**GUI, "updates": {"update_cb": []}}),
    "deep": b"\x91" * 60_000 + b"\xc0",
    "huge": msgspec.msgpack.encode({**GUI, "updates": {"value": "x" * 1_000_000}}),
}


@pytest.mark.parametrize("raw", WRONG.values(), ids=WRONG)
def test_a_message_that_is_not_understood_ends_its_connection_and_nothing_else(address, raw):
    with talk(address) as socket:
        socket.send(raw)
        with pytest.raises(ConnectionClosed) as closed:
            for _ in range(100):
                socket.recv(timeout=20)
        assert closed.value.rcvd is not None and closed.value.rcvd.code in (1008, 1009)
    assert is_alive(address)


def test_what_a_browser_says_is_understood():
    for message in (CAMERA, CLICK, {**GUI, "updates": {"value": True}}, {**GUI, "updates": {"value": [0.1, 2]}}):
        assert understood(msgspec.msgpack.encode(message)), message
    assert not understood("text")


@pytest.fixture
def viewer(tiny, tmp_path):
    """A viewer of the tiny run."""
    from ss_flow.flows.cli.context import StoreOptions, open_run
    from ss_flow.flows.cli.view import search_of

    run = open_run(tiny.out, StoreOptions(tiny.store), ("scene", "cameras"))
    viewer = Viewer(run, tmp_path / "script.json", (), search_of(run), port=0)
    viewer.load_pictures()
    yield viewer
    viewer.close()


def received(address: str) -> bytes:
    """All that a page is told when it opens, unpacked."""
    told, decompress = b"", zstandard.ZstdDecompressor().decompress
    with talk(address) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))
        while b"ReplayDoneMessage" not in told:
            raw = socket.recv(timeout=60)
            assert isinstance(raw, bytes)
            size = int.from_bytes(raw[8:16], "little")
            told += decompress(raw[16 : 16 + size]) + raw[16 + size :]
    return told


def test_a_page_is_told_the_objects_and_no_path_of_the_machine(viewer, tiny):
    told = received(viewer.address)
    names = [e["name"] for e in json.loads((tiny.out / "instances.json").read_text())["instances"]]
    assert all(name.encode() in told for name in names)
    for secret in (tiny.out, tiny.store, tiny.scene, Path.home(), Path(viser.__file__).parent):
        assert str(secret).encode() not in told
    assert ask(viewer.address).read().find(str(tiny.out.parent).encode()) < 0


def test_well_formed_nonsense_changes_nothing(viewer, tiny):
    told = received(viewer.address)
    session = viewer.panel.session
    uuids = [u for u in viewer.server.gui._gui_input_handle_from_uuid if u.encode() in told]
    assert len(uuids) > 10
    with talk(viewer.address) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))
        for uuid in uuids:
            for value in ("no such thing", -1e300, [], [1e9], {"a": 1}, None):
                message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
                socket.send(msgspec.msgpack.encode(message))
        for direction in ([0, 0, 0], [1e-300, 0, 0], [1e300, 0, 0]):
            socket.send(msgspec.msgpack.encode({**CLICK, "ray_direction": direction}))
        time.sleep(1)
    assert session.script()["operations"] == []
    assert is_alive(viewer.address)
    assert not (tiny.out.parent / "script.json").exists()


def test_asking_to_share_calls_nobody(viewer, monkeypatch):
    def called(*_: object) -> None:
        raise AssertionError("the viewer called home")

    monkeypatch.setattr("viser._viser.ViserTunnel", called)
    with talk(viewer.address) as socket:
        socket.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        with pytest.raises(ConnectionClosed):
            for _ in range(1000):
                socket.recv(timeout=20)
    assert viewer.server._share_tunnel is None
