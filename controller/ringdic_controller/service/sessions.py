"""Sessions as the operator sees them: list, selection, creation, newest live step."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from threading import Lock
from typing import Any, Protocol

from ringdic.session.writer import CaptureWriter

from ringdic_controller.archive.catalogue import Catalogue
from ringdic_controller.service.refusals import NotFoundError, RefusedError


class SessionArchive(Protocol):
    """Where sessions are created and written: `ringdic.session.writer.Archive`."""

    def create_session(self, name: str, rig_toml: str) -> Any:
        """Create a session folder and return its writer. Raises InputError if the name is unusable or taken."""

    def open(self, name: str) -> Any:
        """The writer of an existing session. Raises InputError if there is none."""

    def capture(self, session: str, capture_id: str) -> CaptureWriter | None:
        """The writer of a capture; None if there is none of these names."""


class Sessions:
    """Sessions of the catalogue, and the selection among them; safe to use from several threads.

    Parameters
    ----------
    catalogue
        Lists the session folders.
    rig_toml
        Rig of new sessions as TOML text; without it none can be created.
    clock
        The present time, which names a session that is given no name.
    """

    def __init__(self, catalogue: Catalogue, rig_toml: str | None, clock: Callable[[], datetime]) -> None:
        self._catalogue = catalogue
        self._rig_toml = rig_toml
        self._clock = clock
        self._lock = Lock()  # guards the selection
        self._selection: str | None = None
        self.archive: SessionArchive | None = None  # replaced as a whole when it is connected: needs no lock

    def summaries(self) -> list[dict[str, Any]]:
        """One dictionary for each session, newest first, after new and changed folders have been read."""
        self._catalogue.sync()
        return self._catalogue.sessions()

    def summary(self, name: str) -> dict[str, Any]:
        """One session of the catalogue as a dictionary. Raises NotFoundError."""
        try:
            return self._catalogue.session(name)
        except KeyError as error:
            raise NotFoundError(f"There is no session '{name}'.") from error

    def current(self) -> str | None:
        """Name of the session that captures go to: the selected one, else the newest; None if there is no session.

        A session whose ``session.json`` is damaged is not taken by itself.
        """
        with self._lock:
            selection = self._selection
        names = [session["name"] for session in self._catalogue.sessions() if session["rig"] is not None]
        return selection if selection in names else (names[0] if names else None)

    def select(self, name: str) -> None:
        """Send captures to this session from now on, for as long as it exists."""
        with self._lock:
            self._selection = name

    def create(self, name: str | None) -> str:
        """Create a session and return its name, which is the time if none is given.

        Raises RefusedError if the name is taken or the controller has no rig, InputError if the name is unusable.
        """
        if self.archive is None or self._rig_toml is None:
            raise RefusedError("The controller runs without a rig.toml: it cannot make a session.")
        name = name or self._clock().strftime("%Y-%m-%d-%H%M%S")
        if name in [session["name"] for session in self.summaries()]:
            raise RefusedError(f"There is a session '{name}' already; choose another name.")
        self.archive.create_session(name, self._rig_toml)
        self._catalogue.refresh(name)
        return name

    def writer(self, session: str, capture_id: str) -> CaptureWriter:
        """The writer of an archived capture. Raises NotFoundError, or RefusedError where the archive is only shown."""
        try:
            self._catalogue.capture(session, capture_id)
            inside = self._catalogue.file(session, "captures", capture_id, "capture.json") is not None
        except KeyError as error:
            raise no_capture(session, capture_id) from error
        if not inside:
            raise no_capture(session, capture_id)
        if self.archive is None:
            raise RefusedError("The controller only shows this archive, and changes nothing in it.")
        writer = self.archive.capture(session, capture_id)
        if writer is None:
            raise no_capture(session, capture_id)
        return writer

    def newest_step(self, session: str) -> dict[str, Any] | None:
        """The newest live step of a session: capture_id, archived_at, ready_at and the seconds between, or None.

        A live step is a specimen capture that was processed alone as soon as its images were archived.
        """
        for folder in reversed(self._catalogue.live_steps(session)):
            try:
                ready = datetime.fromtimestamp((folder / "results.h5").stat().st_mtime, UTC)
                archived_at = self._catalogue.capture(session, folder.name).get("closed_at")
            except (OSError, KeyError):  # it is being replaced, or its capture was taken away
                continue
            try:
                seconds = (ready - datetime.fromisoformat(archived_at)).total_seconds() if archived_at else None
            except (ValueError, TypeError):  # a record of another program: no time, or one without its zone
                seconds = None
            return {
                "session": session,
                "capture_id": folder.name,
                "archived_at": archived_at,
                "ready_at": ready.isoformat(timespec="milliseconds"),
                "seconds": None if seconds is None else round(seconds, 3),
            }
        return None


def no_capture(session: str, capture_id: str) -> NotFoundError:
    """The refusal of a request that names a capture which is not in its session."""
    return NotFoundError(f"Session '{session}' has no capture '{capture_id}'.")
