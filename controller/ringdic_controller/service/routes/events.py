"""Stream of the live state as server-sent events."""

from collections.abc import AsyncIterable, AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends
from fastapi.sse import EventSourceResponse, ServerSentEvent

from ringdic_controller.service.events import Event
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(tags=["live"])
_BUSY: dict[int | str, dict[str, Any]] = {503: {"description": "As many follow the live state as can"}}


async def _events(desk: TheDesk) -> AsyncIterator[AsyncIterator[Event]]:
    """The events of a follower that has a seat, before the answer begins: where there is none, it is a refusal."""
    stream = desk.state.events
    with stream.seat() as follower:
        yield stream.events_of(follower)


@router.get("/live", response_class=EventSourceResponse, responses=_BUSY, summary="Live state")
async def follow_events(events: Annotated[AsyncIterator[Event], Depends(_events)]) -> AsyncIterable[ServerSentEvent]:
    """Server-sent events of the live state, without end.

    The first is ``snapshot``; then come ``rig``, ``sessions``, ``round``, ``capture``, ``job``, ``runs`` as they
    change, ``processing`` (how ready it is) and ``newest`` (a step that has just been processed at once). A client
    that reconnects gets a new snapshot. 503 if too many follow; one that has followed for long makes room for a new
    one, and its stream ends.
    """
    async for name, payload in events:
        yield ServerSentEvent(event=name, data=payload)
