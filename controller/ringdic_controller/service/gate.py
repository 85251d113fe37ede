"""The gate before the HTTP interface: who asks, whether that person may, and a line in the audit log for each action.

Whoever has a user's cookie or a token passes; a viewer may only read. Without a file of users, which is allowed on
loopback alone, everybody passes. A stream that is open ends when the right to it does.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from http import HTTPStatus

from ringdic.errors import InputError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ringdic_controller.access.attempts import AttemptLimit
from ringdic_controller.access.audit import AuditLog
from ringdic_controller.access.logins import Logins
from ringdic_controller.access.users import Account

ONLY_READS = ("GET", "HEAD", "OPTIONS")
OPEN_PATHS = ("/login", "/login.css")
EVERYBODY = Account("everybody", "operator")
LOOK_AGAIN = 2.0  # seconds between two looks whether an open stream is still allowed
STRANGERS_NOTED = (60, 60.0)  # refused requests of strangers that are noted within seconds: a log has an end


@dataclass(frozen=True)
class Access:
    """Who may use the page, and where it is noted what they do. logins : None where everybody may."""

    audit: AuditLog
    logins: Logins | None = None

    def account_of(self, connection: HTTPConnection) -> Account | None:
        """Who asks, by token or cookie; None for a stranger."""
        if self.logins is None:
            return EVERYBODY
        scheme, _, token = connection.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self.logins.users.check_token(token.strip())
        cookie = connection.cookies.get(cookie_name(connection))
        return self.logins.account(cookie) if cookie else None


def cookie_name(connection: HTTPConnection) -> str:
    """Name of the cookie of a login; under TLS the one that browsers bind to this host and to TLS."""
    return "__Host-ringdic" if connection.scope["scheme"] in ("https", "wss") else "ringdic"


def source_of(connection: HTTPConnection) -> str:
    """Address that a request comes from."""
    return connection.client.host if connection.client else "unknown"


class AccessGate:
    """ASGI middleware that lets those pass who may; answers others with 401, 403 or, for a page, the login."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access
        self._strangers = AttemptLimit(*STRANGERS_NOTED)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        try:
            account = self._access.account_of(connection)
        except InputError as error:  # the file of users is missing or damaged: nobody passes until it is mended
            await self._refuse(scope, receive, send, JSONResponse({"detail": str(error)}, 503))
            return
        if scope["type"] == "websocket":
            await self._pass_socket(account, scope, receive, send)
        elif scope["path"] in OPEN_PATHS:
            await self._app(scope, receive, send)
        elif (refusal := self._refusal(account, connection)) is not None:
            if scope["method"] not in ONLY_READS:
                self._note(account, connection, refusal.status_code, "")
            await self._refuse(scope, receive, send, refusal)
        elif scope["method"] in ONLY_READS:
            await _until_lost(self._app, self._access, scope, receive, send)
        else:
            assert account is not None
            await self._pass_action(account, connection, receive, send)

    async def _pass_socket(self, account: Account | None, scope: Scope, receive: Receive, send: Send) -> None:
        if account is None:
            await send({"type": "websocket.close", "code": 1008, "reason": "log in first"})
        else:
            await self._app(scope, receive, send)

    @staticmethod
    async def _refuse(scope: Scope, receive: Receive, send: Send, response: Response) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1011})
        else:
            await response(scope, receive, send)

    @staticmethod
    def _refusal(account: Account | None, connection: HTTPConnection) -> Response | None:
        """The answer to a request that may not pass; None if it may."""
        scope = connection.scope
        if account is None:
            if scope["path"] == "/" and scope["method"] in ("GET", "HEAD"):
                return RedirectResponse("/login", 303, {"Cache-Control": "no-store"})
            sentence = "Log in on the controller's page, or send a token: Authorization: Bearer TOKEN."
            return JSONResponse({"detail": sentence}, 401, {"WWW-Authenticate": "Bearer", "Cache-Control": "no-store"})
        if account.role != "operator" and scope["method"] not in ONLY_READS and scope["path"] != "/logout":
            sentence = f"'{account.name}' is a viewer and may only look; an operator may do this."
            return JSONResponse({"detail": sentence}, 403)
        return None

    async def _pass_action(self, account: Account, connection: HTTPConnection, receive: Receive, send: Send) -> None:
        """Pass on a request that changes something, and note it with its outcome, also if it fails."""
        body = bytearray()
        status = 500

        async def receive_and_keep() -> Message:
            message = await receive()
            if message["type"] == "http.request" and len(body) < 4000:
                body.extend(message.get("body", b"")[:4000])
            return message

        async def send_and_look(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(connection.scope, receive_and_keep, send_and_look)
        finally:
            await run_in_threadpool(self._note, account, connection, status, body.decode("utf-8", "replace"))

    def _note(self, account: Account | None, connection: HTTPConnection, status: int, sent: str) -> None:
        """Write one line of the audit log."""
        source = source_of(connection)
        if account is None and self._strangers.wait("all", time.monotonic()):
            return
        who, role = (account.name, account.role) if account else ("a stranger", "")
        outcome = f"{status} {HTTPStatus(status).phrase}"
        self._access.audit.note(who, role, source, f"{connection.scope['method']} {connection.url.path}", outcome, sent)


async def _until_lost(app: ASGIApp, access: Access, scope: Scope, receive: Receive, send: Send) -> None:
    """Pass on a request that reads. A stream without a stated length ends when the right to read does."""
    if access.logins is None:
        await app(scope, receive, send)
        return
    loop = asyncio.get_running_loop()
    connection = HTTPConnection(scope)
    ended = asyncio.Event()
    streams, looked = False, loop.time()

    async def send_while_allowed(message: Message) -> None:
        nonlocal streams, looked
        if ended.is_set():
            return
        if message["type"] == "http.response.start":
            streams = "content-length" not in Headers(raw=message["headers"])
        elif streams and message.get("more_body") and loop.time() - looked >= LOOK_AGAIN:
            looked = loop.time()
            if not _still_allowed(access, connection):
                ended.set()
                message = {"type": "http.response.body", "body": b"", "more_body": False}
        await send(message)

    async def receive_until_ended() -> Message:
        arrival, end = asyncio.ensure_future(receive()), asyncio.ensure_future(ended.wait())
        try:
            await asyncio.wait({arrival, end}, return_when=asyncio.FIRST_COMPLETED)
            return {"type": "http.disconnect"} if ended.is_set() else arrival.result()
        finally:
            arrival.cancel()
            end.cancel()

    await app(scope, receive_until_ended, send_while_allowed)


def _still_allowed(access: Access, connection: HTTPConnection) -> bool:
    try:
        return access.account_of(connection) is not None
    except InputError:
        return False
