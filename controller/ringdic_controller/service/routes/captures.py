"""Captures: begin one, follow it, read its record and images."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response, status
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field
from ringdic.errors import InputError
from ringdic.session.load import LoadChannel, LoadConflictError, read_load
from ringdic.session.names import CaptureKind
from ringdic.session.records import LONGEST_NOTE

from ringdic_controller.service.desk import Desk
from ringdic_controller.service.preview import preview_jpeg
from ringdic_controller.service.refusals import NotFoundError, RefusedError
from ringdic_controller.service.rounds import Round
from ringdic_controller.service.routes.desk import TheDesk
from ringdic_controller.service.routes.etag import cache_headers, client_has
from ringdic_controller.service.sequences import LONGEST_PAUSE, MOST_ROUNDS, CaptureSequence
from ringdic_controller.service.sessions import no_capture
from ringdic_controller.service.turns import Turns

router = APIRouter(tags=["captures"])
Reading = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_SHA256 = re.compile(r"[0-9a-f]{64}")  # no other text of a record goes into a header
_PREVIEWS = Turns("previews are asked for", at_once=2, waiting=14)  # each holds a whole image in memory


class NewCapture(BaseModel):
    """Kind of a capture to begin; with ``override`` cameras that are missing or not armed are left out as failed.

    With ``count`` it is a sequence of so many, one every ``every_s`` seconds; 0 is a burst, as fast as rounds go.
    """

    kind: CaptureKind
    override: bool = False
    count: Annotated[int | None, Field(ge=1, le=MOST_ROUNDS)] = None
    every_s: Annotated[float | None, Field(ge=0, le=LONGEST_PAUSE, allow_inf_nan=False)] = None


class CaptureChange(BaseModel):
    """What the operator changes of a capture: its note."""

    note: Annotated[str, Field(max_length=LONGEST_NOTE)]


class SentLoad(BaseModel):
    """One load channel: a single value, or [time in ns since the Unix epoch, value] in order of time.

    With ``replace`` it replaces other values of the channel that are archived.
    """

    name: str
    unit: str = ""
    values: Reading | list[tuple[Annotated[int, Field(strict=True)], Reading]]
    replace: bool = False


@router.post(
    "/captures",
    response_model=Round | CaptureSequence,
    status_code=status.HTTP_202_ACCEPTED,
    summary="Begin a capture, or a sequence of captures, in the current session",
)
def begin_capture(new: NewCapture, desk: TheDesk) -> Round | CaptureSequence:
    """Begin a capture round, or with ``count`` a sequence of them, and return it.

    ``/rounds/{id}``, ``/sequences/{id}`` and the live events show its progress. 409 if refused.
    """
    if new.count is not None:
        return desk.sequences.begin(new.kind, new.count, new.every_s or 0.0, override=new.override)
    if new.every_s is not None:
        raise InputError("'every_s' is of a sequence; give its number of rounds as 'count'")
    return desk.rounds.begin(new.kind, override=new.override)


@router.get("/sequences/{sequence_id}", response_model=CaptureSequence, summary="State of a sequence of captures")
def read_sequence(sequence_id: str, desk: TheDesk) -> dict[str, Any]:
    """One sequence: its state, the captures that have closed, and the rounds that were missed, with reasons."""
    return asdict(desk.sequences.get(sequence_id))


@router.post("/sequences/{sequence_id}/cancel", response_model=CaptureSequence, summary="Cancel a sequence")
def cancel_sequence(sequence_id: str, desk: TheDesk) -> dict[str, Any]:
    """Begin no further round of a sequence, and return it; a round that is under way goes to its end."""
    return asdict(desk.sequences.cancel(sequence_id))


@router.get("/rounds/{round_id}", response_model=Round, summary="State of a capture round")
def read_round(round_id: str, desk: TheDesk) -> dict[str, Any]:
    """One capture round: ``state`` is arming, open, closed or refused; ``capture_id`` is null until it opens."""
    return asdict(desk.rounds.get(round_id))


@router.get("/sessions/{session}/captures", summary="The capture records of a session, in order")
def list_captures(session: str, desk: TheDesk) -> list[dict[str, Any]]:
    """Capture records with, for each camera, status, reason, SHA-256, size, measured time, exposure, metadata."""
    desk.sessions.summary(session)
    return desk.catalogue.captures(session)


@router.get("/sessions/{session}/captures/{capture_id}", summary="One capture record")
def read_capture(session: str, capture_id: str, desk: TheDesk) -> dict[str, Any]:
    """The record of a capture; 404 if there is none."""
    try:
        return desk.catalogue.capture(session, capture_id)
    except KeyError as error:
        raise no_capture(session, capture_id) from error


@router.patch("/sessions/{session}/captures/{capture_id}", summary="Change the note of a capture")
def change_capture(session: str, capture_id: str, change: CaptureChange, desk: TheDesk) -> dict[str, Any]:
    """Replace what the operator noted of a capture, and return its record; an empty note is removed."""
    desk.sessions.writer(session, capture_id).annotate(change.note)
    desk.state.publish_capture(session, capture_id)
    return read_capture(session, capture_id, desk)


@router.get("/sessions/{session}/captures/{capture_id}/load", summary="The load channels of a capture")
def read_capture_load(session: str, capture_id: str, desk: TheDesk) -> list[dict[str, Any]]:
    """The load channels archived beside a capture, each with name, unit and values; none if there are none."""
    read_capture(session, capture_id, desk)
    return [channel.to_json() for channel in read_load(desk.catalogue.path(session) / "captures" / capture_id)]


@router.put("/sessions/{session}/captures/{capture_id}/load", summary="Archive a load channel beside a capture")
def store_load(session: str, capture_id: str, sent: SentLoad, desk: TheDesk) -> list[dict[str, Any]]:
    """Archive one load channel and return all of the capture.

    409 if other values of this channel are archived, unless ``replace`` is true.
    """
    values = sent.values if isinstance(sent.values, float) else tuple(sent.values)
    channel = LoadChannel(sent.name, sent.unit, values)
    writer = desk.sessions.writer(session, capture_id)
    try:
        channels = writer.store_load(channel, replace=sent.replace)
    except LoadConflictError as error:
        raise RefusedError(f"{error}: send it again with 'replace'") from error
    return [each.to_json() for each in channels]


@router.get(
    "/sessions/{session}/captures/{capture_id}/images/{camera}",
    response_class=FileResponse,
    summary="One image, byte for byte as archived",
)
def send_image(session: str, capture_id: str, camera: str, desk: TheDesk) -> FileResponse:
    """Original file of an image; its SHA-256 is the one in the capture's record."""
    path, sha256 = _image(desk, session, capture_id, camera)
    # As nothing that a browser would show by itself: the record of a foreign session names the file.
    return FileResponse(
        path,
        media_type="application/octet-stream",
        filename=f"{session}-{capture_id}-{path.name}",
        headers={"X-SHA256": sha256},
    )


