"""Stream of the live state as server-sent events."""

from collections.abc import AsyncIterable

from fastapi import APIRouter
from fastapi.sse import EventSourceResponse, ServerSentEvent

from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(tags=["live"])


@router.get("/live", response_class=EventSourceResponse, summary="Live state")
async def follow_events(desk: TheDesk) -> AsyncIterable[ServerSentEvent]:
    """Server-sent events of the live state, without end.

    The first is ``snapshot``; then come ``rig``, ``sessions``, ``round``, ``capture``, ``job``, ``runs`` as they
    change, ``processing`` (how ready it is) and ``newest`` (a step that has just been processed at once). A client
    that reconnects gets a new snapshot.
    """
    async for name, payload in desk.state.events.follow():
        yield ServerSentEvent(event=name, data=payload)
