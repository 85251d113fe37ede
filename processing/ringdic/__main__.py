"""The command ``ringdic``, also as ``python -m ringdic``: bad input ends in one sentence, without a traceback.

Exit codes: 0 done, 2 bad input, 3 could not be computed, 1 a bug.
"""

from __future__ import annotations

import logging
import os
import sys

from ringdic.errors import InputError, RingdicError, missing_extra


def main() -> None:
    """Run the command that is given on the command line, and end the process with its exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s", stream=sys.stderr)
    # The matrices are small and tasks use all cores; more threads would only wait. Read when numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from ringdic.cli.app import run  # needs packages that a camera node does not have

        run()
    except RingdicError as error:
        _refuse(error)
    except ModuleNotFoundError as error:
        sentence = missing_extra(error)
        if sentence is None:
            raise
        _refuse(sentence)
    except OSError as error:  # a folder that may not be written, a full disk: the operator can correct that
        if error.filename is None:
            raise
        _refuse(InputError(f"{error.filename}: {error.strerror}; check the path, its permissions and the disk"))


def _refuse(error: RingdicError) -> None:
    sys.stderr.write(f"ringdic: {error}\n")
    sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
