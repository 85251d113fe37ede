"""The audit log: a line for each action that somebody asked of the controller, allowed or not."""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

log = logging.getLogger(__name__)

AUDIT_FILE = "audit.jsonl"
LONGEST_TEXT = 500  # characters kept of what the client sent


class AuditLog:
    """Appends lines of JSON to a file: when, who, in which role, from where, what, and with which outcome.

    Parameters
    ----------
    path
        The file; it is made with the first line, and only its owner and group may read it.
    clock
        The present time.
    """

    def __init__(self, path: Path, clock: Callable[[], datetime] = lambda: datetime.now(UTC)) -> None:
        self.path = Path(path)
        self._clock = clock
        self._lock = threading.Lock()

    def note(self, who: str, role: str, source: str, what: str, outcome: str, sent: str = "") -> None:
        """Append one line. A file that cannot be written is reported to the log, and stops nobody's work."""
        entry = {
            "when": self._clock().isoformat(timespec="milliseconds"),
            "who": who[:LONGEST_TEXT],
            "role": role,
            "from": source,
            "what": what[:LONGEST_TEXT],
            "sent": sent[:LONGEST_TEXT],
            "outcome": outcome,
        }
        line = json.dumps({name: value for name, value in entry.items() if value}) + "\n"
        try:
            with self._lock:
                descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o640)
                with os.fdopen(descriptor, "a", encoding="utf-8") as file:
                    file.write(line)
        except OSError as error:
            log.error("the audit log %s cannot be written (%s); it lacks: %s", self.path, error, line.rstrip())
