"""A client of the controller's HTTP interface that does what an operator does on the page."""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from typing import Any

from ringdic.errors import ComputationError

_EVERY = 0.2  # seconds between two requests


class Client:
    """Client of the controller's HTTP interface at ``address``, such as ``http://127.0.0.1:8000``."""

    def __init__(self, address: str) -> None:
        self.address = address

    def get(self, path: str) -> Any:
        """The JSON answer of a resource under /api/v1."""
        return self._call("GET", path, None)

    def post(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """The JSON answer to a request under /api/v1. Raises ComputationError with the controller's refusal."""
        return self._call("POST", path, body or {})

    def put(self, path: str, body: dict[str, Any]) -> Any:
        """The JSON answer to a change of a resource under /api/v1."""
        return self._call("PUT", path, body)

    def wait_for_nodes(self, ids: list[str], timeout: float, alive: Callable[[], None]) -> None:
        """Wait until every node is connected. ``alive`` may raise if waiting has become pointless."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            alive()
            missing = self.get("/rig")["missing"]
            if not missing:
                return
            time.sleep(_EVERY)
        raise ComputationError(f"after {timeout:.0f} s there was no node {', '.join(missing or ids)}; see its log")

    def capture(self, kind: str, timeout: float = 180.0) -> dict[str, Any]:
        """Begin a capture, wait until its round has closed, and return its record."""
        started = self.post("/captures", {"kind": kind})
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            state = self.get(f"/rounds/{started['id']}")
            if state["state"] == "refused":
                raise ComputationError(f"the {kind} capture was refused: {state['error']}")
            if state["state"] == "closed":
                return dict(self.get(f"/sessions/{state['session']}/captures/{state['capture_id']}"))
            time.sleep(_EVERY)
        raise ComputationError(f"the {kind} capture did not close within {timeout:.0f} s")

    def follow_job(self, job_id: str, watch: Callable[[dict[str, Any]], None], timeout: float) -> dict[str, Any]:
        """Wait until a job is done and return it; ``watch`` is called often with its present state."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            job = self.get(f"/jobs/{job_id}")
            watch(job)
            if job["state"] == "done":
                return dict(job)
            if job["state"] not in ("queued", "running"):
                raise ComputationError(f"the processing of {job['session']} {job['state']}: {job['error']}")
            time.sleep(_EVERY)
        raise ComputationError(f"job {job_id} did not end within {timeout:.0f} s")

    def wait_for_step(
        self, session: str, capture_id: str, timeout: float, meanwhile: Callable[[], None] = lambda: None
    ) -> None:
        """Wait until a live step, or a newer one, has been processed; ``meanwhile`` is called often."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            meanwhile()
            for job in self.get("/jobs"):
                if job["session"] != session or not job["step"] or job["step"] < capture_id:
                    continue
                if job["state"] == "failed":
                    raise ComputationError(f"{job['step']} of {session} was not processed: {job['error']}")
                if job["state"] == "done":
                    return
            time.sleep(_EVERY)
        raise ComputationError(f"{capture_id} of {session} was not processed within {timeout:.0f} s")

    def _call(self, method: str, path: str, body: dict[str, Any] | None) -> Any:
        request = urllib.request.Request(
            f"{self.address}/api/v1{path}",
            data=None if body is None else json.dumps(body).encode(),
            headers={"Content-Type": "application/json"},
            method=method,
        )
        try:
            with urllib.request.urlopen(request, timeout=30) as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:
            detail = json.loads(error.read() or b"{}").get("detail", error.reason)
            raise ComputationError(f"the controller refused {method} {path}: {detail}") from error
