"""Types of arrays, named by what the arrays hold. Shapes and units are given where an array is used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Numbers, positions and vectors."""

Mask = NDArray[np.bool_]
"""One truth value for each pixel or point."""

Radiance = NDArray[np.float32]
"""Light that reaches a pixel, (height, width), 1 for a white surface that faces the lamps."""

Image = NDArray[np.uint8]
"""Grey levels as a camera delivers them, (height, width)."""
