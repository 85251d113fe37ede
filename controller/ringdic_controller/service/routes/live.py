"""Live state by server-sent events."""

from collections.abc import AsyncIterable

from fastapi import APIRouter
from fastapi.sse import EventSourceResponse, ServerSentEvent

from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(tags=["live"])


@router.get("/live", response_class=EventSourceResponse, summary="Live state")
async def live(desk: TheDesk) -> AsyncIterable[ServerSentEvent]:
    """First ``snapshot``, then ``rig``, ``sessions``, ``round``, ``capture``, ``job``, ``runs`` as they change,
    ``processing`` (how ready it is) and ``newest`` (a step that has just been processed at once).

    Whoever reconnects gets a new snapshot.
    """
    async for name, payload in desk.live.follow():
        yield ServerSentEvent(event=name, data=payload)
