"""Results of processing runs as the archive holds them: header (JSON), arrays, the file itself, and the report."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Response
from fastapi.responses import FileResponse, HTMLResponse
from ringdic.results.reader import read_summary, read_unmeasured
from ringdic.session.folder import is_run_name, open_session

from ringdic_controller.service.guard import PICTURES_ALONE
from ringdic_controller.service.preview import picture_jpeg
from ringdic_controller.service.refusals import NotFoundError
from ringdic_controller.service.routes.arrays import add_arrays, version_of
from ringdic_controller.service.routes.desk import TheDesk
from ringdic_controller.service.turns import Turns

router = APIRouter(prefix="/sessions/{session}/results", tags=["results"])
_REPORTS = Turns("reports are asked for", at_once=1, waiting=3)
_PICTURES = Turns("pictures are asked for", at_once=2, waiting=4)


def _locate(session: str, run: str, desk: TheDesk) -> Path:
    """The results file of a run."""
    try:
        path = desk.catalogue.file(session, "results", run, "results.h5") if is_run_name(run) else None
    except KeyError as error:
        raise NotFoundError(f"There is no session '{session}'.") from error
    if path is None:
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
    written = desk.catalogue.file(session, "results", run, path.name)
    if written is None or written.stat().st_mtime_ns < results.stat().st_mtime_ns:
        from ringdic.report import write_report  # loads the drawing library, which nothing else here needs

        with _REPORTS.take():
            write_report(desk.catalogue.path(session), path, int(run))
    headers = {"Cache-Control": "no-cache", "Content-Security-Policy": PICTURES_ALONE}
    return FileResponse(path, media_type="text/html", headers=headers)


@router.get("/{run}/unmeasured", summary="Texture that was not measured: areas by reason, and the cameras that show it")
def read_unmeasured_areas(path: RunFile) -> dict[str, Any]:
    """Reasons with their colours and areas (cm²), and the ids of the cameras whose photographs show them."""
    from ringdic.pictures.unmeasured import unmeasured_legend

    areas = read_summary(path)["summary"].get("unmeasured")
    return {
        "reasons": [asdict(row) for row in unmeasured_legend(areas)] if areas else [],
        "cameras": [places.camera for places in read_unmeasured(path) if len(places.px)],
    }


@router.get(
    "/{run}/unmeasured/{camera}",
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}}},
    summary="A photograph of the reference with what was not measured, as a JPEG",
)
def send_unmeasured_picture(
    session: str, camera: str, path: RunFile, desk: TheDesk, width: Annotated[int, Query(ge=16, le=4096)] = 480
) -> Response:
    """Photograph of a camera at the reference with the places that were not measured, at most ``width`` px wide."""
    from ringdic.pictures.overlay import photograph
    from ringdic.pictures.unmeasured import unmeasured_picture

    places = next((one for one in read_unmeasured(path) if one.camera == camera), None)
    if places is None:
        raise NotFoundError(f"The run does not tell what camera '{camera}' shows that was not measured.")
    with _PICTURES.take():
        image = photograph(open_session(desk.catalogue.path(session)), read_summary(path)["steps"][0], camera)
        jpeg = picture_jpeg(unmeasured_picture(image, places), width)
    return Response(jpeg, media_type="image/jpeg")


add_arrays(router, "/{run}", _locate)
