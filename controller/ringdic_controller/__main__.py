"""``python -m ringdic_controller …`` is ``ringdic …``."""

from ringdic_controller.cli.app import main

main()
