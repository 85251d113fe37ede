"""The tutorial of the documentation, followed literally: its commands and its Python are run one after the other.

``python docs/tutorial.py`` runs it in ``build/tutorial`` and puts the picture that it ends in where the page shows it.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).parent / "pages" / "first_session.md"
PICTURE = "first_session.png"
_BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def script(page: Path = PAGE) -> list[tuple[str, str]]:
    """The blocks of a page that are run, in order: each "sh" or "python", and its text."""
    return _BLOCK.findall(page.read_text(encoding="utf-8"))


def follow(folder: Path, page: Path = PAGE) -> str:
    """Run the page's commands, then all of its Python in one process, in a folder; what they print.

    Raises CalledProcessError where one of them fails.
    """
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    blocks = script(page)
    commands = [shlex.split(line) for kind, text in blocks if kind == "sh" for line in text.splitlines()]
    commands.append(["python", "-c", "\n".join(text for kind, text in blocks if kind == "python")])
    printed = ""
    for program, *arguments in commands:
        if program != "python":
            raise ValueError(f"{page}: only 'python …' can be run for a reader, not '{program}'")
        done = subprocess.run(
            [sys.executable, *arguments], cwd=folder, env=environment, check=True, text=True, stdout=subprocess.PIPE
        )
        printed += done.stdout
    return printed


def main() -> None:
    """Follow the tutorial and keep its picture for the page."""
    folder = Path(__file__).parents[1] / "build" / "tutorial"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    sys.stdout.write(follow(folder))
    shutil.copyfile(folder / PICTURE, PAGE.parent / "images" / PICTURE)


if __name__ == "__main__":
    main()
