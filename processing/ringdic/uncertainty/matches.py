"""What a match's uncertainty is made of: the noise of one image, that of the other, and what is no noise.

A correlation states ``√2 σ √(H⁻¹)`` with σ from the residual of the subset. That is right where both images show the
pattern in the same way. Between cameras the residual also holds what each view makes of the same edges: it does not
change from exposure to exposure, it lies on the edges, where it counts most, and it does not average out. Here the
residual is parted by the noise that the images are known to have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats
from ringdic.uncertainty.texture import Texture

# The interpolation of the current image smooths its noise: the mean of the squared response of the quintic spline over
# all fractions of a pixel and frequencies, in two directions.
_SEEN = 0.85
# Mean square of the slopes of the interpolating quintic spline at the samples of white noise of unit variance.
_SLOPES = 1.894
# What is no noise goes with the slopes: it counts as much more than an even spread over the subset as they are peaked,
# less what signs that change along an edge cancel. The share is a measured one: with it and the noise alone the lines
# of sight of three exact cameras, 30° apart before a stretched limb, miss one another by χ² 0.94 a degree of freedom.
_LEFT = 0.7


@dataclass(frozen=True)
class MatchParts:
    """Standard deviations of n matches, px, each in its own image.

    reference : (n, 2) by the noise of the reference image. current : (n, 2) by that of the current image.
    systematic : (n, 2) in the current image, by what is no noise; reference_systematic : (n, 2) the same in pixels of
    the reference. Either image has its part in it, which no one pair can tell.
    """

    reference: Floats
    current: Floats
    systematic: Floats
    reference_systematic: Floats

    def __post_init__(self) -> None:
        shapes = {values.shape for values in vars(self).values()}
        if len(shapes) != 1 or shapes.pop()[-1:] != (2,):
            raise ValueError("the parts of a match's uncertainty have one shape, (..., 2)")


def match_parts(
    sigma: Floats,
    c_ls: Floats,
    textures: tuple[Texture, Texture],
    noise: tuple[float, float],
    gradient: Floats | None = None,
) -> MatchParts:
    """Part the standard deviations that a correlation states from its residuals.

    Parameters
    ----------
    sigma : (n, 2) px, √2 σ √(H⁻¹) as stated, in pixels of the reference. c_ls : (n,).
    textures : of the reference at the points and of the current image at their matches.
    noise : variances of the two images, grey levels².
    gradient : (n, 2, 2) of the displacement; none for zero, as in time.

    Where the noise would be more than the residual shows, the residual counts.
    """
    first, second = textures
    G = np.eye(2) if gradient is None else np.eye(2) + gradient
    area = np.abs(G[..., 0, 0] * G[..., 1, 1] - G[..., 0, 1] * G[..., 1, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = first.contrast**2 * c_ls
        # The diagonal of H⁻¹, whose H must not count the slopes of the noise: they tell no place and let noise in.
        clean = first.clean(noise[0])
        unit = sigma**2 / residual[:, None] * (1.0 + noise[0] * _SLOPES / clean) ** 2
        # Grey levels of the current image are scaled to the reference's contrast before they are compared.
        seen = noise[0] + _SEEN * noise[1] * (first.contrast / second.contrast) ** 2
        real = np.minimum(1.0, residual / seen)
        reference = unit * (real * noise[0])[:, None]
        # The current image locates the same patch of the surface by its own slopes and its own number of pixels.
        own = second.spread(noise[1]) / first.spread(noise[0])
        current = unit * own * (real * noise[1] / area)[:, None]
        other = np.maximum(0.0, 1.0 - seen / residual)
        systematic = sigma**2 * (_LEFT * first.peaked * other)[:, None]
    there = np.einsum("...ij,...j->...i", G**2, systematic)
    return MatchParts(np.sqrt(reference), np.sqrt(current), np.sqrt(there), np.sqrt(systematic))
