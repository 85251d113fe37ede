"""``python -m ringdic.jobs SESSION`` processes a session and reports on it in lines of JSON on standard output.

The controller runs it as a child process. Every line is one object: ``{"stage", "done", "rate", "left_s", "message"}``
during the work, ``{"state": "done", "run", "summary"}`` or ``{"state": "failed", "error"}`` at the end. Exit codes: 0
done, 2 bad input, 3 could not be computed, 4 done, but the results are not to be used, 1 a bug.

``python -m ringdic.jobs --serve`` keeps running and takes one order after the other from standard input, as described
in `ringdic.jobs.serving`.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ringdic.errors import RingdicError
from ringdic.findings import DO_NOT_USE_EXIT, Verdict
from ringdic.jobs.allocation import keep_freed_memory
from ringdic.jobs.serving import carry_out, serve
from ringdic.settings import load_settings


def main() -> int:
    """Read the command line, run the job that it names and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m ringdic.jobs", description="Process a session folder.")
    choice = parser.add_mutually_exclusive_group(required=True)
    choice.add_argument("session", type=Path, nargs="?")
    choice.add_argument("--serve", action="store_true", help="take orders from standard input")
    parser.add_argument("--settings", type=Path)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()
    keep_freed_memory()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    if arguments.serve:
        return _serve_to_the_end()
    try:
        settings = load_settings(arguments.settings, arguments.overrides)
        outcome = carry_out(arguments.session, settings, lambda at: _line(asdict(at)))
        _line(outcome)
    except RingdicError as error:
        _line({"state": "failed", "error": str(error)})
        return error.exit_code
    return DO_NOT_USE_EXIT if outcome["summary"]["verdict"] == Verdict.DO_NOT_USE else 0


def _serve_to_the_end() -> int:
    try:
        serve(sys.stdin, _line)
    except Exception:
        logging.exception("the processing failed through a fault of its own")
        return 1
    return 0


def _line(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # Ends at once: everything is written, freeing arrays and kernels would take half a second, and the thread that
    # reads the orders never ends by itself.
    os._exit(code)
