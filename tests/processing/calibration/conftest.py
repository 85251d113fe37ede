"""Lets the tests of calibration share a module: with pytest's importlib mode, siblings are not found by themselves."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
