"""Broadcast of events: published from any thread, followed by any number of HTTP event streams."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

from ringdic_controller.service.refusals import BusyError

Event = tuple[str, dict[str, Any]]
BACKLOG = 200  # events that a follower may be behind before it gets a new snapshot in their place
MOST_FOLLOWERS = 64  # each costs a connection, and its share of every event
SEAT_KEPT = 600.0  # seconds after which a follower makes room for another, if all seats are taken


class EventStream:
    """Stream of named events from publishers (threads) to followers (coroutines).

    A follower gets a snapshot of the whole state at once and then every event. One that falls behind gets a new
    snapshot in place of the events that it missed, so that it never shows an outdated state and its queue stays short.

    Parameters
    ----------
    snapshot
        Reads the whole state; called in a thread of its own for every follower.
    limit
        Largest number of followers.
    seat_kept
        Seconds after which the oldest follower makes room for a new one, if there are as many as that.
    """

    def __init__(
        self, snapshot: Callable[[], dict[str, Any]], limit: int = MOST_FOLLOWERS, seat_kept: float = SEAT_KEPT
    ) -> None:
        self._snapshot = snapshot
        self._limit = limit
        self._seat_kept = seat_kept
        self._lock = Lock()  # guards the followers
        self._followers: dict[_Follower, float] = {}  # since when each follows, s of the monotonic clock; oldest first

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
        """Names and contents of the events for one follower: a snapshot first, then each event, without end.

        Ends where the follower has to make room. Raises BusyError where there is none.
        """
        with self.seat() as follower:
            async for event in self.events_of(follower):
                yield event

    @contextmanager
    def seat(self) -> Iterator[_Follower]:
        """Context with a new follower, which collects the events from now on; entered in the follower's event loop.

        Raises BusyError if there are as many followers as there may be, and none that has followed for long: a page
        that was left open somewhere makes room for one that is opened now, and connects again by itself.
        """
        follower, now = _Follower(asyncio.get_running_loop()), time.monotonic()
        with self._lock:
            if len(self._followers) >= self._limit:
                oldest, since = next(iter(self._followers.items()))
                if now - since < self._seat_kept:
                    raise BusyError(
                        f"{self._limit} pages or scripts follow the live state, and no more can; close those that are "
                        "not needed, then reload."
                    )
                del self._followers[oldest]
                oldest.leave()
            self._followers[follower] = now
        try:
            yield follower
        finally:
            with self._lock:
                self._followers.pop(follower, None)

    async def events_of(self, follower: _Follower) -> AsyncIterator[Event]:
        """Names and contents of the events of a follower that has a seat: a snapshot first, then each event."""
        yield "snapshot", await asyncio.to_thread(self._snapshot)
        while not isinstance(event := await follower.next(), _Leave):
            if event is None:
                event = "snapshot", await asyncio.to_thread(self._snapshot)
            yield event


class _Leave:
    """Stands for the end of the events of a follower that has to make room."""


class _Follower:
    """Queue of the events that one follower has still to read; None stands for a new snapshot."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._events: asyncio.Queue[Event | _Leave | None] = asyncio.Queue()

    def leave(self) -> None:
        """End the events, from any thread."""
        self.offer(_Leave())

    def offer(self, event: Event | _Leave | None) -> None:
        """Add an event, from any thread."""
        try:
            self._loop.call_soon_threadsafe(self._put, event)
        except RuntimeError:  # the loop has closed: nobody follows any more
            return

    def _put(self, event: Event | _Leave | None) -> None:
        if self._events.qsize() >= BACKLOG:
            while not self._events.empty():
                self._events.get_nowait()
            self._events.put_nowait(None)
        self._events.put_nowait(event)

    async def next(self) -> Event | _Leave | None:
        """The oldest event that has not been read; waits for one."""
        return await self._events.get()
