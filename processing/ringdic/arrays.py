"""Types of arrays, named by what the arrays hold. Shapes and units are given where an array is used.

The types say for the reader what an array means; to the type checker the float arrays are all alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Numbers without one of the meanings below: parameters, weights, values of a field, tensors."""

Points = NDArray[np.float64]
"""Positions in space in the world frame, (..., 3) mm."""

Vectors = NDArray[np.float64]
"""Displacements, normals and directions in space, (..., 3)."""

Pixels = NDArray[np.float64]
"""Positions or displacements in an image, (..., 2) px, x before y; (0, 0) is the centre of the top-left pixel."""

Mask = NDArray[np.bool_]
"""Which pixels, points or triangles are meant."""

Indices = NDArray[np.int64]
"""Numbers of points, triangles (M, 3) or cameras, counted from 0."""

Image = NDArray[np.uint8] | NDArray[np.uint16]
"""Grey levels of an image as its file holds them, (height, width)."""
