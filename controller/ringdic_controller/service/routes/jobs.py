"""Processing jobs: list, start, cancel, log."""

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, status
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel

from ringdic_controller.jobs.jobs import Job
from ringdic_controller.service.desk import NotFoundError
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/jobs", tags=["jobs"])


class NewJob(BaseModel):
    """Which session to process."""

    session: str


@router.get("", response_model=list[Job], summary="All jobs, newest first")
def jobs(desk: TheDesk) -> list[dict[str, Any]]:
    """One at a time is running; the others wait, oldest first."""
    return [asdict(job) for job in desk.jobs.list()]


@router.post("", response_model=Job, status_code=status.HTTP_202_ACCEPTED, summary="Process a session")
def start(new: NewJob, desk: TheDesk) -> dict[str, Any]:
    """404 if there is no such session, 409 if it lacks the captures that processing needs."""
    return asdict(desk.start_job(new.session))


@router.get("/{job_id}", response_model=Job, summary="One job")
def job(job_id: str, desk: TheDesk) -> dict[str, Any]:
    """State, stage, share done, rate, time left; the run it made or what went wrong."""
    try:
        return asdict(desk.jobs.get(job_id))
    except KeyError as error:
        raise NotFoundError(f"There is no job '{job_id}'.") from error


@router.post("/{job_id}/cancel", response_model=Job, summary="Stop a job")
def cancel(job_id: str, desk: TheDesk) -> dict[str, Any]:
    """A finished job stays as it is."""
    try:
        return asdict(desk.jobs.cancel(job_id))
    except KeyError as error:
        raise NotFoundError(f"There is no job '{job_id}'.") from error


@router.get("/{job_id}/log", response_class=PlainTextResponse, summary="The end of a job's log")
def log(job_id: str, desk: TheDesk) -> str:
    """Plain text, the last 256 kB."""
    try:
        return desk.jobs.log(job_id)
    except KeyError as error:
        raise NotFoundError(f"There is no job '{job_id}'.") from error
