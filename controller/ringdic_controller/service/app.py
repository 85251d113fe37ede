"""The web application: the HTTP interface under /api/v1, and the page."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, Response
from fastapi.staticfiles import StaticFiles
from ringdic.errors import RingdicError
from starlette.types import Scope

from ringdic_controller.service.desk import Desk
from ringdic_controller.service.refusals import NotFoundError, RefusedError
from ringdic_controller.service.routes import captures, events, jobs, live_step, results, rig, sessions

STATIC = Path(__file__).parents[1] / "web" / "static"
_NO_PAGE = (
    "<!doctype html><title>RingDIC</title><p>The page is not part of this installation: it was built with "
    "RINGDIC_SKIP_PAGE set. Install again without it. The HTTP interface works: see "
    "<a href='/openapi.json'>/openapi.json</a>."
)


def create_app(desk: Desk, static: Path = STATIC) -> FastAPI:
    """Create the web application that serves a desk over HTTP, and the bundled page.

    Parameters
    ----------
    desk
        Answers the requests.
    static
        Folder of the page's files.
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
    api = APIRouter(prefix="/api/v1", responses={404: {"description": "Not found"}, 409: {"description": "Refused"}})
    for resource in (rig, sessions, captures, jobs, results, live_step, events):
        api.include_router(resource.router)
    app.include_router(api)
    _answer_errors(app)
    _serve_page(app, static)
    return app


def _answer_errors(app: FastAPI) -> None:
    """Answer every error that a client can correct with a status and one sentence."""

    def answer(status: int, sentence: str) -> JSONResponse:
        return JSONResponse({"detail": sentence}, status)

    @app.exception_handler(RefusedError)
    def refused(_: Request, error: RefusedError) -> Response:
        return answer(409, str(error))

    @app.exception_handler(NotFoundError)
    def not_found(_: Request, error: NotFoundError) -> Response:
        return answer(404, str(error))

    @app.exception_handler(RingdicError)
    def bad_input(_: Request, error: RingdicError) -> Response:
        return answer(422, str(error))

    @app.exception_handler(RequestValidationError)
    def bad_request(_: Request, error: RequestValidationError) -> Response:
        faults = [f"{'.'.join(str(part) for part in fault['loc'][1:])}: {fault['msg']}" for fault in error.errors()]
        return answer(422, "The request is not understood: " + "; ".join(faults))


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
        return FileResponse(page, headers={"Cache-Control": "no-cache"})

    app.mount("/assets", _HashedFiles(directory=static / "assets", check_dir=False), name="assets")
