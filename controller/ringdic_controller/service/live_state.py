"""The state that the page shows: as a snapshot of everything, and as an event after every change."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict
from threading import Lock
from typing import Any

from ringdic_controller.archive.catalogue import Catalogue
from ringdic_controller.jobs.jobs import Job, Jobs
from ringdic_controller.service.events import EventStream
from ringdic_controller.service.roster import NodeRoster
from ringdic_controller.service.rounds import Rounds
from ringdic_controller.service.sequences import Sequences
from ringdic_controller.service.sessions import Sessions

logger = logging.getLogger(__name__)

_SHOWN_JOBS = 20


class LiveState:
    """Reads the state of all parts and publishes it to the followers of `events`.

    Every event holds the state as it is when the event is published, never the state that somebody read before: so
    several threads may announce changes at a time, and no older state is published after a newer one.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        roster: NodeRoster,
        sessions: Sessions,
        rounds: Rounds,
        sequences: Sequences,
        jobs: Jobs,
    ) -> None:
        self._catalogue = catalogue
        self._roster = roster
        self._sessions = sessions
        self._rounds = rounds
        self._sequences = sequences
        self._jobs = jobs
        self.events = EventStream(self.snapshot)
        self._lock = Lock()  # held while a part's state is read and published

    def snapshot(self) -> dict[str, Any]:
        """The whole state: rig, sessions, the current one with captures, runs and live step, jobs, round, sequence."""
        sessions = self._sessions.summaries()
        current = self._sessions.current()
        newest_sequence = self._sequences.newest()
        newest_round = self._rounds.newest()  # under way or not: how it ended stays to be read
        return {
            "rig": self.rig(),
            "sessions": sessions,
            "current": current,
            "captures": self._catalogue.captures(current) if current else [],
            "runs": self._catalogue.runs(current) if current else [],
            "newest": self._sessions.newest_step(current) if current else None,
            "processing": self._warmth(),
            "jobs": [asdict(job) for job in self._jobs.list()[:_SHOWN_JOBS]],
            "round": None if newest_round is None else asdict(newest_round),
            "sequence": None if newest_sequence is None else asdict(newest_sequence),
        }

    def rig(self) -> dict[str, Any]:
        """The rig's name, its cameras with their nodes, which are missing, and why no capture can be taken."""
        rig = self._roster.rig
        return {
            "name": rig.name if rig else None,
            "connected": self._roster.nodes is not None,
            "nodes": self._roster.cameras(),
            "missing": self._roster.missing(),
            "refusal": self._rounds.refusal(),
        }

    def publish_rig(self) -> None:
        """Publish the state of the rig and its nodes."""
        self._publish("rig", self.rig)

    def publish_processing(self) -> None:
        """Publish how ready the processing is."""
        self._publish("processing", self._warmth)

    def publish_sessions(self) -> None:
        """Publish the list of sessions and which of them captures go to."""
        self._publish("sessions", lambda: {"sessions": self._catalogue.sessions(), "current": self._sessions.current()})

    def publish_round(self, round_id: str) -> None:
        """Publish the state of a capture round."""
        self._publish("round", lambda: asdict(self._rounds.get(round_id)))

    def publish_sequence(self, sequence_id: str) -> None:
        """Publish the state of a sequence of captures."""
        self._publish("sequence", lambda: asdict(self._sequences.get(sequence_id)))

    def publish_capture(self, session: str, capture_id: str) -> None:
        """Publish a capture's record, read from its folder; do nothing if there is no folder yet."""

        def read() -> dict[str, Any] | None:
            record = self._catalogue.refresh_capture(session, capture_id)
            return None if record is None else {"session": session, "record": record}

        self._publish("capture", read)

    def publish_job(self, job: Job) -> None:
        """Publish a job and, before it, the results that it has written. Must be called in the order of the changes."""
        if job.state == "done" and job.step is not None:
            self._publish("newest", lambda: self._sessions.newest_step(job.session) or {})
        elif job.state == "done":
            try:
                self._catalogue.sync()
                self._catalogue.refresh(job.session)
            except OSError as error:  # a folder on a network drive may go and come back
                logger.warning("the results of job %s cannot be read: %s", job.id, error)
            self._publish("runs", lambda: {"session": job.session, "runs": self._catalogue.runs(job.session)})
            self.publish_sessions()
        self._publish("job", lambda: asdict(job))

    def _publish(self, name: str, read: Callable[[], dict[str, Any] | None]) -> None:
        with self._lock:
            payload = read()
            if payload is not None:
                self.events.publish(name, payload)

    def _warmth(self) -> dict[str, Any]:
        return asdict(self._jobs.processing.warmth)
