"""A child process together with all that it starts, that ends when the program that wants it has ended.

``python guardian.py [--orders] COMMAND …`` runs the command with this process's output. Its standard input is the tie
to the program that started it: a system closes it however that program ends, also when it is killed. Then the command
is asked to end, and after some seconds it is killed with all that it has started. With ``--orders`` the lines of the
standard input are passed on to the command.

The exit code is that of the command; a signal that ended it is told as 128 more than its number. Needs the standard
library alone, and imports nothing of this package, so that it costs little beside the command.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from threading import Event, Thread

GRACE = 2.0  # seconds that the command has to end by itself


def main(arguments: list[str]) -> int:
    """Run the command in the arguments to its end, or to that of the standard input; returns the exit code."""
    takes_orders = arguments[0] == "--orders"
    if os.name == "posix":  # the command has to end first, so that its exit code can be told
        signal.signal(signal.SIGTERM, lambda *_: None)
        signal.signal(signal.SIGINT, lambda *_: None)
    child = subprocess.Popen(
        arguments[1:] if takes_orders else arguments,
        stdin=subprocess.PIPE if takes_orders else subprocess.DEVNULL,
    )
    alone, ended = Event(), Event()
    Thread(target=_follow_input, args=(child, alone, ended), daemon=True).start()
    code = child.wait()
    ended.set()
    if alone.is_set():
        _signal(child, signal.SIGTERM)  # what the command has started
    return code if code >= 0 else 128 - code


def _follow_input(child: subprocess.Popen[bytes], alone: Event, ended: Event) -> None:
    """Pass the standard input on, where the child takes it; at its end, end the child.

    alone : set at the end of the input. ended : set by the other thread when the child has ended.
    """
    orders = child.stdin
    while part := os.read(0, 65536):
        if orders is not None:
            with suppress(OSError):  # the child has ended, or reads no more
                orders.write(part)
                orders.flush()
    alone.set()
    if orders is None:
        _signal(child, signal.SIGTERM)
    else:
        with suppress(OSError):
            orders.close()
    if not ended.wait(GRACE):
        _signal(child, getattr(signal, "SIGKILL", signal.SIGTERM))


def _signal(child: subprocess.Popen[bytes], number: int) -> None:
    """Send a signal to the child and to all that it has started; where there are no such groups, end the child."""
    if os.name == "posix":
        os.killpg(os.getpgid(0), number)
    else:
        child.terminate()


if __name__ == "__main__":
    exit_code = main(sys.argv[1:])
    os._exit(exit_code)  # the thread that reads the input never ends by itself
