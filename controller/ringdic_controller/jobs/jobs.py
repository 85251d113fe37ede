"""Queue of processing jobs: one runs at a time, in a child process; its progress, outcome and log are recorded.

States of a job::

    queued → running → done | failed | cancelled
    queued → superseded (a newer capture of this session has a job) | cancelled
    running → queued (a whole session gives way to a single step; it resumes later from its cached results)

The child process prints JSON lines: progress ``{"stage", "done", "rate", "left_s", "message"}`` and at the end
``{"state": "done", "run", "summary"}``, ``{"state": "failed", "error"}`` or ``{"state": "stopped"}``. Every other
line goes to the log, and so does the start of every stage.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from shutil import rmtree
from threading import Condition, Thread
from typing import Any

from pydantic import TypeAdapter
from ringdic.findings import DO_NOT_USE_EXIT
from ringdic.session.json_text import read_json

from ringdic_controller.jobs.children import ChildPerJob, Command, Order, Processing, Work, message_of

logger = logging.getLogger(__name__)

FINISHED = ("done", "failed", "cancelled", "superseded")
_PROGRESS = ("stage", "done", "rate", "left_s", "message")
_PROGRESS_INTERVAL = 0.2  # seconds between two reports of progress within a stage


@dataclass(frozen=True)
class Job:
    """Processing of one session or, with ``step`` (a capture's id), of that step alone as soon as it is captured.

    ``done`` is the completed share of the work, 0 … 1; ``left_s`` the estimated remaining time, s, or None; ``run`` the
    number of the run that was written; ``reason`` the capture that caused the job, or "asked for".
    """

    id: str
    session: str
    reason: str
    automatic: bool
    created_at: str
    state: str = "queued"
    stage: str = ""
    done: float = 0.0
    rate: str = ""
    left_s: float | None = None
    message: str = ""
    error: str | None = None
    run: str | None = None
    started_at: str | None = None
    finished_at: str | None = None
    step: str | None = None

    @property
    def finished(self) -> bool:
        """Whether the job has reached a final state."""
        return self.state in FINISHED


_JOB = TypeAdapter(Job)


class Jobs:
    """Job queue with the thread that runs the jobs; safe to use from several threads.

    Single steps run before whole sessions, which give way to them; otherwise jobs run in the order of submission.

    Parameters
    ----------
    folder
        Receives a subfolder with record and log for each job.
    processing
        Runs the jobs; or a function from a session folder to the command line of a child process for each job.
    on_change
        Called with the job after every change, in the order of the changes, from one thread and with no lock held.
    """

    def __init__(
        self, folder: Path, processing: Command | Processing, on_change: Callable[[Job], None] = lambda _: None
    ) -> None:
        self._folder = Path(folder)
        self._processing: Processing = ChildPerJob(processing) if callable(processing) else processing
        self._on_change = on_change
        # Guards the attributes below and the job folders. Neither on_change nor the processing is called with it
        # held. Whoever waits for a change of the queue waits on it.
        self._lock = Condition()
        self._jobs: dict[str, Job] = {}
        self._paths: dict[str, Path] = {}
        self._last_id = 0
        self._due: dict[str, float] = {}  # earliest start of a queued job, s of the monotonic clock
        self._current_work: Work | None = None
        self._closing = False
        self._changes: SimpleQueue[Job | None] = SimpleQueue()  # filled with the lock held: in the order of the changes
        self._progress_time = 0.0  # of the last progress reported, s of the monotonic clock; the worker's alone
        self._load()
        self._worker = Thread(target=self._work, name="jobs", daemon=True)
        self._reporter = Thread(target=self._report, name="job-changes", daemon=True)
        self._worker.start()
        self._reporter.start()

    def close(self, timeout: float = 10.0) -> None:
        """Cancel the running job, end its child process and both threads; wait at most ``timeout`` s for each."""
        with self._lock:
            self._closing = True
            for job in [job for job in self._jobs.values() if job.state == "running"]:
                self._update(job.id, state="cancelled", finished_at=_now(), left_s=None)
            work = self._current_work
            self._lock.notify_all()
        self._processing.close()
        if work is not None:
            work.end()
        self._worker.join(timeout)
        self._changes.put(None)
        self._reporter.join(timeout)

    @property
    def processing(self) -> Processing:
        """The child processes that run the jobs."""
        return self._processing

    def list(self) -> list[Job]:
        """All jobs, newest first."""
        with self._lock:
            return sorted(self._jobs.values(), key=lambda job: job.id, reverse=True)

    def get(self, job_id: str) -> Job:
        """The job of this id. Raises KeyError if there is none."""
        with self._lock:
            return self._jobs[job_id]

    def log(self, job_id: str, limit: int = 256_000) -> str:
        """The last ``limit`` bytes of a job's log. Raises KeyError if there is no such job."""
        self.get(job_id)
        path = self._folder / job_id / "log.txt"
        try:
            with path.open("rb") as file:
                file.seek(max(0, path.stat().st_size - limit))
                return file.read().decode("utf-8", errors="replace")
        except FileNotFoundError:
            return ""

    def submit(
        self,
        session: str,
        path: Path,
        *,
        reason: str,
        automatic: bool = False,
        step: str | None = None,
        after: float = 0.0,
    ) -> Job:
        """Queue a job and return it.

        A step's job supersedes queued automatic jobs of steps of this session, and a job of the whole session
        supersedes those of the whole session. A step's finished job is deleted when the session's next step is queued.

        Parameters
        ----------
        session, path
            Name and folder of the session.
        reason
            The capture that caused the job, or "asked for".
        automatic
            Whether a capture caused it; only automatic jobs are superseded.
        step
            Id of the capture to process alone; None for the whole session.
        after
            Seconds before the job may start.

        Raises OSError, and queues nothing, where the job's record cannot be written.
        """
        with self._lock:
            alike = [
                job
                for job in self._jobs.values()
                if job.automatic and job.session == session and (job.step is None) == (step is None)
            ]
            job = Job(self._new_id(), session, reason, automatic, _now(), step=step)
            if after > 0:
                job = replace(job, message=f"begins {after:.0f} s after the last capture")
            self._write(job)  # first: a job that cannot be recorded is not queued
            self._paths[job.id], self._due[job.id] = Path(path), time.monotonic() + after
            self._store(job)
            for old in alike:
                if old.state == "queued":
                    self._update(old.id, state="superseded", finished_at=_now(), message=f"replaced by job {job.id}")
                elif step is not None and old.finished:
                    self._delete(old.id)
            work = self._current_work if step is not None and self._session_is_running() else None
        if work is not None:
            work.give_way()
        return job

    def cancel(self, job_id: str) -> Job:
        """Cancel a queued or running job; a finished one is returned unchanged. Raises KeyError if there is none."""
        with self._lock:
            job = self._jobs[job_id]
            if job.finished:
                return job
            work = self._current_work if job.state == "running" else None
            job = self._update(job_id, state="cancelled", finished_at=_now(), left_s=None)
        if work is not None:
            work.end()
        return job

    def wait(self, job_id: str, timeout: float) -> Job:
        """Wait until a job has finished and return it. Raises TimeoutError after ``timeout`` seconds."""
        with self._lock:
            if not self._lock.wait_for(lambda: self._jobs[job_id].finished, timeout):
                raise TimeoutError(f"job {job_id} is still {self._jobs[job_id].state} after {timeout} s")
            return self._jobs[job_id]

    # The two threads

    def _report(self) -> None:
        """Pass every change on, until the queue of changes is closed."""
        while (job := self._changes.get()) is not None:
            try:
                self._on_change(job)
            except Exception:  # the changes of all other jobs are to be reported
                logger.exception("a change of job %s could not be reported", job.id)

    def _work(self) -> None:
        """Run the queued jobs one after the other, until the queue of jobs is closed."""
        while True:
            with self._lock:
                while not self._closing and self._next() is None:
                    self._lock.wait(self._until_due())
                if self._closing:
                    return
                job = self._next()
                assert job is not None
                self._update(job.id, state="running", started_at=_now(), message="")
            try:
                self._run(job)
            except OSError as error:
                logger.exception("job %s could not be run", job.id)
                self._finish(job.id, state="failed", error=f"The processing could not be started: {error}")

    def _run(self, job: Job) -> None:
        """Start the processing of a job, follow its lines to the end and settle the outcome."""
        with _JobLog(self._folder / job.id / "log.txt") as log:
            work = self._processing.begin(Order(self._paths[job.id], job.step))
            with self._lock:
                self._current_work = work
                cancelled = self._jobs[job.id].finished
                step_waits = any(other.step and other.state == "queued" for other in self._jobs.values())
            if cancelled:
                work.end()
            elif job.step is None and step_waits:
                work.give_way()
            outcome = self._follow(job.id, work, log)
            if outcome.get("error"):
                log.write(f"{datetime.now():%H:%M:%S} failed: {outcome['error']}\n")
            code = work.wait()
            with self._lock:
                self._current_work = None
        self._settle(job.id, code, outcome)

    def _follow(self, job_id: str, work: Work, log: _JobLog) -> dict[str, Any]:
        """Record progress and log until the work ends; return its last message about a state, {} without one."""
        outcome: dict[str, Any] = {}
        last_stage = ""
        for line in work.lines():
            message = message_of(line)
            if message is None:
                log.write(line)
            elif "state" in message:
                outcome = message
            else:
                self._progress(job_id, message)
                stage = f"{message.get('stage', '')} {message.get('message', '')}".rstrip()
                if stage != last_stage:
                    log.write(f"{datetime.now():%H:%M:%S} {stage}\n")
                    last_stage = stage
        return outcome

    def _settle(self, job_id: str, code: int, outcome: dict[str, Any]) -> None:
        """Set the state that follows from the exit code of the processing and its last message."""
        state = outcome.get("state")
        if code in (0, DO_NOT_USE_EXIT) and state == "done":
            self._finish(job_id, state="done", done=1.0, run=outcome.get("run"), message="")
        elif code == 0 and state == "stopped":
            self._queue_again(job_id)
        else:
            sentence = outcome.get("error") or f"The processing ended with exit code {code}; see its log."
            self._finish(job_id, state="failed", error=str(sentence))

    def _queue_again(self, job_id: str) -> None:
        """Queue a job once more that gave way; it is superseded if a newer capture's job waits for this session."""
        with self._lock:
            job = self._jobs[job_id]
            if job.finished:  # it was cancelled meanwhile
                return
            newer = [
                other.id
                for other in self._jobs.values()
                if other.state == "queued" and other.automatic and other.step is None and other.session == job.session
            ]
            if job.automatic and newer:
                self._update(
                    job_id, state="superseded", finished_at=_now(), left_s=None, message=f"replaced by job {max(newer)}"
                )
            else:
                self._update(job_id, state="queued", stage="", left_s=None, message="gave way to a newer step")

    def _finish(self, job_id: str, **changes: Any) -> None:
        """Set a final state, unless the job has one: a cancelled job stays cancelled."""
        with self._lock:
            if not self._jobs[job_id].finished:
                self._update(job_id, finished_at=_now(), left_s=None, **changes)

    def _progress(self, job_id: str, message: dict[str, Any]) -> None:
        """Take over a message of progress; it is reported only now and then, and not written to disk."""
        with self._lock:
            job = self._jobs[job_id]
            if job.finished:
                return
            changed = replace(job, **{name: message[name] for name in _PROGRESS if name in message})
            self._jobs[job_id] = changed
            now = time.monotonic()
            if changed.stage != job.stage or now - self._progress_time > _PROGRESS_INTERVAL:
                self._progress_time = now
                self._changes.put(changed)

    # With the lock held

    def _update(self, job_id: str, **changes: Any) -> Job:
        job = replace(self._jobs[job_id], **changes)
        try:
            self._write(job)
        except OSError as error:  # a full disk: the job goes on, and is told as it is
            logger.warning("the record of job %s cannot be written: %s", job_id, error)
        self._store(job)
        return job

    def _store(self, job: Job) -> None:
        """Put a new or changed job into the list, wake whoever waits, and have the change reported."""
        self._jobs[job.id] = job
        self._lock.notify_all()
        self._changes.put(job)

    def _next(self) -> Job | None:
        """The job to start now: a step before a whole session, the older first; None if nothing is due."""
        due = [job for job in self._jobs.values() if job.state == "queued" and self._due[job.id] <= time.monotonic()]
        return min(due, key=lambda job: (job.step is None, job.id), default=None)

    def _until_due(self) -> float | None:
        """Seconds until the next queued job may start; None if none is queued."""
        times = [self._due[job.id] for job in self._jobs.values() if job.state == "queued"]
        return max(0.0, min(times) - time.monotonic()) if times else None

    def _session_is_running(self) -> bool:
        """Whether the running job processes a whole session."""
        return any(job.state == "running" and job.step is None for job in self._jobs.values())

    def _delete(self, job_id: str) -> None:
        for by_id in (self._jobs, self._paths, self._due):
            by_id.pop(job_id, None)
        rmtree(self._folder / job_id, ignore_errors=True)

    def _new_id(self) -> str:
        self._last_id += 1
        return f"{self._last_id:04d}"

    def _write(self, job: Job) -> None:
        """Replace a job's record on disk as a whole."""
        folder = self._folder / job.id
        folder.mkdir(parents=True, exist_ok=True)
        partial = folder / "job.json.partial"
        partial.write_text(json.dumps(asdict(job), indent=1) + "\n", encoding="utf-8")
        partial.replace(folder / "job.json")

    def _load(self) -> None:
        """Read the jobs of earlier runs of the controller; those that it left unfinished become failed."""
        for path in sorted(self._folder.glob("[0-9]*/job.json")):
            if not path.parent.name.isdecimal():
                continue
            self._last_id = max(self._last_id, int(path.parent.name))  # of one that is damaged, too: it stays as it is
            try:
                job = _JOB.validate_python(read_json(path))
                if job.id != path.parent.name:
                    raise ValueError(f"it is the record of job {job.id}")
            except (ValueError, OSError) as error:
                logger.warning("%s is not readable and is left out: %s", path, error)
                continue
            if not job.finished:
                sentence = "The controller ended before this job did; start it again."
                job = replace(job, state="failed", error=sentence, finished_at=_now(), left_s=None)
                with suppress(OSError):  # an archive that cannot be written can still be shown
                    self._write(job)
            self._jobs[job.id] = job


class _JobLog:
    """Log of a job; where the disk is full the job goes on without. A context manager."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab", buffering=0)

    def __enter__(self) -> _JobLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, text: str) -> None:
        with suppress(OSError):
            self._file.write(text.encode("utf-8", "replace"))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
