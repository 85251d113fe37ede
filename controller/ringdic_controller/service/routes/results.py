"""Results as they lie in the archive: a JSON header, arrays, the file itself, and the report."""

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response
from fastapi.responses import FileResponse, HTMLResponse
from ringdic.results.reader import read_summary

from ringdic_controller.service.desk import NotFoundError
from ringdic_controller.service.routes.arrays import add_arrays, version_of
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/sessions/{session}/results", tags=["results"])


def _file(session: str, run: str, desk: TheDesk) -> Path:
    try:
        path = desk.catalogue.path(session) / "results" / run / "results.h5"
    except KeyError as error:
        raise NotFoundError(f"There is no session '{session}'.") from error
    if not (run.isascii() and run.isdigit() and path.is_file()):
        raise NotFoundError(f"Session '{session}' has no results of a run '{run}'.")
    return path


File = Annotated[Path, Depends(_file)]


@router.get("", summary="The processing runs of a session, oldest first")
def runs(session: str, desk: TheDesk) -> list[dict[str, Any]]:
    """Number, time and summary of each run."""
    desk.sessions()
    desk.session(session)
    return desk.catalogue.runs(session)


@router.get("/{run}", summary="What a run found: counts, steps, and the table of fields with their ranges")
def header(session: str, run: str, path: File) -> dict[str, Any]:
    """``version`` changes only if another run is put in its place."""
    return {"session": session, "run": run, "version": version_of(path), **read_summary(path)}


@router.get("/{run}/file", response_class=FileResponse, summary="The results file (HDF5)")
def file(session: str, run: str, path: File) -> FileResponse:
    """VTKHDF form: opens in ParaView."""
    return FileResponse(path, filename=f"{session}-{run}.h5")


@router.get("/{run}/report", response_class=HTMLResponse, summary="The run's report: one page of HTML")
def report(session: str, run: str, results: File, desk: TheDesk) -> Response:
    """Made when it is first asked for, which takes a while, and kept beside the results."""
    path = results.with_name("report.html")
    if not path.is_file() or path.stat().st_mtime_ns < results.stat().st_mtime_ns:
        from ringdic.report import write_report  # draws; the page is served without it

        write_report(desk.catalogue.path(session), path, int(run))
    return FileResponse(path, media_type="text/html", headers={"Cache-Control": "no-cache"})


add_arrays(router, "/{run}", _file)
