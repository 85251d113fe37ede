"""A link that can be cut and slowed down: it passes on what a node and its controller send each other over TCP."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Coroutine
from typing import Any

_PIECE = 16 << 10  # bytes passed on at once


class LinkProxy:
    """A TCP port on loopback whose connections are passed on to another one.

    It works in a thread of its own until `close`.

    Parameters
    ----------
    target : port on loopback of the one that is connected to.
    """

    def __init__(self, target: int) -> None:
        self._target = target
        self._loop = asyncio.new_event_loop()
        self._open = asyncio.Event()
        self._open.set()
        self._pause = 0.0  # s after each piece
        self._thread = threading.Thread(target=self._loop.run_forever, name="link", daemon=True)
        self._thread.start()
        self._server: asyncio.Server = self._run(asyncio.start_server(self._serve, "127.0.0.1", 0))
        self.port: int = self._server.sockets[0].getsockname()[1]

    def _run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(10)

    def cut(self) -> None:
        """Let nothing pass; neither side is told, as with a cable that is pulled out."""
        self._loop.call_soon_threadsafe(self._open.clear)

    def slow_down(self, bytes_per_second: float) -> None:
        """Let so many bytes a second pass on each connection and way."""
        self._pause = _PIECE / bytes_per_second

    def restore(self) -> None:
        """Let everything pass at once again."""
        self._pause = 0.0
        self._loop.call_soon_threadsafe(self._open.set)

    def close(self) -> None:
        """End all connections."""
        self._run(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        await asyncio.sleep(0)  # the transports that were closed end their connections

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.CancelledError), contextlib.closing(writer):
            away_reader, away_writer = await asyncio.open_connection("127.0.0.1", self._target)
            await asyncio.gather(self._pass_on(reader, away_writer), self._pass_on(away_reader, writer))

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError), contextlib.closing(writer):
            while piece := await reader.read(_PIECE):
                await self._open.wait()
                writer.write(piece)
                await writer.drain()
                if self._pause:
                    await asyncio.sleep(self._pause)
