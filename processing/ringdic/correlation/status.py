"""Status of a point of a correlation: matched, or the reason why it is not."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """Status of one point; with any value but GOOD, its results are NaN."""

    GOOD = 0
    NOT_REACHED = 1  # no start value
    NO_CONVERGENCE = 2  # the iteration did not converge
    LOW_ZNCC = 3  # it converged, but the ZNCC is too low
    INCONSISTENT = 4  # the match contradicts those of its neighbours, or is far from its start value
    OUTSIDE = 5  # the subset leaves the current image
    NO_TEXTURE = 6  # too little contrast, or too few pixels inside the mask
    AMBIGUOUS = 7  # the pattern repeats itself there, so the match may be wrong by its period
