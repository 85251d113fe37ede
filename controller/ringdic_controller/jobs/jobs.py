"""Processing jobs: one at a time, in child processes, with their progress read line by line and their log kept.

::

    queued → running → done | failed | cancelled
    queued → superseded (a newer capture of the same session) | cancelled
    running → queued (a whole session gives way to a single step, and goes on from what it has found)

The child prints JSON lines: progress ``{"stage", "done", "rate", "left_s", "message"}`` and at the end
``{"state": "done", "run", "summary"}``, ``{"state": "failed", "error"}`` or ``{"state": "stopped"}``. Every other
line is log, and so is the begin of every stage.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from shutil import rmtree
from threading import Condition, Thread
from typing import Any

from ringdic_controller.jobs.children import ChildPerJob, Command, Order, Processing, Work, message_of

logger = logging.getLogger(__name__)

FINISHED = ("done", "failed", "cancelled", "superseded")
_PROGRESS = ("stage", "done", "rate", "left_s", "message")
_NOTICE_EVERY = 0.2  # seconds between two notices of progress alone


@dataclass(frozen=True)
class Job:
    """One processing of one session, or with ``step`` (a capture's id) of that step alone, at once.

    ``done`` is the share of the work, 0 … 1; ``left_s`` an estimate or None; ``run`` the number of the run it made.
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
        """Nothing about it will change any more."""
        return self.state in FINISHED


class Jobs:
    """The queue of jobs and the thread that works it off.

    Parameters
    ----------
    folder
        Where each job keeps its record and log.
    processing
        What carries out the jobs; or from a session folder to the command line of a child of its own for each.
    on_change
        Told of every change, from the working thread.

    Single steps come before whole sessions, which give way to them; the rest in the order of their submission.
    """

    def __init__(
        self, folder: Path, processing: Command | Processing, on_change: Callable[[Job], None] = lambda _: None
    ) -> None:
        self._folder = Path(folder)
        self._processing: Processing = ChildPerJob(processing) if callable(processing) else processing
        self._on_change = on_change
        self._jobs: dict[str, Job] = {}
        self._paths: dict[str, Path] = {}
        self._due: dict[str, float] = {}  # when a queued job may begin, s
        self._work_now: Work | None = None
        self._changed = Condition()
        self._closing = False
        self._noticed = 0.0  # when progress was last told, s
        self._load()
        self._worker = Thread(target=self._work, name="jobs", daemon=True)
        self._worker.start()

    def close(self, timeout: float = 10.0) -> None:
        """Cancel what runs, end the thread and the children."""
        with self._changed:
            self._closing = True
            for job in [job for job in self._jobs.values() if job.state == "running"]:
                self._update(job.id, state="cancelled", finished_at=_now(), left_s=None)
            work = self._work_now
            self._changed.notify_all()
        self._processing.close()
        if work is not None:
            work.end()
        self._worker.join(timeout)

    @property
    def processing(self) -> Processing:
        """What carries out the jobs."""
        return self._processing

    def list(self) -> list[Job]:
        """All jobs, newest first."""
        with self._changed:
            return sorted(self._jobs.values(), key=lambda job: job.id, reverse=True)

    def get(self, job_id: str) -> Job:
        """One job; KeyError if there is none."""
        with self._changed:
            return self._jobs[job_id]

    def log(self, job_id: str, limit: int = 256_000) -> str:
        """The end of a job's log, at most ``limit`` bytes."""
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
        """Queue a job, to be begun after so many seconds at the soonest.

        It takes the place of a queued automatic job of the same session and kind (a step or the whole).
        A job of a step is kept until the session's next one.
        """
        with self._changed:
            alike = [
                job
                for job in self._jobs.values()
                if job.automatic and job.session == session and (job.step is None) == (step is None)
            ]
            job = Job(self._new_id(), session, reason, automatic, _now(), step=step)
            if after > 0:
                job = replace(job, message=f"begins {after:.0f} s after the last capture")
            self._jobs[job.id], self._paths[job.id] = job, Path(path)
            self._due[job.id] = time.monotonic() + after
            self._keep(job)
            for old in alike:
                if old.state == "queued":
                    self._update(old.id, state="superseded", finished_at=_now(), message=f"replaced by job {job.id}")
                elif step is not None and old.finished:
                    self._forget(old.id)
            if step is not None:
                self._make_way()
            self._changed.notify_all()
        self._on_change(job)
        return job

    def cancel(self, job_id: str) -> Job:
        """Stop a job, queued or running; a finished one stays as it is. KeyError if there is none."""
        with self._changed:
            job = self._jobs[job_id]
            if job.state == "queued":
                return self._update(job_id, state="cancelled", finished_at=_now())
            if job.state != "running":
                return job
            job = self._update(job_id, state="cancelled", finished_at=_now(), left_s=None)
            work = self._work_now
        if work is not None:
            work.end()
        return job

    def wait(self, job_id: str, timeout: float) -> Job:
        """The job once it has finished; TimeoutError after ``timeout`` seconds."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._jobs[job_id].finished, timeout):
                raise TimeoutError(f"job {job_id} is still {self._jobs[job_id].state} after {timeout} s")
            return self._jobs[job_id]

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._closing and self._next() is None:
                    self._changed.wait(self._until_due())
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
        """Have it carried out, follow the lines to the end, settle how it went."""
        with (self._folder / job.id / "log.txt").open("a", encoding="utf-8") as log:
            work = self._processing.begin(Order(self._paths[job.id], job.step))
            with self._changed:
                self._work_now = work
                cancelled = self._jobs[job.id].finished
                if job.step is None and any(other.step and other.state == "queued" for other in self._jobs.values()):
                    work.give_way()
            if cancelled:
                work.end()
            outcome: dict[str, Any] = {}
            told = ""
            for line in work.lines():
                message = message_of(line)
                if message is None:
                    log.write(line)
                elif "state" in message:
                    outcome = message
                else:
                    self._progress(job.id, message)
                    step = f"{message.get('stage', '')} {message.get('message', '')}".rstrip()
                    if step != told:
                        log.write(f"{datetime.now():%H:%M:%S} {step}\n")
                        told = step
                log.flush()
            if outcome.get("error"):
                log.write(f"{datetime.now():%H:%M:%S} failed: {outcome['error']}\n")
            code = work.wait()
            with self._changed:
                self._work_now = None
        self._settle(job.id, code, outcome)

    def _settle(self, job_id: str, code: int, outcome: dict[str, Any]) -> None:
        state = outcome.get("state")
        if code == 0 and state == "done":
            self._finish(job_id, state="done", done=1.0, run=outcome.get("run"), message="")
        elif code == 0 and state == "stopped":
            self._wait_again(job_id)
        else:
            sentence = outcome.get("error") or f"The processing ended with exit code {code}; see its log."
            self._finish(job_id, state="failed", error=str(sentence))

    def _wait_again(self, job_id: str) -> None:
        """Queue a job once more that gave way, unless a newer capture's job waits in its place."""
        with self._changed:
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

    def _make_way(self) -> None:
        """Ask the whole session that is being processed to stop; a step comes first."""
        running = [job for job in self._jobs.values() if job.state == "running" and job.step is None]
        if running and self._work_now is not None:
            self._work_now.give_way()

    def _finish(self, job_id: str, **changes: Any) -> None:
        with self._changed:
            if not self._jobs[job_id].finished:  # a cancelled job stays cancelled
                self._update(job_id, finished_at=_now(), left_s=None, **changes)
            self._changed.notify_all()

    def _progress(self, job_id: str, message: dict[str, Any]) -> None:
        with self._changed:
            job = self._jobs[job_id]
            if job.finished:
                return
            known = {name: message[name] for name in _PROGRESS if name in message}
            self._jobs[job_id] = moved = replace(job, **known)
        now = time.monotonic()
        if moved.stage != job.stage or now - self._noticed > _NOTICE_EVERY:
            self._noticed = now
            self._on_change(moved)

    def _update(self, job_id: str, **changes: Any) -> Job:
        job = self._jobs[job_id] = replace(self._jobs[job_id], **changes)
        self._keep(job)
        self._changed.notify_all()
        self._on_change(job)
        return job

    def _next(self) -> Job | None:
        """The job to begin now: a step before a whole session, the older first."""
        due = [job for job in self._jobs.values() if job.state == "queued" and self._due[job.id] <= time.monotonic()]
        return min(due, key=lambda job: (job.step is None, job.id), default=None)

    def _until_due(self) -> float | None:
        """Seconds until the next job may begin; None if nothing waits."""
        waiting = [self._due[job.id] for job in self._jobs.values() if job.state == "queued"]
        return max(0.0, min(waiting) - time.monotonic()) if waiting else None

    def _forget(self, job_id: str) -> None:
        del self._jobs[job_id]
        rmtree(self._folder / job_id, ignore_errors=True)

    def _new_id(self) -> str:
        return f"{1 + max((int(name) for name in self._jobs), default=0):04d}"

    def _keep(self, job: Job) -> None:
        folder = self._folder / job.id
        folder.mkdir(parents=True, exist_ok=True)
        partial = folder / "job.json.partial"
        partial.write_text(json.dumps(asdict(job), indent=1) + "\n", encoding="utf-8")
        partial.replace(folder / "job.json")

    def _load(self) -> None:
        """Earlier jobs; what was not finished when the controller ended has failed."""
        for path in sorted(self._folder.glob("[0-9]*/job.json")):
            try:
                job = Job(**json.loads(path.read_text(encoding="utf-8")))
            except (json.JSONDecodeError, TypeError, UnicodeDecodeError) as error:
                logger.warning("%s is not readable and is left out: %s", path, error)
                continue
            if not job.finished:
                sentence = "The controller ended before this job did; start it again."
                job = replace(job, state="failed", error=sentence, finished_at=_now(), left_s=None)
                self._keep(job)
            self._jobs[job.id] = job


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
