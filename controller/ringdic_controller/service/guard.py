"""The guard before every request: by which name and from which page it may come, how large and how slow it may be.

A browser sends requests for any page that it shows, so that being reachable from this PC alone protects nothing. The
guard therefore refuses

- a ``Host`` that is not one of the controller's own: a foreign page may let its name point to this PC (DNS rebinding);
- a request of another page: ``Sec-Fetch-Site``, ``Origin`` and ``Referer`` tell which page asks, and a browser lets no
  page write them. A request without all three comes from no browser, and passes: a script may do what the page can;
- a body that is larger than any that the interface takes, before it is in memory;
- a client that neither sends its body nor reads its answer.

It adds to every answer the headers that keep what is served from being framed, sniffed, or run as a script.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LINGER = 10.0  # seconds for which the rest of a body that is too large is read and dropped, so that the client sees why
_NO_CHANGE = ("GET", "HEAD", "OPTIONS")

#: Of everything but the page and the reports: nothing is loaded or run, whatever a file turns out to be.
NOTHING_RUNS = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
#: Of the page: its own scripts, styles and pictures.
OWN_FILES_RUN = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
#: Of a report: its style and its embedded pictures, in an origin of its own, without scripts.
PICTURES_ALONE = f"sandbox; {NOTHING_RUNS}; style-src 'unsafe-inline'; img-src data:"

SAFE_HEADERS = {
    "Content-Security-Policy": NOTHING_RUNS,
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # not "no-referrer": a form's Origin would then be null
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


@dataclass(frozen=True)
class GuardRules:
    """What the guard lets pass.

    hosts : names and addresses by which the page may be asked for, beside those of loopback and the address that a
    connection arrives at. body_limit : bytes of a request's body. body_seconds : s in which it must have arrived.
    send_seconds : s in which a client must have taken a part of its answer.
    """

    hosts: frozenset[str] = frozenset()
    body_limit: int = 1 << 20
    body_seconds: float = 30.0
    send_seconds: float = 60.0


class RequestGuard:
    """ASGI middleware that refuses, with a sentence, what the rules do not let pass. WebSockets are closed.

    Parameters
    ----------
    app
        The application behind the guard.
    rules
        What it lets pass.
    """

    def __init__(self, app: ASGIApp, rules: GuardRules) -> None:
        self._app = app
        self._rules = rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on, or answer it with 403, 408 or 413."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            await self._guard(scope, receive, _Answer(send, self._rules.send_seconds).send)
        else:
            await send({"type": "websocket.close", "code": 1008})

    async def _guard(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        foreign = foreign_host(headers, scope, self._rules.hosts) or foreign_page(headers, scope)
        if foreign:
            await JSONResponse({"detail": foreign}, 403)(scope, receive, send)
        elif "content-length" not in headers and "transfer-encoding" not in headers:
            await self._app(scope, receive, send)
        else:
            await self._guard_body(scope, receive, send)

    async def _guard_body(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Take a body into memory, up to the limit, and pass the request on with it."""
        rules = self._rules
        try:
            async with asyncio.timeout(rules.body_seconds):
                body = await _body(receive, Headers(scope=scope).get("content-length", "0"), rules.body_limit)
        except TimeoutError:
            sentence = f"The request's body did not arrive within {rules.body_seconds:g} s; send it again."
            await JSONResponse({"detail": sentence}, 408, {"Connection": "close"})(scope, receive, send)
            return
        except _TooLargeError:
            await _refuse_body(rules.body_limit, receive, send)
            return
        if body is None:  # the client has gone
            return
        pending: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def receive_again() -> Message:
            return pending.pop() if pending else await receive()

        await self._app(scope, receive_again, send)


def foreign_host(headers: Headers, scope: Scope, hosts: Collection[str]) -> str | None:
    """Why a request's ``Host`` is not one of the controller's own, as a sentence; None where it is.

    Own are the names and addresses of loopback, the address that the connection has arrived at, and ``hosts``.
    """
    named = headers.getlist("host")
    name = _host_name(named[0]) if len(named) == 1 else None
    if name is not None and (name in hosts or name == "localhost" or _is_own_address(name, scope)):
        return None
    return (
        f"The controller does not answer to the name '{', '.join(named)}'. Open it by its address, or add the name to "
        "'hosts' in the table [http] of the controller's configuration."
    )


