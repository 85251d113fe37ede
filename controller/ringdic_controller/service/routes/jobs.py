"""Processing jobs: list, start, cancel, log."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, status
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel

from ringdic_controller.jobs.jobs import Job
from ringdic_controller.service.refusals import NotFoundError
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/jobs", tags=["jobs"])


class NewJob(BaseModel):
    """Name of the session to process."""

    session: str


@contextmanager
def _existing(job_id: str) -> Iterator[None]:
    """Answer 404 where the queue does not know a job."""
    try:
        yield
    except KeyError as error:
        raise NotFoundError(f"There is no job '{job_id}'.") from error


@router.get("", response_model=list[Job], summary="All jobs, newest first")
def list_jobs(desk: TheDesk) -> list[dict[str, Any]]:
    """All jobs, newest first; at most one is running."""
    return [asdict(job) for job in desk.jobs.list()]


@router.post("", response_model=Job, status_code=status.HTTP_202_ACCEPTED, summary="Process a session")
def start_job(new: NewJob, desk: TheDesk) -> dict[str, Any]:
    """Queue the processing of a session and return the job.

    404 if there is no such session, 409 if it lacks captures that the processing needs.
    """
    return asdict(desk.processing.submit(new.session))


@router.get("/{job_id}", response_model=Job, summary="One job")
def read_job(job_id: str, desk: TheDesk) -> dict[str, Any]:
    """One job: state, stage, share done, rate, time left; the run that it has written, or the error."""
    with _existing(job_id):
        return asdict(desk.jobs.get(job_id))


@router.post("/{job_id}/cancel", response_model=Job, summary="Stop a job")
def cancel_job(job_id: str, desk: TheDesk) -> dict[str, Any]:
    """Cancel a job and return it; a finished one is returned unchanged."""
    with _existing(job_id):
        return asdict(desk.jobs.cancel(job_id))


@router.get("/{job_id}/log", response_class=PlainTextResponse, summary="The end of a job's log")
def read_job_log(job_id: str, desk: TheDesk) -> str:
    """The last 256 kB of a job's log as plain text."""
    with _existing(job_id):
        return desk.jobs.log(job_id)
