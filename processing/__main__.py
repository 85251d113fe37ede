"""``python -m processing SESSION``: process a session and tell about it in lines of JSON on standard output.

This is what the controller runs as a child process. Every line is one object: ``{"stage", "done", "rate",
"left_s", "message"}`` while at work, at last ``{"state": "done", "run", "summary"}`` or
``{"state": "failed", "error"}``. Exit codes: 0 done, 2 bad input, 3 could not be computed, 1 a bug.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from processing.errors import RingdicError
from processing.pipeline import process_session
from processing.progress import Progress
from processing.settings import load_settings


def main() -> int:
    """Parse the command line, process, report; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m processing", description="Process a session folder.")
    parser.add_argument("session", type=Path)
    parser.add_argument("--settings", type=Path)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    try:
        settings = load_settings(arguments.settings, arguments.overrides)
        run = process_session(arguments.session, settings, _report)
    except RingdicError as error:
        _line({"state": "failed", "error": str(error)})
        return error.exit_code
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    _line({"state": "done", "run": run.name, "summary": summary})
    return 0


def _report(progress: Progress) -> None:
    _line(asdict(progress))


def _line(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
