"""``python -m controller …`` is ``ringdic …``."""

from controller.cli import main

main()
