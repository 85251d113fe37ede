"""Login on a page of its own, which needs no script; logout; and who one is."""

from __future__ import annotations

from html import escape
from pathlib import Path
from string import Template
from typing import Annotated
from urllib.parse import parse_qs

from fastapi import APIRouter, Depends, Request
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse, Response
from pydantic import BaseModel
from ringdic.errors import InputError
from starlette.concurrency import run_in_threadpool

from ringdic_controller.access.logins import LOGIN_LASTS, TooManyAttemptsError
from ringdic_controller.access.users import Role
from ringdic_controller.service.gate import Access, cookie_name, source_of

FILES = Path(__file__).parents[1] / "login"
LONGEST_FORM = 4096  # bytes

router = APIRouter(include_in_schema=False)
account_router = APIRouter(tags=["account"])

_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; style-src 'self'; img-src data:; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'none'",
}


class AccountBody(BaseModel):
    """Who asks. login : whether one has to log in at all."""

    name: str
    role: Role
    login: bool


def _access(request: Request) -> Access:
    access: Access = request.app.state.access
    return access


TheAccess = Annotated[Access, Depends(_access)]


@account_router.get("/account", response_model=AccountBody, summary="Who asks")
def read_account(request: Request, access: TheAccess) -> dict[str, object]:
    """Name and role of whoever asks, and whether the controller asks for a login at all."""
    account = access.account_of(request)
    assert account is not None  # the gate has let the request pass
    return {"name": account.name, "role": account.role, "login": access.logins is not None}


@router.get("/login.css")
def send_style() -> Response:
    """The style of the login."""
    return FileResponse(FILES / "login.css", headers={"Cache-Control": "no-cache"})


@router.get("/login")
def send_login(access: TheAccess) -> Response:
    """The page to log in on; the controller's page where nobody has to."""
    return _page() if access.logins is not None else RedirectResponse("/", 303)


@router.post("/login")
async def log_in(request: Request, access: TheAccess) -> Response:
    """Check name and password of the form, and lead to the controller's page with a cookie, or back with a sentence."""
    logins = access.logins
    if logins is None:
        return RedirectResponse("/", 303)
    name, password = await _form(request)
    source = source_of(request)

    async def note(outcome: str) -> None:
        await run_in_threadpool(access.audit.note, name, "", source, "login", outcome)

    if not name or not password:
        return _page("Type both name and password.", name, 422)
    try:
        logins.claim_attempt(name, source)
        account = await logins.check(name, password)
    except TooManyAttemptsError as error:
        await note("too many attempts")
        return _page(str(error), name, 429, {"Retry-After": str(error.seconds)})
    except InputError as error:
        return _page(str(error), name, 503)
    if account is None:
        await note("wrong name or password")
        return _page("Name or password is wrong.", name, 401)
    await note("logged in")
    answer = RedirectResponse("/", 303, {"Cache-Control": "no-store"})
    answer.set_cookie(
        cookie_name(request),
        logins.cookie(account, source),
        max_age=LOGIN_LASTS,
        path="/",
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return answer


@router.post("/logout")
def log_out(request: Request, access: TheAccess) -> Response:
    """End the login, and lead to the page to log in on."""
    cookie = request.cookies.get(cookie_name(request))
    if access.logins is not None and cookie:
        access.logins.end(cookie)
    answer = RedirectResponse("/login", 303, {"Cache-Control": "no-store"})
    answer.delete_cookie(
        cookie_name(request), path="/", httponly=True, samesite="strict", secure=request.url.scheme == "https"
    )
    return answer


async def _form(request: Request) -> tuple[str, str]:
    """Name and password of the form; empty where it holds none, or is longer than a form can be."""
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > LONGEST_FORM:
            return "", ""
    try:
        fields = parse_qs(body.decode("utf-8"), max_num_fields=10)
    except ValueError:
        return "", ""
    return fields.get("name", [""])[0].strip(), fields.get("password", [""])[0]


def _page(sentence: str = "", name: str = "", status: int = 200, headers: dict[str, str] | None = None) -> HTMLResponse:
    """The page to log in on, with a sentence why it did not work and the name that was typed."""
    template = Template((FILES / "login.html").read_text(encoding="utf-8"))
    text = template.substitute(sentence=escape(sentence), name=escape(name), hidden="" if sentence else "hidden")
    return HTMLResponse(text, status, {**_HEADERS, **(headers or {})})
