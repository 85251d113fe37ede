"""Live state: what changes is published from any thread and followed by any number of event streams."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from threading import Lock
from typing import Any

Event = tuple[str, dict[str, Any]]
BACKLOG = 200  # events a slow reader may be behind before it gets a fresh snapshot instead


class Live:
    """A meeting point of publishers (threads) and followers (coroutines).

    A follower gets a snapshot at once and then every event; one that falls behind gets a new snapshot in
    place of what it missed, so nobody ever shows a stale state and no queue grows without bound.
    """

    def __init__(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        self._snapshot = snapshot
        self._followers: set[_Follower] = set()
        self._lock = Lock()

    def publish(self, name: str, payload: dict[str, Any]) -> None:
        """Tell every follower; returns at once and may be called from any thread."""
        self._offer((name, payload))

    def publish_snapshot(self) -> None:
        """Tell every follower the whole state anew, as it is when the follower's turn comes.

        Taken here, it could be told after an event that is newer than it.
        """
        self._offer(None)

    def _offer(self, event: Event | None) -> None:
        with self._lock:
            followers = tuple(self._followers)
        for follower in followers:
            follower.offer(event)

    async def follow(self) -> AsyncIterator[Event]:
        """The snapshot, then events as they come, without end."""
        follower = _Follower(asyncio.get_running_loop())
        with self._lock:
            self._followers.add(follower)
        try:
            yield "snapshot", await asyncio.to_thread(self._snapshot)
            while True:
                event = await follower.next()
                if event is None:
                    event = "snapshot", await asyncio.to_thread(self._snapshot)
                yield event
        finally:
            with self._lock:
                self._followers.discard(follower)


class _Follower:
    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._events: asyncio.Queue[Event | None] = asyncio.Queue()

    def offer(self, event: Event | None) -> None:
        """An event to follow; None for a fresh snapshot."""
        try:
            self._loop.call_soon_threadsafe(self._put, event)
        except RuntimeError:  # the loop has closed: nobody follows any more
            return

    def _put(self, event: Event | None) -> None:
        if self._events.qsize() >= BACKLOG:
            while not self._events.empty():
                self._events.get_nowait()
            self._events.put_nowait(None)
        self._events.put_nowait(event)

    async def next(self) -> Event | None:
        return await self._events.get()
