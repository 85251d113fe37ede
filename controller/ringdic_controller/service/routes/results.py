"""Results of processing runs as the archive holds them: header (JSON), arrays, the file itself, and the report."""

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response
from fastapi.responses import FileResponse, HTMLResponse
from ringdic.results.reader import read_summary

from ringdic_controller.service.refusals import NotFoundError
from ringdic_controller.service.routes.arrays import add_arrays, version_of
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/sessions/{session}/results", tags=["results"])


def _locate(session: str, run: str, desk: TheDesk) -> Path:
    """The results file of a run."""
    try:
        path = desk.catalogue.path(session) / "results" / run / "results.h5"
    except KeyError as error:
        raise NotFoundError(f"There is no session '{session}'.") from error
    if not (run.isascii() and run.isdigit() and path.is_file()):
        raise NotFoundError(f"Session '{session}' has no results of a run '{run}'.")
    return path


RunFile = Annotated[Path, Depends(_locate)]


@router.get("", summary="The processing runs of a session, oldest first")
def list_runs(session: str, desk: TheDesk) -> list[dict[str, Any]]:
    """Number, time and summary of each processing run of a session, oldest first."""
    desk.catalogue.sync()
    desk.sessions.summary(session)
    return desk.catalogue.runs(session)


@router.get("/{run}", summary="Header of a run's results: counts, steps, and the table of fields with their ranges")
def read_run_header(session: str, run: str, path: RunFile) -> dict[str, Any]:
    """Header of a run's results; ``version`` changes only when the results file is replaced."""
    return {"session": session, "run": run, "version": version_of(path), **read_summary(path)}


@router.get("/{run}/file", response_class=FileResponse, summary="The results file (HDF5)")
def send_run_file(session: str, run: str, path: RunFile) -> FileResponse:
    """Results file of one run, in VTKHDF form, which opens in ParaView."""
    return FileResponse(path, filename=f"{session}-{run}.h5")


@router.get("/{run}/report", response_class=HTMLResponse, summary="The run's report: one page of HTML")
def read_report(session: str, run: str, results: RunFile, desk: TheDesk) -> Response:
    """The report of a run as HTML; the first request writes it beside the results, which takes a while."""
    path = results.with_name("report.html")
    if not path.is_file() or path.stat().st_mtime_ns < results.stat().st_mtime_ns:
        from ringdic.report import write_report  # loads the drawing library, which nothing else here needs

        write_report(desk.catalogue.path(session), path, int(run))
    return FileResponse(path, media_type="text/html", headers={"Cache-Control": "no-cache"})


add_arrays(router, "/{run}", _locate)
