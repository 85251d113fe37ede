"""Processor time that a job spends on the checks from which its findings follow.

``python -m ringdic_controller.studies.bench.checks SESSION …`` runs a job as ``python -m ringdic.jobs`` does, with its
checks timed, and adds a last line of JSON: ``{"checks": {name: seconds of processor time}}``.
"""

from __future__ import annotations

import functools
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from ringdic.calibration import calibrated_rig
from ringdic.charts import series
from ringdic.charts import tasks as charts_tasks
from ringdic.charts.image_findings import RunImages
from ringdic.charts.reference_state import ReferenceState
from ringdic.charts.series import SurfaceSeries
from ringdic.charts.tasks import ChartsJob
from ringdic.jobs import pipeline
from ringdic.jobs.__main__ import main

#: Functions that check, by what they check: the module or class that calls them by a name, and this name.
_CHECKS: tuple[tuple[str, Any, str], ...] = (
    ("calibration", calibrated_rig, "contradictions"),
    ("poses at the reference", charts_tasks, "poses_task"),
    ("poses at the steps", series, "find_moved_cameras"),
    ("reference images", ReferenceState, "of"),
    ("images of the steps", charts_tasks, "image_state"),
    ("images of the steps", charts_tasks, "pixel_digest"),
    ("findings", ChartsJob, "images"),
    ("findings", RunImages, "findings"),
    ("findings", SurfaceSeries, "findings"),
    ("findings", pipeline, "moment_findings"),
)


class CheckClock:
    """Processor time of the checks of this process, by what they check."""

    def __init__(self) -> None:
        self.seconds = {name: 0.0 for name, _, _ in _CHECKS}
        self._lock = threading.Lock()

    def attach(self) -> None:
        """Have every check timed from now on; KeyError where one does not exist."""
        for name, owner, attribute in _CHECKS:
            check = vars(owner)[attribute]
            if isinstance(check, property):
                assert check.fget is not None
                setattr(owner, attribute, property(self._timed(name, check.fget)))
            elif isinstance(check, classmethod):
                setattr(owner, attribute, staticmethod(self._timed(name, getattr(owner, attribute))))
            else:
                setattr(owner, attribute, self._timed(name, check))

    def _timed(self, name: str, check: Callable[..., Any]) -> Callable[..., Any]:
        """A check whose processor time, that of the calling thread, is added to the seconds under a name."""

        @functools.wraps(check)
        def timed(*arguments: Any, **keywords: Any) -> Any:
            began = time.thread_time()
            try:
                return check(*arguments, **keywords)
            finally:
                with self._lock:
                    self.seconds[name] += time.thread_time() - began

        return timed


if __name__ == "__main__":
    clock = CheckClock()
    clock.attach()
    code = main()
    sys.stdout.write(json.dumps({"checks": clock.seconds}) + "\n")
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # at once, as the job does
