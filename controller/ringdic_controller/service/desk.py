"""The operator's desk: all that the controller does for an operator, joined in one object, without HTTP.

Locks. Each part has at most one, private to it, and they are taken in two storeys only::

    LiveState._lock        a part's state is read and published
        Sessions._lock     the selection
        Rounds._lock       the capture rounds
        Sequences._lock    the sequences of captures
        Catalogue._lock    the tables of sessions, captures and runs
        Jobs._lock         the queue of jobs
        EventStream._lock  the followers
        RigLink._lock      the nodes

With a lock of the lower storey held, no other lock is taken and no callback is called; that also goes for the locks
of the intake, of the archive and of the warm processing. The lock of the upper storey is taken only by threads that
hold none. Two threads can therefore not wait for each other's lock.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Thread
from typing import Any

from ringdic_controller.archive.catalogue import Catalogue
from ringdic_controller.jobs.children import Command, Processing
from ringdic_controller.jobs.jobs import Jobs
from ringdic_controller.service.live_state import LiveState
from ringdic_controller.service.processing import SessionProcessing
from ringdic_controller.service.refusals import RefusedError
from ringdic_controller.service.roster import CameraNodes, NodeRoster
from ringdic_controller.service.rounds import Round, Rounds
from ringdic_controller.service.sequences import CaptureSequence, Sequences
from ringdic_controller.service.sessions import SessionArchive, Sessions

logger = logging.getLogger(__name__)


class Desk:
    """Sessions, capture rounds, processing and live state of one archive; safe to use from several threads.

    Requests go to its parts: `sessions`, `rounds`, `sequences`, `processing`, `jobs`, `catalogue`, `roster`, `state`.
    The desk joins them: it creates and selects sessions with regard to the round or sequence under way, and passes
    every change on to whoever follows the state. Until `connect` has added the archive's writer and the nodes, it only
    shows.

    Parameters
    ----------
    root
        Folder of the archive; created if absent.
    processing
        Runs the jobs; or a function from a session folder to the command line of a child process for each job.
    rig_toml
        The rig as TOML text; without it no session can be created and nothing captured.
    clock
        The present time.
    watch
        Seconds between two looks for sessions and runs that other programs have put into the folder.
    live
        Whether each step is processed at once, where the processing can do that.
    quiet
        Seconds without a capture after which the whole session is then processed.
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
        root = Path(root)
        root.mkdir(parents=True, exist_ok=True)
        self.catalogue = Catalogue(root)
        self.roster = NodeRoster(rig_toml)
        self.sessions = Sessions(self.catalogue, rig_toml, clock)
        self.rounds = Rounds(self.sessions, self.roster, self._publish_round, self._publish_and_process_capture)
        self.sequences = Sequences(self.rounds, self._publish_sequence)
        self.jobs = Jobs(root / ".jobs", processing, lambda job: self.state.publish_job(job))
        self.processing = SessionProcessing(self.sessions, self.catalogue, self.jobs, live, quiet)
        self.state = LiveState(self.catalogue, self.roster, self.sessions, self.rounds, self.sequences, self.jobs)
        self.jobs.processing.on_change = self.state.publish_processing
        self._closing = Event()
        self._watcher = Thread(target=self._watch, args=(watch,), name="folders", daemon=True)
        self._watcher.start()

    def connect(self, archive: SessionArchive | None, nodes: CameraNodes | None) -> None:
        """Add the archive's writer and the nodes, so that sessions can be created and captured."""
        self.sessions.archive, self.roster.nodes = archive, nodes
        if nodes is not None:
            self.rounds.note_left_open(self.catalogue.open_captures())
            self.jobs.processing.warm()
        self.state.events.publish_snapshot()

    def close(self) -> None:
        """End the jobs and the watch over the folder."""
        self._closing.set()
        self.sequences.close()
        self.jobs.close()
        self._watcher.join(5)

    def create_session(self, name: str | None = None) -> dict[str, Any]:
        """Create a session, named by the time if no name is given, and select it; returns its summary.

        Raises RefusedError if the name is taken, the controller has no rig or a capture is under way; InputError if
        the name is unusable.
        """
        self._refuse_during_capture(None)
        return self.select_session(self.sessions.create(name))

    def select_session(self, name: str) -> dict[str, Any]:
        """Send captures to this session from now on; returns its summary.

        Raises NotFoundError if there is no such session, RefusedError while a capture is under way in another.
        """
        self.catalogue.sync()
        summary = self.sessions.summary(name)
        self._refuse_during_capture(name)
        self.sessions.select(name)
        self.state.events.publish_snapshot()
        return summary

    def on_event(self, event: dict[str, Any]) -> None:
        """Take an event of the rig, from any thread: a node has come, gone or changed, or a capture's record has."""
        if event.get("type") != "capture":
            self.state.publish_rig()
        elif event["capture_id"] is not None:  # None of a round that has no record yet
            if event["state"] == "open":  # else it is a late image of an earlier capture, or the close
                self.rounds.note_open(event["session"], event["capture_id"])
            self.state.publish_capture(event["session"], event["capture_id"])

    def _refuse_during_capture(self, session: str | None) -> None:
        """Raise RefusedError if a capture is under way in another session than this."""
        running = self.rounds.running()
        if running is not None and running.session != session:
            raise RefusedError("A capture is under way; choose another session when it has closed.")
        sequence = self.sequences.newest()
        if sequence is not None and sequence.state == "running" and sequence.session != session:
            raise RefusedError("A sequence of captures is under way; choose another session when it has ended.")

    def _publish_round(self, changed: Round) -> None:
        self.state.publish_round(changed.id)
        self.state.publish_rig()
        if changed.ended:
            self.state.publish_sessions()

    def _publish_sequence(self, changed: CaptureSequence) -> None:
        self.state.publish_sequence(changed.id)
        self.state.publish_rig()

    def _publish_and_process_capture(self, closed: Round, capture_id: str) -> None:
        self.state.publish_capture(closed.session, capture_id)
        if closed.kind == "specimen":
            self.processing.submit_step(closed.session, capture_id)

    def _watch(self, interval: float) -> None:
        """Show what other programs make while the controller is open; close captures that a full disk left open."""
        while not self._closing.wait(interval):
            try:
                for session, capture_id in self.rounds.close_left_open():
                    self.state.publish_capture(session, capture_id)
                if self.catalogue.sync():
                    self.state.events.publish_snapshot()
            except OSError as error:  # a folder on a network drive may go and come back
                logger.warning("the archive's folder cannot be read: %s", error)
            except Exception:  # the next look may do better, and there is nobody else who looks
                logger.exception("a look for changes in the archive failed")