def foreign_page(headers: Headers, scope: Scope) -> str | None:
    """Why a request is one of another page than the controller's, as a sentence; None where it is not.

    Another page may only lead to the controller (a link). It may embed nothing and change nothing.
    """
    site = headers.get("sec-fetch-site", "none")
    if scope["method"] in _NO_CHANGE:
        leads = headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest", "document") == "document"
        foreign = site not in ("same-origin", "none") and not leads
    else:
        own = f"{scope['scheme']}://{headers.get('host', '')}".lower()
        origins = headers.getlist("origin") or [_origin(page) for page in headers.getlist("referer")]
        foreign = site not in ("same-origin", "none") or any(origin.lower() != own for origin in origins)
    if not foreign:
        return None
    return "The request comes from another page than the controller's own, and is refused; use the controller's page."


class _TooLargeError(Exception):
    """A body that is larger than the limit."""


class _Answer:
    """Sends an answer with the safe headers; gives up a client that does not take it."""

    def __init__(self, send: Send, seconds: float) -> None:
        self._send = send
        self._seconds = seconds

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in SAFE_HEADERS.items():
                headers.setdefault(name, value)
        try:
            async with asyncio.timeout(self._seconds):
                await self._send(message)
        except TimeoutError as error:
            raise OSError(f"the client has read nothing for {self._seconds:g} s") from error


async def _body(receive: Receive, declared: str, limit: int) -> bytes | None:
    """A request's whole body; None where the client has gone. Raises _TooLargeError before it is read, or at the limit.

    declared : the length that the client declares, in digits.
    """
    if not declared.isdecimal() or len(declared) > 18 or int(declared) > limit:
        raise _TooLargeError
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        body += message.get("body", b"")
        if len(body) > limit:
            raise _TooLargeError
        if not message.get("more_body", False):
            return bytes(body)


async def _refuse_body(limit: int, receive: Receive, send: Send) -> None:
    """Answer 413 at once, then drop what still comes: a connection closed before would lose the answer."""
    sentence = f"The request's body is larger than {limit} bytes, which no request needs; it was not read."
    answer = JSONResponse({"detail": sentence}, 413, {"Connection": "close"})
    await send({"type": "http.response.start", "status": 413, "headers": answer.raw_headers})
    await send({"type": "http.response.body", "body": answer.body, "more_body": True})
    try:
        async with asyncio.timeout(LINGER):
            while (message := await receive())["type"] == "http.request" and message.get("more_body", False):
                pass
    except TimeoutError:
        pass
    await send({"type": "http.response.body", "body": b"", "more_body": False})


def _host_name(host: str) -> str | None:
    """The name or address in a ``Host`` header, in lower case, without port and brackets; None for no usable one."""
    try:
        parts = urlsplit(f"//{host}")
        usable = parts.netloc == host and parts.username is None and (parts.port is None or parts.port > 0)
    except ValueError:
        return None
    return (parts.hostname or "").removesuffix(".") if usable else None


def _is_own_address(name: str, scope: Scope) -> bool:
    """Whether a name is an address (not a name) of loopback, or the one at which the connection has arrived."""
    try:
        address, server = _address(name), scope.get("server")
        return address.is_loopback or (server is not None and address == _address(server[0]))
    except ValueError:
        return False


def _address(name: str) -> IPv4Address | IPv6Address:
    """The address that a text is; an IPv4 address in the form of IPv6 counts as itself. Raises ValueError."""
    address = ip_address(name)
    return getattr(address, "ipv4_mapped", None) or address


def _origin(page: str) -> str:
    """The origin of a page's address, as a browser writes it."""
    parts = urlsplit(page)
    return f"{parts.scheme}://{parts.netloc}"
