"""Results as they lie in the archive: a JSON header, and arrays as plain little-endian numbers with tags."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse, HTMLResponse
from numpy.typing import NDArray

from controller.desk import Desk, NotFoundError
from controller.routes.desk import TheDesk
from controller.routes.etag import forever, unchanged
from processing.results import read_field, read_mesh, read_positions, read_summary

router = APIRouter(prefix="/sessions/{session}/results", tags=["results"])

_BINARY: dict[int | str, dict[str, Any]] = {200: {"content": {"application/octet-stream": {}}}}
Version = Annotated[str | None, Query(description="The header's version; with it the answer may be kept for ever")]
Removed = Annotated[bool, Query(description="After the rigid motion of the whole surface has been taken out")]


@router.get("", summary="The processing runs of a session, oldest first")
def runs(session: str, desk: TheDesk) -> list[dict[str, Any]]:
    """Number, time and summary of each run."""
    desk.sessions()
    desk.session(session)
    return desk.catalogue.runs(session)


@router.get("/{run}", summary="What a run found: counts, steps, and the table of fields with their ranges")
def header(session: str, run: str, desk: TheDesk) -> dict[str, Any]:
    """``version`` changes only if another run is put in its place."""
    path = _file(desk, session, run)
    return {"session": session, "run": run, "version": _version(path), **read_summary(path)}


@router.get("/{run}/file", response_class=FileResponse, summary="The results file (HDF5)")
def file(session: str, run: str, desk: TheDesk) -> FileResponse:
    """VTKHDF form: opens in ParaView."""
    return FileResponse(_file(desk, session, run), filename=f"{session}-{run}.h5")


@router.get("/{run}/report", response_class=HTMLResponse, summary="The run's report: one page of HTML")
def report(session: str, run: str, desk: TheDesk) -> Response:
    """Made when it is first asked for, which takes a while, and kept beside the results."""
    results = _file(desk, session, run)
    path = results.with_name("report.html")
    if not path.is_file() or path.stat().st_mtime_ns < results.stat().st_mtime_ns:
        from processing.report import write_report  # draws; the page is served without it

        write_report(desk.catalogue.path(session), path, int(run))
    return FileResponse(path, media_type="text/html", headers={"Cache-Control": "no-cache"})


@router.get("/{run}/faces", response_class=Response, responses=_BINARY, summary="Triangles: uint32 (faces, 3)")
def faces(session: str, run: str, desk: TheDesk, request: Request, v: Version = None) -> Response:
    """Vertex indices; normals point outwards."""
    path = _file(desk, session, run)
    headers = _tagged(path, "faces", v)
    if unchanged(request, headers):
        return Response(status_code=304, headers=headers)
    return _binary(read_mesh(path).faces.astype("<u4"), headers)


@router.get(
    "/{run}/positions/{step}",
    response_class=Response,
    responses=_BINARY,
    summary="Vertices at one step: float32 (points, 3) mm",
)
def positions(
    session: str,
    run: str,
    step: int,
    desk: TheDesk,
    request: Request,
    rigid_motion_removed: Removed = False,
    v: Version = None,
) -> Response:
    """World frame of the target; NaN where not measured. Step 0 is the reference."""
    path = _file(desk, session, run)
    headers = _tagged(path, f"positions-{step}-{rigid_motion_removed:d}", v)
    if unchanged(request, headers):
        return Response(status_code=304, headers=headers)
    return _binary(read_positions(path, step, rigid_motion_removed).astype("<f4"), headers)


@router.get(
    "/{run}/fields/{name}/{step}",
    response_class=Response,
    responses=_BINARY,
    summary="One field at one step: float32 (points,) or (faces,)",
)
def field(
    session: str,
    run: str,
    name: str,
    step: int,
    desk: TheDesk,
    request: Request,
    rigid_motion_removed: Removed = False,
    v: Version = None,
) -> Response:
    """NaN where not measured; the header's table of fields tells unit and location."""
    path = _file(desk, session, run)
    values, location = read_field(path, name, step, rigid_motion_removed)
    headers = _tagged(path, f"{name}-{step}-{rigid_motion_removed:d}", v) | {"X-Location": location}
    if unchanged(request, headers):
        return Response(status_code=304, headers=headers)
    return _binary(values.astype("<f4"), headers)


def _file(desk: Desk, session: str, run: str) -> Path:
    try:
        path = desk.catalogue.path(session) / "results" / run / "results.h5"
    except KeyError as error:
        raise NotFoundError(f"There is no session '{session}'.") from error
    if not (run.isascii() and run.isdigit() and path.is_file()):
        raise NotFoundError(f"Session '{session}' has no results of a run '{run}'.")
    return path


def _version(path: Path) -> str:
    found = path.stat()
    return f"{found.st_mtime_ns:x}-{found.st_size:x}"


def _tagged(path: Path, name: str, asked: str | None) -> dict[str, str]:
    version = _version(path)
    return forever(f"{version}-{name}", revalidate=asked != version)


def _binary(array: NDArray[Any], headers: dict[str, str]) -> Response:
    shape = ",".join(str(n) for n in array.shape)
    content = np.ascontiguousarray(array).tobytes()
    return Response(
        content, media_type="application/octet-stream", headers=headers | {"X-Type": array.dtype.name, "X-Shape": shape}
    )
