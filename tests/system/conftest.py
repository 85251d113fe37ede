"""The whole program as an operator runs it, as processes of its own."""

import subprocess
import sys
from collections.abc import Callable

import pytest


@pytest.fixture(scope="session")
def ringdic() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Call it with the arguments of a command: it runs to its end, and must end with ``code``, in ``timeout_s``."""

    def run(*arguments: object, code: int = 0, timeout_s: float = 120) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-P", "-m", "ringdic", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
        assert done.returncode == code, f"{command} ended with {done.returncode}, not {code}:\n{done.stderr}"
        return done

    return run
