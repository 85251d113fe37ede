"""The newest step as it is shown while the capturing goes on: its header and arrays."""

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends
from fastapi.responses import FileResponse
from ringdic.results.reader import read_summary

from ringdic_controller.service.desk import NotFoundError
from ringdic_controller.service.routes.arrays import add_arrays, version_of
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/sessions/{session}/live", tags=["live"])


def _file(session: str, capture_id: str, desk: TheDesk) -> Path:
    for folder in desk.catalogue.live(session):
        if folder.name == capture_id and (folder / "results.h5").is_file():
            return folder / "results.h5"
    raise NotFoundError(f"Session '{session}' has no live results of capture '{capture_id}'; newer ones replace them.")


File = Annotated[Path, Depends(_file)]


@router.get("", summary="The newest step that was processed at once")
def newest(session: str, desk: TheDesk) -> dict[str, Any]:
    """As of a run, for the reference and that step; and how long after its last image it was ready. 404 if none."""
    desk.session(session)
    notice = desk.newest_step(session)
    if notice is None:
        raise NotFoundError(f"Session '{session}' has no live results; they come with the captures of its specimen.")
    return notice | header(session, notice["capture_id"], _file(session, notice["capture_id"], desk), desk)


@router.get("/{capture_id}", summary="One of the newest steps; the others have been replaced")
def header(session: str, capture_id: str, path: File, desk: TheDesk) -> dict[str, Any]:
    """Counts, steps, and the table of fields with their ranges."""
    return {"session": session, "capture_id": capture_id, "version": version_of(path), **read_summary(path)}


@router.get("/{capture_id}/file", response_class=FileResponse, summary="The results file (HDF5)")
def file(session: str, capture_id: str, path: File) -> FileResponse:
    """VTKHDF form: opens in ParaView."""
    return FileResponse(path, filename=f"{session}-{capture_id}.h5")


add_arrays(router, "/{capture_id}", _file)