@router.get(
    "/sessions/{session}/captures/{capture_id}/images/{camera}/preview",
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}}},
    summary="One image as a small JPEG",
)
def send_preview(
    session: str,
    capture_id: str,
    camera: str,
    desk: TheDesk,
    request: Request,
    width: Annotated[int, Query(ge=16, le=2048)] = 320,
) -> Response:
    """Small picture of an image as a JPEG, at most ``width`` px wide."""
    path, sha256 = _image(desk, session, capture_id, camera)
    headers = cache_headers(f"{sha256[:32]}-{width}")
    if client_has(request, headers):
        return Response(status_code=304, headers=headers)
    with _PREVIEWS.take():
        jpeg = preview_jpeg(path, width)
    return Response(jpeg, media_type="image/jpeg", headers=headers)


def _image(desk: Desk, session: str, capture_id: str, camera: str) -> tuple[Path, str]:
    """Path and checksum of an archived image, from the capture's record: no other file can be asked for."""
    entry = read_capture(session, capture_id, desk).get("cameras", {}).get(camera)
    if entry is None or not entry.get("file"):
        raise NotFoundError(f"Capture '{capture_id}' has no image of camera '{camera}'.")
    path = desk.catalogue.file(session, "captures", capture_id, str(entry["file"]))
    if path is None:
        raise NotFoundError(f"The image {entry['file']} of capture '{capture_id}' is not in its folder any more.")
    sha256 = str(entry.get("sha256"))
    return path, sha256 if _SHA256.fullmatch(sha256) else ""
