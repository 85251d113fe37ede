"""Processing of sessions: automatic after a capture of the specimen, or when the operator asks for it."""

from __future__ import annotations

from ringdic_controller.archive.catalogue import Catalogue
from ringdic_controller.jobs.jobs import Job, Jobs
from ringdic_controller.service.refusals import RefusedError
from ringdic_controller.service.sessions import Sessions


class SessionProcessing:
    """Decides which jobs a capture or a request leads to, and queues them. Has no state that would need a lock.

    Parameters
    ----------
    sessions, catalogue
        The sessions and what they hold.
    jobs
        The queue.
    live
        Whether each specimen capture is also processed alone as soon as it is archived, if the processing can do that.
    quiet
        Seconds without a capture after which the whole session is processed, if steps are processed alone.
    """

    def __init__(self, sessions: Sessions, catalogue: Catalogue, jobs: Jobs, live: bool, quiet: float) -> None:
        self._sessions = sessions
        self._catalogue = catalogue
        self._jobs = jobs
        self._live = live and jobs.processing.live
        self.quiet = quiet

    def submit(self, session: str) -> Job:
        """Queue the processing of a whole session.

        Raises NotFoundError if there is no such session, RefusedError if it lacks captures that processing needs.
        """
        self._catalogue.sync()
        self._sessions.summary(session)
        self._catalogue.refresh(session)
        lacking = self._lacking(session)
        if lacking:
            raise RefusedError(f"Session '{session}' cannot be processed yet: it has {lacking}.")
        return self._jobs.submit(session, self._catalogue.path(session), reason="asked for")

    def submit_step(self, session: str, capture_id: str) -> None:
        """Queue the processing that follows a specimen capture: of its step at once, of the session after a pause.

        The reference capture is processed alone, too, so that what the later steps are compared with is cached.
        """
        path, after = self._catalogue.path(session), 0.0
        if self._live and not self._uncalibrated(session):
            self._jobs.submit(session, path, reason=capture_id, automatic=True, step=capture_id)
            after = self.quiet
        if not self._lacking(session):
            self._jobs.submit(session, path, reason=capture_id, automatic=True, after=after)

    def _uncalibrated(self, session: str) -> list[str]:
        """What a session still needs to be calibrated, in words."""
        counts = self._sessions.summary(session)["captures"]
        return [f"no {kind} capture" for kind in ("board", "target") if not counts.get(kind)]

    def _lacking(self, session: str) -> str | None:
        """What a session still needs to be processed, in words; None if nothing."""
        lacking = self._uncalibrated(session)
        specimens = self._sessions.summary(session)["captures"].get("specimen", 0)
        if specimens == 0:
            lacking.append("no specimen capture")
        elif specimens == 1:
            lacking.append("only the reference specimen capture")
        return " and ".join(lacking) or None
