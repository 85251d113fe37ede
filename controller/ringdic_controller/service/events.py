"""Broadcast of events: published from any thread, followed by any number of HTTP event streams."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from threading import Lock
from typing import Any

Event = tuple[str, dict[str, Any]]
BACKLOG = 200  # events that a follower may be behind before it gets a new snapshot in their place


class EventStream:
    """Stream of named events from publishers (threads) to followers (coroutines).

    A follower gets a snapshot of the whole state at once and then every event. One that falls behind gets a new
    snapshot in place of the events that it missed, so that it never shows an outdated state and its queue stays short.

    Parameters
    ----------
    snapshot
        Reads the whole state; called in a thread of its own for every follower.
    """

    def __init__(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        self._snapshot = snapshot
        self._lock = Lock()  # guards the set of followers
        self._followers: set[_Follower] = set()

    def publish(self, name: str, payload: dict[str, Any]) -> None:
        """Send an event to every follower; returns at once and may be called from any thread."""
        self._offer((name, payload))

    def publish_snapshot(self) -> None:
        """Send the whole state to every follower, read when the follower's turn comes.

        A snapshot read here could reach a follower after an event that is newer.
        """
        self._offer(None)

    def _offer(self, event: Event | None) -> None:
        with self._lock:
            followers = tuple(self._followers)
        for follower in followers:
            follower.offer(event)

    async def follow(self) -> AsyncIterator[Event]:
        """Names and contents of the events for one follower: a snapshot first, then each event, without end."""
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
    """Queue of the events that one follower has still to read; None stands for a new snapshot."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._events: asyncio.Queue[Event | None] = asyncio.Queue()

    def offer(self, event: Event | None) -> None:
        """Add an event, from any thread."""
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
        """The oldest event that has not been read; waits for one."""
        return await self._events.get()
