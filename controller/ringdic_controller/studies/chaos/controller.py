"""A controller without a page, in a process of its own: it captures until a session has so many captures.

``python -m ringdic_controller.studies.chaos.controller ARCHIVE SESSION ENDPOINT CAPTURES`` then goes on reconciling
until it is ended by SIGTERM.
"""

from __future__ import annotations

import logging
import signal
import sys
import threading
from pathlib import Path
from typing import Any

from ringdic.errors import ComputationError
from ringdic.session.writer import Archive

from ringdic_controller.rig.capture import MS, SECOND, Timing
from ringdic_controller.rig.link import RigLink

log = logging.getLogger(__name__)

TIMING = Timing(
    arm=6 * SECOND,
    arm_retry=500 * MS,
    lead=1000 * MS,
    pull_after=1 * SECOND,
    pull_every=1 * SECOND,
    collect=20 * SECOND,
    gone_grace=1 * SECOND,
)
RIG = "chaos"


def main(archive: Path, name: str, endpoint: str, captures: int) -> None:
    """Capture, whatever happens to the nodes, and reconcile until SIGTERM."""
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    store = Archive(archive)
    session = store.open(name)
    with RigLink(RIG, list(session.cameras), endpoint, store, _note, timing=TIMING, reconcile_s=1.0) as link:
        link.wait_for_nodes(10.0)
        while not ended.is_set() and len(session.captures()) < captures:
            try:
                link.capture(session, "specimen", override=True)
            except (ComputationError, OSError) as error:
                log.warning("%s", error)
            ended.wait(0.2)
        ended.wait()


def _note(event: dict[str, Any]) -> None:
    if event["type"] == "node" and event["node"]["detail"]:
        log.warning("%s: %s", event["node"]["id"], event["node"]["detail"])


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4]))
