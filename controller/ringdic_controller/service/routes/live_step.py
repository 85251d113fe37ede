"""Live steps, captures that were processed alone as soon as they were archived: headers, arrays, files."""

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends
from fastapi.responses import FileResponse
from ringdic.results.reader import read_summary

from ringdic_controller.service.refusals import NotFoundError
from ringdic_controller.service.routes.arrays import add_arrays, version_of
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/sessions/{session}/live", tags=["live"])


def _locate(session: str, capture_id: str, desk: TheDesk) -> Path:
    """The results file of a live step."""
    if capture_id in (folder.name for folder in desk.catalogue.live_steps(session)):
        path = desk.catalogue.file(session, "live", capture_id, "results.h5")
        if path is not None:
            return path
    raise NotFoundError(f"Session '{session}' has no live results of capture '{capture_id}'; newer ones replace them.")


StepFile = Annotated[Path, Depends(_locate)]


@router.get("", summary="Header of the newest live step")
def read_newest_step(session: str, desk: TheDesk) -> dict[str, Any]:
    """Header of the newest live step, and the seconds from its last image until it was ready; 404 if there is none.

    The results hold two steps, the reference and this one.
    """
    desk.sessions.summary(session)
    newest = desk.sessions.newest_step(session)
    if newest is None:
        raise NotFoundError(f"Session '{session}' has no live results; they come with the captures of its specimen.")
    path = _locate(session, newest["capture_id"], desk)
    return newest | read_live_step(session, newest["capture_id"], path)


@router.get("/{capture_id}", summary="Header of one of the newest live steps; older ones are removed")
def read_live_step(session: str, capture_id: str, path: StepFile) -> dict[str, Any]:
    """Header of one live step: counts, steps, and the table of fields with their ranges."""
    return {"session": session, "capture_id": capture_id, "version": version_of(path), **read_summary(path)}


@router.get("/{capture_id}/file", response_class=FileResponse, summary="The results file (HDF5)")
def send_step_file(session: str, capture_id: str, path: StepFile) -> FileResponse:
    """Results file of one live step, in VTKHDF form, which opens in ParaView."""
    return FileResponse(path, filename=f"{session}-{capture_id}.h5")


add_arrays(router, "/{capture_id}", _locate)
