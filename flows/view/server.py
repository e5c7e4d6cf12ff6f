"""viser's server behind a token: who may talk to it, and what it is told.

viser listens for everyone. Here the first part of the path is a random token, other origins than its own page are
refused, and of what a browser sends only well-formed messages of the kinds that the viewer uses come through. A policy
in the headers keeps the page from loading anything from elsewhere.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hmac
import ipaddress
import logging
import math
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator
from importlib import resources
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from ss_flow.errors import InputError

_LARGEST = 64 * 1024
"""Bytes of the largest message that a browser may send; those of a viewer have some hundred."""
_PORTS = 100
"""So many ports from the one asked for on are tried."""
_KINDS = (
    "ViewerCameraMessage",
    "ScenePointerMessage",
    "SceneNodeClickMessage",
    "TransformControlsUpdateMessage",
    "TransformControlsDragStartMessage",
    "TransformControlsDragEndMessage",
    "GuiUpdateMessage",
    "CommandTriggerMessage",
)
"""What a browser may say. Not among them: uploads, and the request to share the scene over a server of others."""
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:; "
    "worker-src blob:; style-src 'unsafe-inline'; img-src 'self' data: blob:; font-src data:; "
    "connect-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    _Answer = Callable[[ServerConnection, Request], Response | None]
    _Handler = Callable[[Any], Awaitable[None]]


@dataclasses.dataclass(frozen=True)
class Guard:
    """Whom the viewer answers."""

    token: str
    """The first part of every path."""
    local: bool
    """Whether it listens on this machine only: then it also goes by this machine's names only, since any name may be
    made to lead here (DNS rebinding)."""

    def path(self, request: Request) -> str | None:
        """The path below the token; None for a request that is refused."""
        token, _, path = request.path.removeprefix("/").partition("?")[0].partition("/")
        known = hmac.compare_digest(token.encode(errors="surrogateescape"), self.token.encode())
        return "/" + path if known and self._from_here(request) else None

    def _from_here(self, request: Request) -> bool:
        """Whether it comes from the viewer's own page, or from nobody's. A websocket comes from a page."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or (self.local and not _is_local(_name(hosts[0]))):
            return False
        return origins == [f"http://{hosts[0]}"] or not (origins or request.headers.get_all("Upgrade"))


def start(host: str, port: int, title: str) -> tuple[viser.ViserServer, str]:
    """Start a server; returns it and the address of its page, with the token.

    host: the name or number of the address to listen on. port: the first to try. title: stands above the panel.
    Raises InputError when it cannot listen there.
    """
    import rich
    import viser

    port = _free_port(host, port)
    guard = Guard(secrets.token_urlsafe(24), _is_local(host))
    rich.reconfigure(quiet=True)  # through which viser tells its own address, without the token
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # that a request was refused is no news
    with _guarded(guard) as listening:
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if not listening:  # rather none than an open one
        server.stop()
        raise RuntimeError(f"viser {viser.__version__} listens in a way that cannot be guarded")
    name = "127.0.0.1" if host in ("0.0.0.0", "::", "") else f"[{host}]" if ":" in host else host
    return server, f"http://{name}:{server.get_port()}/{guard.token}/"


@contextlib.contextmanager
def _guarded(guard: Guard) -> Iterator[list[bool]]:
    """Meanwhile servers of websockets begin guarded; viser lets nobody reach the one that it makes.

    Yields a list that is empty until one has begun.
    """
    import websockets.asyncio.server

    serve, begun = websockets.asyncio.server.serve, list[bool]()

    def guarded(handler: _Handler, *place: Any, process_request: _Answer, **options: Any) -> Any:
        begun.append(True)

        async def checked(connection: ServerConnection) -> None:
            await handler(_Checked(connection))

        options |= {"max_size": _LARGEST, "process_request": _behind(guard, process_request)}
        return serve(checked, *place, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield begun
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _behind(guard: Guard, answer: _Answer) -> _Answer:
    """What answers a request, if the guard lets it through."""

    quads = resources.files(__package__ or "").joinpath("quads.js").read_bytes()

    def guarded(connection: ServerConnection, request: Request) -> Response | None:
        path = guard.path(request)
        if path is None:
            return connection.respond(403, "Refused. The address, with its token, is where ss-flow view was started.\n")
        if "Accept-Encoding" in request.headers:  # the page is added to
            del request.headers["Accept-Encoding"]
        try:
            response = answer(connection, dataclasses.replace(request, path=path))
        except (OSError, ValueError):  # no file can have this name
            response = connection.respond(404, "NOT FOUND")
        if response is not None:
            response.headers.update(_HEADERS)
            body = response.body or b""
            if b"<head>" in body:
                response.body = body.replace(b"<head>", b"<head><script>" + quads + b"</script>", 1)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
        return response

    return guarded


class _Checked:
    """A connection that ends at the first message which is not understood."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> Any:
        raw = await self._connection.recv()
        if understood(raw):
            return raw
        await self._connection.close(1008, "not understood")
        return await self._connection.recv()  # which tells that it is closed


def understood(raw: object) -> bool:
    """Whether a message is one that a browser may send, with all its fields and nothing else."""
    import msgspec
    from viser import _messages

    if not isinstance(raw, bytes):
        return False
    try:
        document = msgspec.msgpack.decode(raw)
        name = document.pop("type")
        if name not in _KINDS:
            return False
        kind = getattr(_messages, name)
        if document.keys() - {field.name for field in dataclasses.fields(kind)} or not _is_finite(document):
            return False
        message = msgspec.convert(document, kind)
    except (msgspec.MsgspecError, UnicodeError, KeyError, TypeError, AttributeError, RecursionError):
        return False
    return not isinstance(message, _messages.GuiUpdateMessage) or message.updates.keys() == {"value"}


def _is_finite(value: object) -> bool:
    if isinstance(value, dict | list):
        return all(map(_is_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


def _name(host: str) -> str:
    """The name or number in a header Host; empty where there is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _is_local(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _free_port(host: str, first: int) -> int:
    """The first port that is free; viser itself would try without an end where the host is wrong."""
    reason = "there is no such port"
    for port in range(first, min(first + _PORTS, 65536)) if first else (0,):
        try:
            family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(place)
            return port
        except OSError as error:
            reason = error.strerror or str(error)
        except UnicodeError:  # of what cannot be the name of a host, such as a..b
            reason = "there is no such host"
    raise InputError(f"the viewer cannot listen on {host}, port {first}: {reason}; choose others with --host, --port.")
