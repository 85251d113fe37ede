"""``python -m ringdic_node …`` is ``ringdic-node …``."""

import sys

from ringdic_node.cli import main

sys.exit(main())
