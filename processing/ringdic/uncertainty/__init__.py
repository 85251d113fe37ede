"""How sure the numbers are: from the noise of the images to matches, points, displacements and strains."""

from ringdic.uncertainty.position import position_sigma

__all__ = ["position_sigma"]
