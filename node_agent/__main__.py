"""``python -m node_agent …`` is ``ringdic-node …``."""

import sys

from node_agent.cli import main

sys.exit(main())
