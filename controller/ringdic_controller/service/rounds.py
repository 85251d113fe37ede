"""Capture rounds as the operator sees them: one press of the capture button, from arming to the close."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from threading import Lock, Thread
from typing import Any

from ringdic.errors import InputError
from ringdic.session.names import CAPTURE_KINDS

from ringdic_controller.service.refusals import NotFoundError, RefusedError, disk_sentence
from ringdic_controller.service.roster import NodeRoster
from ringdic_controller.service.sessions import Sessions

logger = logging.getLogger(__name__)

_UNDER_WAY = "A capture is under way; wait until it has closed."
_RESERVED = "A sequence of captures is under way; wait until it has ended, or cancel it."


@dataclass(frozen=True)
class Round:
    """One capture round: ``state`` is arming, open (the capture's record exists), closed or refused.

    sequence : id of the sequence that it belongs to.
    """

    id: str
    session: str
    kind: str
    override: bool
    state: str = "arming"
    capture_id: str | None = None
    error: str | None = None
    sequence: str | None = None

    @property
    def ended(self) -> bool:
        """Whether the round has reached a final state."""
        return self.state in ("closed", "refused")


class Rounds:
    """All capture rounds since the controller started, of which at most the newest is under way.

    Safe to use from several threads. Both callbacks are called with no lock held.

    Parameters
    ----------
    sessions, roster
        Where captures go to, and the cameras that take them.
    on_change
        Called with the round after each of its changes, from several threads.
    on_archived
        Called with the round and the capture's id once the capture has closed, before the round does.
    """

    def __init__(
        self,
        sessions: Sessions,
        roster: NodeRoster,
        on_change: Callable[[Round], None],
        on_archived: Callable[[Round, str], None],
    ) -> None:
        self._sessions = sessions
        self._roster = roster
        self._on_change = on_change
        self._on_archived = on_archived
        self._lock = Lock()  # guards the three below
        self._reserved = False  # by a sequence, which alone captures then
        self._rounds: dict[str, Round] = {}  # oldest first
        self._left_open: list[tuple[str, str]] = []  # session and id of captures whose record could not be closed

    def get(self, round_id: str) -> Round:
        """The round of this id. Raises NotFoundError."""
        with self._lock:
            if round_id not in self._rounds:
                raise NotFoundError(f"There is no capture round '{round_id}'.")
            return self._rounds[round_id]

    def newest(self) -> Round | None:
        """The round that began last, ended or not; None before the first."""
        with self._lock:
            return self._newest()

    def running(self) -> Round | None:
        """The round that is under way, if there is one."""
        with self._lock:
            return self._running()

    def refusal(self) -> str | None:
        """One sentence that says why no capture can begin now; None if one can."""
        if self._roster.nodes is None or self._roster.rig is None:
            return "The controller runs without a rig: it shows sessions but cannot capture."
        if self.running() is not None:
            return _UNDER_WAY
        if self.reserved():
            return _RESERVED
        if self._sessions.current() is None:
            return "There is no session yet; create one first."
        return None

    def begin(self, kind: str, *, override: bool = False) -> Round:
        """Begin a capture in the current session; it goes on in a thread of its own.

        Parameters
        ----------
        kind
            One of `CAPTURE_KINDS`.
        override
            Capture although nodes are missing or cameras not armed.

        Raises RefusedError if nothing can be captured now, InputError for an unknown kind.
        """
        session = self._checked(kind, override)
        new = self._new(session, kind, override, None)
        Thread(target=self._capture, args=(new,), name=f"capture-{new.id}", daemon=True).start()
        return new

    def reserve(self, kind: str, *, override: bool = False) -> str:
        """Reserve all captures for a sequence, until `release`; returns the session that they go to.

        Refused as `begin` is, and while another sequence is under way.
        """
        session = self._checked(kind, override)
        with self._lock:
            self._refuse_second(False)
            self._reserved = True
        return session

    def reserved(self) -> bool:
        """Whether a sequence has reserved all captures."""
        with self._lock:
            return self._reserved

    def release(self) -> None:
        """Let others capture again, after a sequence."""
        with self._lock:
            self._reserved = False

    def take_reserved(self, session: str, kind: str, *, override: bool, sequence: str) -> Round:
        """Take a capture of the sequence that has reserved them; blocks to the round's end, and returns it.

        Raises RefusedError where a camera is missing, unless `override`.
        """
        self._refuse_missing(override)
        new = self._new(session, kind, override, sequence)
        self._capture(new)
        return self.get(new.id)

    def _checked(self, kind: str, override: bool) -> str:
        """The session that a capture can go to now. Raises RefusedError or InputError."""
        if kind not in CAPTURE_KINDS:
            raise InputError(f"'{kind}' is no kind of capture; use {', '.join(CAPTURE_KINDS)}")
        refusal = self.refusal()
        if refusal:
            raise RefusedError(refusal)
        self._refuse_missing(override)
        session = self._sessions.current()
        if session is None:  # it was taken away meanwhile
            raise RefusedError("There is no session yet; create one first.")
        return session

    def _refuse_missing(self, override: bool) -> None:
        missing = self._roster.missing()
        if missing and not override:
            raise RefusedError(
                f"Camera {missing[0]} is not connected; start its node, or capture without it."
                if len(missing) == 1
                else f"Cameras {', '.join(missing)} are not connected; start their nodes, or capture without them."
            )

    def _new(self, session: str, kind: str, override: bool, sequence: str | None) -> Round:
        """A new round that is under way. Raises RefusedError where another is, or a sequence has reserved them."""
        with self._lock:
            self._refuse_second(sequence is not None)
            new = Round(f"r{1 + len(self._rounds)}", session, kind, override, sequence=sequence)
            self._rounds[new.id] = new
        self._on_change(new)
        return new

    def note_open(self, session: str, capture_id: str) -> None:
        """Note that a capture is open in a session; it is the capture of the running round."""
        running = self.running()
        if running is not None and running.state == "arming" and running.session == session:
            self._change(running.id, state="open", capture_id=capture_id)

    def _capture(self, new: Round) -> None:
        """Take the capture of a new round, to the round's end."""
        assert self._roster.nodes is not None
        assert self._sessions.archive is not None
        try:
            writer = self._sessions.archive.open(new.session)
            record = self._roster.nodes.capture(writer, new.kind, override=new.override)
        except OSError as error:
            logger.error("capture %s was broken off: %s", new.id, error)
            self._note_broken_off(new, disk_sentence(error))
            return
        except (RuntimeError, ValueError) as error:
            logger.warning("capture %s was not taken: %s", new.id, error)
            self._change(new.id, state="refused", error=str(error))
            return
        except BaseException as error:
            sentence = f"The capture failed: {error!r}; see the controller's log."
            self._change(new.id, state="refused", error=sentence)
            raise
        try:
            self._on_archived(new, record.capture_id)
        except OSError as error:
            logger.error("the processing of capture %s cannot be queued: %s", record.capture_id, error)
        finally:  # whatever became of its processing, the capture has closed
            self._change(new.id, state="closed", capture_id=record.capture_id)

    def note_left_open(self, captures: Iterable[tuple[str, str]]) -> None:
        """Note captures that an earlier controller left open, by session and capture id."""
        with self._lock:
            self._left_open.extend(captures)

    def close_left_open(self) -> list[tuple[str, str]]:
        """Close the captures whose record a disk did not take when their round ended, if it takes it now.

        Their images, which stay with the nodes until then, are archived afterwards. Returns session and capture id of
        each that has been closed.
        """
        with self._lock:
            waiting = list(self._left_open) if self._running() is None else []
        closed = []
        for session, capture_id in waiting:
            try:
                self._close(session, capture_id)
            except OSError as error:
                logger.warning("capture %s of session %s is still open: %s", capture_id, session, error)
                continue
            except ValueError as error:  # its record is damaged meanwhile, or its session was taken away
                logger.error("capture %s of session %s is left as it is: %s", capture_id, session, error)
            else:
                closed.append((session, capture_id))
            with self._lock:
                self._left_open.remove((session, capture_id))
        return closed

    def _close(self, session: str, capture_id: str) -> None:
        assert self._sessions.archive is not None
        capture = self._sessions.archive.open(session).capture(capture_id)
        record = capture.record()
        if record.state == "open":
            reason = "the archive could not be written when the capture ended"
            capture.close({camera: reason for camera, entry in record.cameras.items() if entry.status == "pending"})

    def _note_broken_off(self, new: Round, sentence: str) -> None:
        """End a round that the disk broke off, and remember its capture, if its record is there."""
        with self._lock:
            capture_id = self._rounds[new.id].capture_id
            if capture_id is not None:
                self._left_open.append((new.session, capture_id))
        self._change(new.id, state="refused", error=sentence)

    def _change(self, round_id: str, **changes: Any) -> None:
        """Change a round, unless it has ended."""
        with self._lock:
            if self._rounds[round_id].ended:
                return
            changed = self._rounds[round_id] = replace(self._rounds[round_id], **changes)
        self._on_change(changed)

    # With the lock held

    def _newest(self) -> Round | None:
        return next(reversed(self._rounds.values()), None)

    def _running(self) -> Round | None:
        newest = self._newest()
        return None if newest is None or newest.ended else newest

    def _refuse_second(self, of_sequence: bool) -> None:
        if self._running() is not None:
            raise RefusedError(_UNDER_WAY)
        if self._reserved and not of_sequence:
            raise RefusedError(_RESERVED)
