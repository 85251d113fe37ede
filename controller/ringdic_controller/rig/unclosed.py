"""Records of captures that could not be closed, because the archive's disk was full, and are closed later."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

from ringdic.session.writer import CaptureWriter

from ringdic_controller.rig.rounds import capture_event

log = logging.getLogger(__name__)


class UnclosedCaptures:
    """Captures whose record is still to be closed.

    on_event : called with `capture_event`, with no lock held, when a record has been closed.
    """

    def __init__(self, on_event: Callable[[dict[str, Any]], None]) -> None:
        self._on_event = on_event
        self._lock = threading.Lock()  # guards the list
        self._waiting: list[tuple[CaptureWriter, Mapping[str, str]]] = []

    def add(self, writer: CaptureWriter, reasons: Mapping[str, str]) -> None:
        """Add a capture. reasons : by camera, why it has no image."""
        with self._lock:
            self._waiting.append((writer, reasons))

    def close(self) -> None:
        """Close all records that the disk takes."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
        for writer, reasons in waiting:
            try:
                record = writer.close(reasons)
            except OSError as error:
                log.error("the record of capture %s is still open: %s", writer.capture_id, error)
                self.add(writer, reasons)
            except ValueError as error:
                log.error("the record of capture %s stays open: %s", writer.capture_id, error)
            else:
                log.info("the record of capture %s is closed at last", writer.capture_id)
                self._on_event(capture_event(record))
