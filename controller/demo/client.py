"""An operator in a few lines: everything the page does is an HTTP call, so a script can do it too."""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from typing import Any

from processing.errors import ComputationError

_EVERY = 0.2  # seconds between two looks


class Client:
    """Talks to the controller at ``address``."""

    def __init__(self, address: str) -> None:
        self.address = address

    def get(self, path: str) -> Any:
        """The JSON answer of a resource under /api/v1."""
        return self._call("GET", path, None)

    def post(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """The JSON answer to a request under /api/v1; ComputationError with the controller's sentence if refused."""
        return self._call("POST", path, body or {})

    def wait_for_nodes(self, ids: list[str], timeout: float, alive: Callable[[], None]) -> None:
        """Until every node is there. ``alive`` may raise if waiting has become pointless."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            alive()
            missing = self.get("/rig")["missing"]
            if not missing:
                return
            time.sleep(_EVERY)
        raise ComputationError(f"after {timeout:.0f} s there was no node {', '.join(missing or ids)}; see its log")

    def capture(self, kind: str, timeout: float = 180.0) -> dict[str, Any]:
        """Press a capture button and wait for the round to close; the record."""
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

    def cancel_jobs(self) -> None:
        """Stop every job that has not ended."""
        for job in self.get("/jobs"):
            if job["state"] in ("queued", "running"):
                self.post(f"/jobs/{job['id']}/cancel")

    def follow_job(self, session: str, watch: Callable[[dict[str, Any]], None], timeout: float) -> dict[str, Any]:
        """Wait for the newest job of a session to end, telling ``watch`` of its progress; the job."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            jobs = [job for job in self.get("/jobs") if job["session"] == session]
            if jobs:
                watch(jobs[0])
                if jobs[0]["state"] == "done":
                    return dict(jobs[0])
                if jobs[0]["state"] in ("failed", "cancelled"):
                    raise ComputationError(f"the processing of {session} {jobs[0]['state']}: {jobs[0]['error']}")
            time.sleep(_EVERY)
        raise ComputationError(f"the processing of {session} did not end within {timeout:.0f} s")

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
