"""Sessions: list, create, select."""

from typing import Annotated

from fastapi import APIRouter, status
from pydantic import BaseModel, Field

from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/sessions", tags=["sessions"])


class SessionBody(BaseModel):
    """One session, with the number of its captures of each kind and of its processing runs.

    ``damaged`` has a sentence for each file in its folder that is not readable, which is left as it is.
    """

    name: str
    rig: str | None
    created: str | None
    source: str | None
    captures: dict[str, int]
    runs: int
    damaged: list[str] = []


class SessionList(BaseModel):
    """All sessions, newest first, and the one that captures go to."""

    sessions: list[SessionBody]
    current: str | None


class NewSession(BaseModel):
    """Name of a session to create; without one it is named by the time."""

    name: Annotated[str | None, Field(max_length=100)] = None


class Selection(BaseModel):
    """Name of the session to select."""

    name: str


@router.get("", response_model=SessionList, summary="All sessions")
def list_sessions(desk: TheDesk) -> dict[str, object]:
    """All sessions after new and changed folders have been read, and the one that captures go to."""
    return {"sessions": desk.sessions.summaries(), "current": desk.sessions.current()}


@router.post(
    "", response_model=SessionBody, status_code=status.HTTP_201_CREATED, summary="Create a session and select it"
)
def create_session(new: NewSession, desk: TheDesk) -> dict[str, object]:
    """Create a session, select it and return it.

    409 if the name is taken, there is no rig or a capture is under way; 422 if the name is unusable.
    """
    return desk.create_session(new.name)


@router.put("/current", response_model=SessionBody, summary="Select the session that captures go to")
def select_session(selection: Selection, desk: TheDesk) -> dict[str, object]:
    """Send captures to a session from now on, and return it.

    404 if there is no such session, 409 while a capture is under way in another.
    """
    return desk.select_session(selection.name)


@router.get("/{name}", response_model=SessionBody, summary="One session")
def read_session(name: str, desk: TheDesk) -> dict[str, object]:
    """One session after new and changed folders have been read; 404 if there is no such session."""
    desk.catalogue.sync()
    return desk.sessions.summary(name)
