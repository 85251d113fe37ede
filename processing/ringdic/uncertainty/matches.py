"""Standard deviations of matches by cause: the noise of the reference image, that of the current one, and the rest.

A correlation states the standard deviation ``√2 σ √(H⁻¹)``, with σ from the residual of the subset. That is right where
both images show the pattern in the same way. Between two cameras the residual also contains the differences
between the two views of the same edges. This part does not change from exposure to exposure, it lies on the edges,
where the slopes are largest, and it does not average out. Here the known noise of the images splits the residual into
these parts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Pixels
from ringdic.uncertainty.texture import Texture

# Share of the current image's noise variance that is left after its interpolation: the mean of the squared response of
# the quintic spline over all fractions of a pixel and frequencies, in two directions.
INTERPOLATED_NOISE = 0.85
# Mean square of the slopes of the interpolating quintic spline at the samples of white noise of unit variance.
_SLOPES = 1.894
# The part that is no noise lies where the slopes are, so it counts more than evenly spread residuals by the peakedness
# of the slopes; where its sign changes along an edge it cancels in part. This share of it remains, by measurement: with
# it the lines of sight of three exact cameras, 30° apart, on a stretched limb have χ² 0.94 a degree of freedom.
_REMAINING = 0.7
# Between images of one camera the residual that is no noise comes from edges that a turned surface shows sharper or
# more blurred, on both of their sides alike: less of it remains, by measurement on limbs turned by 10°, 20° and 40°.
_REMAINING_IN_TIME = 0.42


@dataclass(frozen=True)
class MatchUncertainty:
    """Standard deviations of n matches by cause, (n, 2) px each.

    reference : due to the noise of the reference image, in its pixels. current : due to the noise of the current image,
    in its pixels. systematic : due to the residual that is not noise, in pixels of the current image.
    reference_systematic : that part in pixels of the reference image. How much of it is due to either image cannot be
    known from one pair.
    """

    reference: Pixels
    current: Pixels
    systematic: Pixels
    reference_systematic: Pixels

    def __post_init__(self) -> None:
        shapes = {values.shape for values in vars(self).values()}
        if len(shapes) != 1 or shapes.pop()[-1:] != (2,):
            raise ValueError("the parts of a match's uncertainty have one shape, (..., 2)")


def match_uncertainty(
    sigma: Pixels,
    c_ls: Floats,
    textures: tuple[Texture, Texture],
    noise: tuple[float, float],
    gradient: Floats | None = None,
) -> MatchUncertainty:
    """Split the standard deviations of matches by cause: noise of either image, and systematic residual.

    Where the known noise would give a larger residual than the correlation has, the noise is scaled down to it.

    Parameters
    ----------
    sigma : (n, 2) px, √2 σ √(H⁻¹) as the correlation states it, in pixels of the reference image.
    c_ls : (n,) C_LS of the correlation.
    textures : of the reference image at the points, and of the current image at their matches.
    noise : variances of the noise of the two images, grey levels².
    gradient : (n, 2, 2) gradient of the displacement; None for zero, as between images of one camera.
    """
    first, second = textures
    G = np.eye(2) if gradient is None else np.eye(2) + gradient
    area = np.abs(G[..., 0, 0] * G[..., 1, 1] - G[..., 0, 1] * G[..., 1, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = first.contrast**2 * c_ls
        # The diagonal of H⁻¹ without the noise's own slopes, which carry no position and pass noise on.
        clean = first.clean_slopes(noise[0])
        unit = sigma**2 / residual[:, None] * (1.0 + noise[0] * _SLOPES / clean) ** 2
        # Grey levels of the current image are scaled to the reference's contrast before they are compared.
        expected = noise[0] + INTERPOLATED_NOISE * noise[1] * (first.contrast / second.contrast) ** 2
        real = np.minimum(1.0, residual / expected)
        reference = unit * (real * noise[0])[:, None]
        # The current image locates the same patch of the surface by its own slopes and its own number of pixels.
        own = second.inverse_diagonal(noise[1]) / first.inverse_diagonal(noise[0])
        current = unit * own * (real * noise[1] / area)[:, None]
        other = np.maximum(0.0, 1.0 - expected / residual)
        remaining = _REMAINING_IN_TIME if gradient is None else _REMAINING
        systematic = sigma**2 * (remaining * first.peakedness * other)[:, None]
    in_current = np.einsum("...ij,...j->...i", G**2, systematic)
    return MatchUncertainty(np.sqrt(reference), np.sqrt(current), np.sqrt(in_current), np.sqrt(systematic))
