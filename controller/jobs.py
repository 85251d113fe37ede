"""Processing jobs: one at a time, each in a child process, with its progress read line by line and its log kept.

::

    queued → running → done | failed | cancelled
    queued → superseded (a newer capture of the same session) | cancelled

The child prints JSON lines: progress ``{"stage", "done", "rate", "left_s", "message"}`` and at the end
``{"state": "done", "run", "summary"}`` or ``{"state": "failed", "error"}``. Every other line is log, and so is the
begin of every stage.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Condition, Thread
from typing import Any

logger = logging.getLogger(__name__)

Command = Callable[[Path], list[str]]
FINISHED = ("done", "failed", "cancelled", "superseded")
_PROGRESS = ("stage", "done", "rate", "left_s", "message")
_NOTICE_EVERY = 0.2  # seconds between two notices of progress alone
_KILL_AFTER = 5.0  # seconds that a cancelled child has to end by itself


@dataclass(frozen=True)
class Job:
    """One processing of one session. ``done`` is the share of the work, 0 … 1; ``left_s`` an estimate or None."""

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

    @property
    def finished(self) -> bool:
        """Nothing about it will change any more."""
        return self.state in FINISHED


def processing_command(settings: Path | None = None) -> Command:
    """The command that processes a session folder in a child process of this interpreter."""

    def command(session: Path) -> list[str]:
        chosen = ["--settings", str(settings)] if settings else []
        return [sys.executable, "-m", "processing", str(session), *chosen]

    return command


class Jobs:
    """The queue of jobs and the thread that works it off.

    Parameters
    ----------
    folder
        Where each job keeps its record and log.
    command
        From a session folder to the child's command line.
    on_change
        Told of every change, from the working thread.
    """

    def __init__(self, folder: Path, command: Command, on_change: Callable[[Job], None] = lambda _: None) -> None:
        self._folder = Path(folder)
        self._command = command
        self._on_change = on_change
        self._jobs: dict[str, Job] = {}
        self._paths: dict[str, Path] = {}
        self._child: subprocess.Popen[str] | None = None
        self._changed = Condition()
        self._closing = False
        self._noticed = 0.0  # when progress was last told, s
        self._load()
        self._worker = Thread(target=self._work, name="jobs", daemon=True)
        self._worker.start()

    def close(self, timeout: float = 10.0) -> None:
        """Cancel what runs and end the thread."""
        with self._changed:
            self._closing = True
            running = [job for job in self._jobs.values() if job.state == "running"]
            self._changed.notify_all()
        for job in running:
            self.cancel(job.id)
        self._worker.join(timeout)

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

    def submit(self, session: str, path: Path, *, reason: str, automatic: bool = False) -> Job:
        """Queue a job. An automatic one takes the place of a queued automatic job of the same session."""
        with self._changed:
            superseded = [
                job
                for job in self._jobs.values()
                if automatic and job.automatic and job.session == session and job.state == "queued"
            ]
            job = Job(self._new_id(), session, reason, automatic, _now())
            self._jobs[job.id], self._paths[job.id] = job, Path(path)
            self._keep(job)
            for old in superseded:
                self._update(old.id, state="superseded", finished_at=_now(), message=f"replaced by job {job.id}")
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
            child = self._child
        if child is not None:
            _end(child)
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
                self._changed.wait_for(lambda: self._closing or self._next() is not None)
                if self._closing:
                    return
                job = self._next()
                assert job is not None
                self._update(job.id, state="running", started_at=_now())
            try:
                self._run(job.id)
            except OSError as error:
                logger.exception("job %s could not be run", job.id)
                self._finish(job.id, state="failed", error=f"The processing could not be started: {error}")

    def _run(self, job_id: str) -> None:
        """Start the child, follow its lines to the end, settle how it went."""
        command = self._command(self._paths[job_id])
        with (self._folder / job_id / "log.txt").open("a", encoding="utf-8") as log:
            child = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                encoding="utf-8",
                errors="replace",
                env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"},
                start_new_session=os.name == "posix",
            )
            with self._changed:
                self._child = child
                cancelled = self._jobs[job_id].finished
            if cancelled:
                _end(child)
            outcome: dict[str, Any] = {}
            told = ""
            for line in _lines(child):
                message = _message(line)
                if message is None:
                    log.write(line)
                elif "state" in message:
                    outcome = message
                else:
                    self._progress(job_id, message)
                    step = f"{message.get('stage', '')} {message.get('message', '')}".rstrip()
                    if step != told:
                        log.write(f"{datetime.now():%H:%M:%S} {step}\n")
                        told = step
                log.flush()
            if outcome.get("error"):
                log.write(f"{datetime.now():%H:%M:%S} failed: {outcome['error']}\n")
            code = child.wait()
            with self._changed:
                self._child = None
        self._settle(job_id, code, outcome)

    def _settle(self, job_id: str, code: int, outcome: dict[str, Any]) -> None:
        if code == 0 and outcome.get("state") == "done":
            self._finish(job_id, state="done", done=1.0, run=outcome.get("run"), message="")
        else:
            sentence = outcome.get("error") or f"The processing ended with exit code {code}; see its log."
            self._finish(job_id, state="failed", error=str(sentence))

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
        return min((job for job in self._jobs.values() if job.state == "queued"), key=lambda j: j.id, default=None)

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


def _lines(child: subprocess.Popen[str]) -> Iterable[str]:
    """The child's lines until it has ended, even if a grandchild keeps the pipe open."""
    lines: SimpleQueue[str | None] = SimpleQueue()

    def read() -> None:
        assert child.stdout is not None
        with child.stdout:
            for line in child.stdout:
                lines.put(line)
        lines.put(None)

    Thread(target=read, name="job-output", daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=1.0)
        except Empty:
            if child.poll() is not None:
                return
            continue
        if line is None:
            return
        yield line


def _message(line: str) -> dict[str, Any] | None:
    """The JSON object of a progress or outcome line; None for a line of log."""
    if not line.startswith("{"):
        return None
    try:
        message = json.loads(line)
    except json.JSONDecodeError:
        return None
    return message if isinstance(message, dict) and ("stage" in message or "state" in message) else None


def _end(child: subprocess.Popen[str]) -> None:
    """Ask the child and everything it started to end; insist after a while."""
    _signal(child, signal.SIGTERM)
    try:
        child.wait(_KILL_AFTER)
    except subprocess.TimeoutExpired:
        _signal(child, getattr(signal, "SIGKILL", signal.SIGTERM))


def _signal(child: subprocess.Popen[str], number: int) -> None:
    try:
        if os.name == "posix":
            os.killpg(child.pid, number)
        else:
            child.terminate()
    except ProcessLookupError:  # it has ended meanwhile
        return


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
