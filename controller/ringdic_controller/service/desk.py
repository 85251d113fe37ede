"""The operator's desk: everything that can be asked of the controller, without HTTP."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any, Protocol

from ringdic.errors import InputError
from ringdic.session.names import CAPTURE_KINDS
from ringdic.session.records import CaptureRecord
from ringdic.session.rig import Rig, parse_rig

from ringdic_controller.archive.catalogue import Catalogue
from ringdic_controller.jobs.children import Command, Processing
from ringdic_controller.jobs.jobs import Job, Jobs
from ringdic_controller.service.events import Live

logger = logging.getLogger(__name__)


class Ring(Protocol):
    """The nodes, as the desk needs them: `ringdic_controller.rig.link.RigLink`, or a stand-in."""

    def roster(self) -> list[dict[str, Any]]:
        """One dictionary a camera: id, alive, state, armed, spool_free, spool_images, versions, …"""

    def capture(self, session: Any, kind: str, *, override: bool = False) -> CaptureRecord:
        """Capture with every camera and archive it; blocks to the end; the record."""


class Sessions(Protocol):
    """The archive, as the desk needs it: `ringdic.session.writer.Archive`."""

    def create_session(self, name: str, rig_toml: str) -> Any:
        """A new session folder; InputError if the name is unusable or taken."""

    def open(self, name: str) -> Any:
        """The writer of an existing session."""


class RefusedError(Exception):
    """What was asked for cannot be done as things stand; the sentence says why. Nothing has changed."""


class NotFoundError(Exception):
    """There is no session, capture, job or result of this name."""


@dataclass(frozen=True)
class Round:
    """One press of a capture button, from arming to the close."""

    id: str
    session: str
    kind: str
    override: bool
    state: str = "arming"  # arming, open, closed, refused
    capture_id: str | None = None
    error: str | None = None

    @property
    def ended(self) -> bool:
        """Nothing about it will change any more."""
        return self.state in ("closed", "refused")


class Desk:
    """Sessions, captures, jobs and live state in one place; safe to use from several threads.

    Parameters
    ----------
    root
        The archive's folder.
    processing
        What carries out the jobs; or from a session folder to the command line that processes it.
    rig_toml
        The rig as text; without it no session can be made and nothing captured.
    clock
        The present time.

    watch
        Seconds between two looks at the folders for what other programs have put there.
    live
        Whether each step is processed at once, and shown, if the processing can do that.
    quiet
        Seconds without a capture after which the whole session is then processed.

    `connect` adds the archive and the nodes; until then the desk only shows.
    """

    def __init__(
        self,
        root: Path,
        processing: Command | Processing,
        rig_toml: str | None = None,
        clock: Callable[[], datetime] = lambda: datetime.now(UTC),
        watch: float = 3.0,
        live: bool = True,
        quiet: float = 15.0,
    ) -> None:
        self.root = Path(root)
        self.root.mkdir(parents=True, exist_ok=True)
        self.rig_toml = rig_toml
        self.rig: Rig | None = parse_rig(rig_toml) if rig_toml else None
        self.live = Live(self.snapshot)
        self.catalogue = Catalogue(self.root)
        self.jobs = Jobs(self.root / ".jobs", processing, self._job_changed)
        self.jobs.processing.on_change = self._publish_processing
        self._archive: Sessions | None = None
        self._ring: Ring | None = None
        self._clock = clock
        self._live = live and self.jobs.processing.live
        self.quiet = quiet
        self._lock = Lock()
        self._publishing = Lock()
        self._telling = Lock()
        self._selected: str | None = None
        self._rounds: dict[str, Round] = {}
        self._running: str | None = None
        self._closing = Event()
        self._watcher = Thread(target=self._watch, args=(watch,), name="folders", daemon=True)
        self._watcher.start()

    def connect(self, archive: Sessions | None, ring: Ring | None) -> None:
        """Use this archive and these nodes from now on."""
        self._archive, self._ring = archive, ring
        if ring is not None:
            self.jobs.processing.warm()
        self.live.publish_snapshot()

    def close(self) -> None:
        """Stop the jobs and the watch over the folders."""
        self._closing.set()
        self.jobs.close()
        self._watcher.join(5)

    # What is -------------------------------------------------------------------------------------

    def roster(self) -> list[dict[str, Any]]:
        """Every camera of the rig in ring order, with its node's state and its nominal azimuth."""
        seen = {node["id"]: node for node in self._ring.roster()} if self._ring else {}
        if self.rig is None:
            return list(seen.values())
        unknown = {"alive": False, "armed": False, "state": "unknown"}
        return [
            {**unknown, **seen.get(camera.id, {}), "id": camera.id, "azimuth_deg": camera.azimuth_deg}
            for camera in self.rig.cameras
        ]

    def current(self) -> str | None:
        """The session that captures go to: the one selected, or else the newest."""
        with self._lock:
            selected = self._selected
        names = [session["name"] for session in self.catalogue.sessions()]
        return selected if selected in names else (names[0] if names else None)

    def sessions(self) -> list[dict[str, Any]]:
        """All sessions, newest first; the folders are looked at anew."""
        self.catalogue.sync()
        return self.catalogue.sessions()

    def round(self, round_id: str) -> Round:
        """One round."""
        with self._lock:
            if round_id not in self._rounds:
                raise NotFoundError(f"There is no capture round '{round_id}'.")
            return self._rounds[round_id]

    def why_no_capture(self) -> str | None:
        """Why a capture button would be refused now; None if it would not."""
        if self._ring is None or self.rig is None:
            return "The controller runs without a rig: it shows sessions but cannot capture."
        with self._lock:
            if self._running is not None:
                return "A capture is under way; wait until it has closed."
        if self.current() is None:
            return "There is no session yet; create one first."
        return None

    def missing_nodes(self) -> list[str]:
        """Cameras whose node is not there."""
        return [node["id"] for node in self.roster() if not node.get("alive")]

    def snapshot(self) -> dict[str, Any]:
        """The whole live state."""
        sessions = self.sessions()
        current = self.current()
        with self._lock:
            newest = next(reversed(self._rounds.values()), None)  # running or not: how it ended stays to be read
        return {
            "rig": self.rig_state(),
            "sessions": sessions,
            "current": current,
            "captures": self.catalogue.captures(current) if current else [],
            "runs": self.catalogue.runs(current) if current else [],
            "newest": self.newest_step(current) if current else None,
            "processing": asdict(self.jobs.processing.warmth),
            "jobs": [asdict(job) for job in self.jobs.list()[:20]],
            "round": None if newest is None else asdict(newest),
        }

    def rig_state(self) -> dict[str, Any]:
        """The rig's name, its nodes, and whether a capture can be taken."""
        return {
            "name": self.rig.name if self.rig else None,
            "connected": self._ring is not None,
            "nodes": self.roster(),
            "missing": self.missing_nodes(),
            "refusal": self.why_no_capture(),
        }

    def newest_step(self, session: str) -> dict[str, Any] | None:
        """The newest step that was processed at once: its capture, when its images were there, when its results."""
        for folder in reversed(self.catalogue.live(session)):
            try:
                ready = datetime.fromtimestamp((folder / "results.h5").stat().st_mtime, UTC)
                archived_at = self.catalogue.capture(session, folder.name).get("closed_at")
            except (FileNotFoundError, KeyError):  # it is being replaced, or its capture was taken away
                continue
            seconds = (ready - datetime.fromisoformat(archived_at)).total_seconds() if archived_at else None
            return {
                "session": session,
                "capture_id": folder.name,
                "archived_at": archived_at,
                "ready_at": ready.isoformat(timespec="milliseconds"),
                "seconds": None if seconds is None else round(seconds, 3),
            }
        return None

    # What can be done ----------------------------------------------------------------------------

    def create_session(self, name: str | None = None) -> dict[str, Any]:
        """Make a session and select it; without a name it is called by the time."""
        if self._archive is None or self.rig_toml is None:
            raise RefusedError("The controller runs without a rig.toml: it cannot make a session.")
        name = name or self._clock().strftime("%Y-%m-%d-%H%M%S")
        if name in [session["name"] for session in self.sessions()]:
            raise RefusedError(f"There is a session '{name}' already; choose another name.")
        self._archive.create_session(name, self.rig_toml)
        self.catalogue.refresh(name)
        return self.select_session(name)

    def select_session(self, name: str) -> dict[str, Any]:
        """Send captures to this session from now on."""
        self.catalogue.sync()
        session = self.session(name)
        with self._lock:
            if self._running is not None and self._rounds[self._running].session != name:
                raise RefusedError("A capture is under way; choose another session when it has closed.")
            self._selected = name
        self.live.publish_snapshot()
        return session

    def session(self, name: str) -> dict[str, Any]:
        """One session."""
        try:
            return self.catalogue.session(name)
        except KeyError as error:
            raise NotFoundError(f"There is no session '{name}'.") from error

    def capture(self, kind: str, *, override: bool = False) -> Round:
        """Begin a capture in the current session; it goes on in a thread. RefusedError says why not."""
        if kind not in CAPTURE_KINDS:
            raise InputError(f"'{kind}' is no kind of capture; use {', '.join(CAPTURE_KINDS)}")
        refusal = self.why_no_capture()
        if refusal:
            raise RefusedError(refusal)
        missing = self.missing_nodes()
        if missing and not override:
            verb = "is" if len(missing) == 1 else "are"
            raise RefusedError(f"Camera {', '.join(missing)} {verb} not there; start the node, or capture without it.")
        session = self.current()
        assert session is not None
        with self._lock:
            if self._running is not None:
                raise RefusedError("A capture is under way; wait until it has closed.")
            started = Round(f"r{1 + len(self._rounds)}", session, kind, override)
            self._rounds[started.id] = started
            self._running = started.id
        self._change_round(started)
        Thread(target=self._capture, args=(started,), name=f"capture-{started.id}", daemon=True).start()
        return started

    def start_job(self, session: str) -> Job:
        """Queue the processing of a session by hand."""
        self.catalogue.sync()
        self.session(session)
        self.catalogue.refresh(session)
        lacking = self._lacking(session)
        if lacking:
            raise RefusedError(f"Session '{session}' cannot be processed yet: it has {lacking}.")
        return self.jobs.submit(session, self.catalogue.path(session), reason="asked for")

    # What happens --------------------------------------------------------------------------------

    def on_event(self, event: dict[str, Any]) -> None:
        """Told by the ring of nodes that come, go or change, and of captures as they evolve; from any thread."""
        if event.get("type") != "capture":
            self._publish_rig()
            return
        capture_id = event.get("capture_id")
        with self._lock:
            running = self._rounds[self._running] if self._running else None
        session = event.get("session") or (running.session if running else self.current())
        if session is None or capture_id is None:
            return
        if running and running.capture_id is None and session == running.session:
            known = {record["capture_id"] for record in self.catalogue.captures(session)}
            if capture_id not in known:  # the round's own; a late image of an earlier capture comes this way too
                self._change_round(running, state="open", capture_id=capture_id)
        self._publish_capture(session, capture_id)

    def _watch(self, interval: float) -> None:
        """Show sessions and runs that the command line makes while the controller is open."""
        while not self._closing.wait(interval):
            try:
                if self.catalogue.sync():
                    self.live.publish_snapshot()
            except OSError as error:  # a folder on a network drive may go and come back
                logger.warning("the archive's folder cannot be read: %s", error)

    def _capture(self, started: Round) -> None:
        assert self._ring is not None
        assert self._archive is not None
        try:
            record = self._ring.capture(self._archive.open(started.session), started.kind, override=started.override)
        except (RuntimeError, ValueError, OSError) as error:
            logger.warning("capture %s was not taken: %s", started.id, error)
            self._end_round(started, state="refused", error=str(error))
            return
        except BaseException as error:
            self._end_round(started, state="refused", error=f"The capture failed: {error!r}; see the controller's log.")
            raise
        self._publish_capture(started.session, record.capture_id)
        if started.kind == "specimen":
            self._process(started.session, record.capture_id)
        self._end_round(started, state="closed", capture_id=record.capture_id)

    def _process(self, session: str, capture_id: str) -> None:
        """Have a new step processed at once, and the whole session when no more follow soon.

        The reference alone is worth it too: what every step is compared with is then found and kept.
        """
        path, after = self.catalogue.path(session), 0.0
        if self._live and not self._uncalibrated(session):
            self.jobs.submit(session, path, reason=capture_id, automatic=True, step=capture_id)
            after = self.quiet
        if not self._lacking(session):
            self.jobs.submit(session, path, reason=capture_id, automatic=True, after=after)

    def _uncalibrated(self, session: str) -> list[str]:
        counts = self.catalogue.session(session)["captures"]
        return [f"no {kind} capture" for kind in ("board", "target") if not counts.get(kind)]

    def _lacking(self, session: str) -> str | None:
        """What a session still needs to be processed, in words."""
        counts = self.catalogue.session(session)["captures"]
        lacking = self._uncalibrated(session)
        specimens = counts.get("specimen", 0)
        if specimens == 0:
            lacking.append("no specimen capture")
        elif specimens == 1:
            lacking.append("only the reference specimen capture")
        return " and ".join(lacking) or None

    def _end_round(self, started: Round, **changes: Any) -> None:
        self._change_round(started, **changes)
        self._publish_sessions()

    def _change_round(self, which: Round, **changes: Any) -> None:
        """Changes of a round are told in the order in which they happen; one that has ended stays as it is."""
        with self._telling:
            with self._lock:
                if self._rounds[which.id].ended:
                    return
                changed = self._rounds[which.id] = replace(self._rounds[which.id], **changes)
                self._running = None if changed.ended else changed.id
            self.live.publish("round", asdict(changed))
        self._publish_rig()

    def _publish_rig(self) -> None:
        self.live.publish("rig", self.rig_state())

    def _publish_processing(self) -> None:
        self.live.publish("processing", asdict(self.jobs.processing.warmth))

    def _publish_sessions(self) -> None:
        self.live.publish("sessions", {"sessions": self.catalogue.sessions(), "current": self.current()})

    def _publish_capture(self, session: str, capture_id: str) -> None:
        with self._publishing:  # an older record must not be told after a newer one
            record = self.catalogue.refresh_capture(session, capture_id)
            if record is not None:  # else the round was refused before the archive made a folder
                self.live.publish("capture", {"session": session, "record": record})

    def _job_changed(self, job: Job) -> None:
        if job.state == "done" and job.step is not None:
            self.live.publish("newest", self.newest_step(job.session) or {})
        elif job.state == "done":
            self.catalogue.sync()
            self.catalogue.refresh(job.session)
            self.live.publish("runs", {"session": job.session, "runs": self.catalogue.runs(job.session)})
            self._publish_sessions()
        self.live.publish("job", asdict(job))
