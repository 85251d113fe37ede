"""Timed sequences of captures: so many rounds, one every so many seconds, or as fast as rounds go (a burst)."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import Event, Lock, Thread
from typing import Any

from ringdic.errors import InputError

from ringdic_controller.service.refusals import NotFoundError, RefusedError
from ringdic_controller.service.rounds import Rounds

logger = logging.getLogger(__name__)

MOST_ROUNDS = 10_000
LONGEST_PAUSE = 86_400.0  # seconds


@dataclass(frozen=True)
class Timetable:
    """When the rounds of a sequence are due, on a clock that nobody sets: round k at `begin` + k · `every`, seconds.

    A round may begin late, until the next one is due; then it is skipped, so that no round shifts those after it.
    """

    begin: float
    every: float
    count: int

    def due(self, number: int) -> float:
        """Moment at which a round is due, seconds. number : from 0."""
        return self.begin + number * self.every

    def next_round(self, number: int, now: float) -> int:
        """The first round from `number` on that may still begin at a moment; `count` where there is none."""
        if self.every <= 0:
            return min(number, self.count)
        return min(max(number, math.floor((now - self.begin) / self.every)), self.count)


@dataclass(frozen=True)
class MissedRound:
    """A round of a sequence without a capture. number : from 1. reason : why, as a sentence."""

    number: int
    reason: str


@dataclass(frozen=True)
class CaptureSequence:
    """One sequence: ``state`` is running, ended or cancelled.

    every_s : seconds from one round to the next; 0 for a burst. captures : ids of those that have closed. missed :
    the rounds that were skipped or refused.
    """

    id: str
    session: str
    kind: str
    count: int
    every_s: float
    override: bool
    state: str = "running"
    captures: tuple[str, ...] = ()
    missed: tuple[MissedRound, ...] = ()


class Sequences:
    """All sequences since the controller started, of which at most the newest is running.

    Safe to use from several threads. `on_change` is called with no lock held.

    Parameters
    ----------
    rounds
        Takes the captures; no others are taken while a sequence is running.
    on_change
        Called with the sequence after each of its changes.
    clock, wait
        Seconds on a clock that nobody sets; and a wait for an event, at most so many seconds, that returns whether it
        was set.
    """

    def __init__(
        self,
        rounds: Rounds,
        on_change: Callable[[CaptureSequence], None],
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[Event, float], bool] = Event.wait,
    ) -> None:
        self._rounds = rounds
        self._on_change = on_change
        self._clock = clock
        self._wait = wait
        self._lock = Lock()  # guards the two below
        self._sequences: dict[str, CaptureSequence] = {}  # oldest first
        self._cancelled: dict[str, Event] = {}  # of those that are running

    def get(self, sequence_id: str) -> CaptureSequence:
        """The sequence of this id. Raises NotFoundError."""
        with self._lock:
            if sequence_id not in self._sequences:
                raise NotFoundError(f"There is no sequence '{sequence_id}'.")
            return self._sequences[sequence_id]

    def newest(self) -> CaptureSequence | None:
        """The sequence that began last, running or not; None before the first."""
        with self._lock:
            return next(reversed(self._sequences.values()), None)

    def begin(self, kind: str, count: int, every_s: float, *, override: bool = False) -> CaptureSequence:
        """Begin a sequence of captures in the current session; its first round is due at once.

        Parameters
        ----------
        kind
            One of `ringdic.session.names.CAPTURE_KINDS`.
        count
            Number of rounds, 1 to 10,000.
        every_s
            Seconds from one round to the next, at most a day; 0 for a burst.
        override
            Capture although nodes are missing or cameras not armed.

        Raises RefusedError while a capture or a sequence is under way, or if nothing can be captured now; InputError
        for an unknown kind and numbers out of range.
        """
        if not 1 <= count <= MOST_ROUNDS:
            raise InputError(f"a sequence has 1 to {MOST_ROUNDS} rounds, not {count}")
        if not 0 <= every_s <= LONGEST_PAUSE:
            raise InputError(f"the rounds of a sequence are 0 to {LONGEST_PAUSE:g} s apart, not {every_s:g}")
        session = self._rounds.reserve(kind, override=override)
        with self._lock:
            new = CaptureSequence(f"s{1 + len(self._sequences)}", session, kind, count, every_s, override)
            self._sequences[new.id] = new
            self._cancelled[new.id] = Event()
        self._on_change(new)
        Thread(target=self._run, args=(new,), name=f"sequence-{new.id}", daemon=True).start()
        return new

    def cancel(self, sequence_id: str) -> CaptureSequence:
        """Begin no further round of a sequence; one that is under way goes to its end. Raises NotFoundError."""
        found = self.get(sequence_id)
        with self._lock:
            cancelled = self._cancelled.get(sequence_id)
        if cancelled is not None:
            cancelled.set()
        return found

    def close(self) -> None:
        """Begin no further rounds."""
        with self._lock:
            running = tuple(self._cancelled.values())
        for cancelled in running:
            cancelled.set()

    def _run(self, new: CaptureSequence) -> None:
        """Take the rounds of a new sequence, each when it is due."""
        with self._lock:
            cancelled = self._cancelled[new.id]
        state = "ended"
        try:
            table = Timetable(self._clock(), new.every_s, new.count)
            number = 0
            while number < new.count and state == "ended":
                if self._wait(cancelled, max(0.0, table.due(number) - self._clock())):
                    state = "cancelled"
                elif not self._take(new, number) and new.every_s == 0:
                    break  # the others of a burst would be refused as well, at once
                else:
                    number = self._skip(new, table, number + 1)
        finally:
            self._rounds.release()
            with self._lock:
                del self._cancelled[new.id]
            self._change(new.id, state=state)

    def _take(self, new: CaptureSequence, number: int) -> bool:
        """Take one round to its end; whether it has brought a capture. number : from 0."""
        try:
            taken = self._rounds.take_reserved(new.session, new.kind, override=new.override, sequence=new.id)
        except RefusedError as error:
            capture_id, reason = None, str(error)
        except Exception:
            logger.exception("round %d of sequence %s failed", number + 1, new.id)
            capture_id, reason = None, "The capture failed; see the controller's log."
        else:
            capture_id = taken.capture_id if taken.state == "closed" else None
            reason = taken.error or ""
        if capture_id is None:
            self._miss(new.id, MissedRound(number + 1, reason))
            return False
        self._change(new.id, captures=(*self.get(new.id).captures, capture_id))
        return True

    def _skip(self, new: CaptureSequence, table: Timetable, number: int) -> int:
        """The number of the round that may begin next; those before it are noted as skipped. number : from 0."""
        now = self._clock()
        following = table.next_round(number, now)
        reasons = [
            MissedRound(
                skipped + 1,
                f"Round {skipped + 1} was skipped: the one before it closed {now - table.due(skipped):.1f} s after "
                f"this one was due, and the rounds are {new.every_s:g} s apart.",
            )
            for skipped in range(number, following)
        ]
        self._miss(new.id, *reasons)
        return following

    def _miss(self, sequence_id: str, *missed: MissedRound) -> None:
        if missed:
            self._change(sequence_id, missed=(*self.get(sequence_id).missed, *missed))

    def _change(self, sequence_id: str, **changes: Any) -> None:
        with self._lock:
            changed = self._sequences[sequence_id] = replace(self._sequences[sequence_id], **changes)
        self._on_change(changed)
