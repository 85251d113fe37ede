"""Why a point has a match, or has none."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """State of one point; every value but GOOD goes with NaN."""

    GOOD = 0
    NOT_REACHED = 1  # no start value led here
    NO_CONVERGENCE = 2  # the iteration did not settle
    LOW_ZNCC = 3  # it settled on something that does not look alike
    INCONSISTENT = 4  # it contradicts its neighbours
    OUTSIDE = 5  # the subset leaves the current image
    NO_TEXTURE = 6  # too little contrast, or too few pixels inside the mask
