"""Sessions: list, make, select."""

from typing import Annotated

from fastapi import APIRouter, status
from pydantic import BaseModel, Field

from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/sessions", tags=["sessions"])


class Session(BaseModel):
    """One session: captures of each kind and processing runs are counted."""

    name: str
    rig: str | None
    created: str | None
    source: str | None
    captures: dict[str, int]
    runs: int


class SessionList(BaseModel):
    """All sessions, newest first, and the one that captures go to."""

    sessions: list[Session]
    current: str | None


class NewSession(BaseModel):
    """Without a name the session is called by the time."""

    name: Annotated[str | None, Field(max_length=100)] = None


class Selection(BaseModel):
    """The session to select."""

    name: str


@router.get("", response_model=SessionList, summary="All sessions")
def sessions(desk: TheDesk) -> dict[str, object]:
    """The folders are looked at anew."""
    return {"sessions": desk.sessions(), "current": desk.current()}


@router.post("", response_model=Session, status_code=status.HTTP_201_CREATED, summary="Make a session and select it")
def create(new: NewSession, desk: TheDesk) -> dict[str, object]:
    """409 if the name is taken or there is no rig, 422 if it is unusable."""
    return desk.create_session(new.name)


@router.put("/current", response_model=Session, summary="Select the session that captures go to")
def select(selection: Selection, desk: TheDesk) -> dict[str, object]:
    """404 if there is no such session, 409 while a capture is under way in another."""
    return desk.select_session(selection.name)


@router.get("/{name}", response_model=Session, summary="One session")
def session(name: str, desk: TheDesk) -> dict[str, object]:
    """404 if there is no such session."""
    desk.sessions()
    return desk.session(name)
