"""The web application: the HTTP interface under /api/v1, and the page."""

from __future__ import annotations

import logging
from pathlib import Path

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, Response
from fastapi.staticfiles import StaticFiles
from ringdic.errors import RingdicError
from starlette.types import Scope

from ringdic_controller.access.audit import AUDIT_FILE, AuditLog
from ringdic_controller.service.desk import Desk
from ringdic_controller.service.gate import Access, AccessGate
from ringdic_controller.service.guard import OWN_FILES_RUN, SAFE_HEADERS, GuardRules, RequestGuard
from ringdic_controller.service.refusals import NO_ROOM, BusyError, NotFoundError, RefusedError, disk_sentence
from ringdic_controller.service.routes import captures, events, jobs, live_step, login, results, rig, sessions

logger = logging.getLogger(__name__)

STATIC = Path(__file__).parents[1] / "web" / "static"
_NO_PAGE = (
    "<!doctype html><title>RingDIC</title><p>The page is not part of this installation: it was built with "
    "RINGDIC_SKIP_PAGE set. Install again without it. The HTTP interface works: see "
    "<a href='/openapi.json'>/openapi.json</a>."
)


def create_app(
    desk: Desk, static: Path = STATIC, rules: GuardRules | None = None, access: Access | None = None
) -> FastAPI:
    """Create the web application that serves a desk over HTTP, and the bundled page.

    Parameters
    ----------
    desk
        Answers the requests.
    static
        Folder of the page's files.
    rules
        Which requests pass; None lets those pass that come to an address of this PC.
    access
        Who may use it; None where whoever reaches it may.
    """
    app = FastAPI(
        title="RingDIC controller",
        version="1",
        description="Captures, sessions, processing jobs and results of a ring of cameras. "
        "Everything the page can do, a script can do.",
        docs_url=None,  # the viewers of both would be loaded from another host, and the running system needs no network
        redoc_url=None,
    )
    app.state.desk = desk
    app.state.access = access or Access(AuditLog(desk.catalogue.root / AUDIT_FILE))
    app.add_middleware(AccessGate, access=app.state.access)
    app.add_middleware(RequestGuard, rules=rules or GuardRules())  # the last one added is asked first
    api = APIRouter(prefix="/api/v1", responses={404: {"description": "Not found"}, 409: {"description": "Refused"}})
    for resource in (rig, sessions, captures, jobs, results, live_step, events):
        api.include_router(resource.router)
    api.include_router(login.account_router)
    app.include_router(api)
    app.include_router(login.router)
    _answer_errors(app)
    _serve_page(app, static)
    return app


def _answer_errors(app: FastAPI) -> None:
    """Answer every error with a status and one sentence: what the client, the disk or this program is at fault for."""

    def answer(status: int, sentence: str) -> JSONResponse:
        # A name in it may hold half a character, which JSON in UTF-8 cannot.
        return JSONResponse({"detail": sentence.encode("utf-8", "replace").decode()}, status)

    @app.exception_handler(RefusedError)
    def refused(_: Request, error: RefusedError) -> Response:
        return answer(409, str(error))

    @app.exception_handler(NotFoundError)
    def not_found(_: Request, error: NotFoundError) -> Response:
        return answer(404, str(error))

    @app.exception_handler(BusyError)
    def busy(_: Request, error: BusyError) -> Response:
        return answer(503, str(error))

    @app.exception_handler(RingdicError)
    def bad_input(_: Request, error: RingdicError) -> Response:
        return answer(422, str(error))

    @app.exception_handler(RequestValidationError)
    def bad_request(_: Request, error: RequestValidationError) -> Response:
        faults = [f"{'.'.join(str(part) for part in fault['loc'][1:])}: {fault['msg']}" for fault in error.errors()]
        return answer(422, "The request is not understood: " + "; ".join(faults))

    @app.exception_handler(OSError)
    def disk_failed(_: Request, error: OSError) -> Response:
        logger.error("a request failed at the disk: %s", error)
        return answer(507 if error.errno in NO_ROOM else 503, disk_sentence(error))

    @app.exception_handler(Exception)
    def failed(_: Request, error: Exception) -> Response:
        response = answer(500, "The request failed through a fault of the controller's own; see the controller's log.")
        response.headers.update(SAFE_HEADERS)  # it does not pass the guard
        return response


class _HashedFiles(StaticFiles):
    """Files whose names contain a hash of their contents, so that clients may keep them for ever."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        if response.status_code == 200:
            response.headers["Cache-Control"] = "public, max-age=31536000, immutable"
        return response


def _serve_page(app: FastAPI, static: Path) -> None:
    page = static / "index.html"

    @app.get("/", include_in_schema=False)
    def index() -> Response:
        if not page.is_file():
            return HTMLResponse(_NO_PAGE, 503)
        return FileResponse(page, headers={"Cache-Control": "no-cache", "Content-Security-Policy": OWN_FILES_RUN})

    app.mount("/assets", _HashedFiles(directory=static / "assets", check_dir=False), name="assets")
