"""Digital image correlation of two images: the displacement of points of a reference image in a current image.

``prepare_reference`` and ``prepare_current`` filter the images once, ``grid`` lays the points, ``correlate_points``
matches them. The room knows images, masks and points only: no camera, no calibration, no session.

``correlate``      matches of the points of one image pair: start values, refinement, outliers
``prepared``       reference and current images with their gradients and B-spline coefficients
``seeds``          start values between images of one camera; ``features`` between cameras
``hypotheses``     the best of many given affine warps at each point, for start values that come from geometry
``lattice_field``  values between matches on a lattice
``propagation``    reliability-guided propagation from matched points to their neighbours
``neighbours``     neighbours of points, and outliers and extrapolations judged from them
``quadratic``      least-squares quadratics of any field over the neighbours of each point
``refinement``     inverse-compositional Gauss-Newton of many points, by the compiled ``kernels``
``kernels``        the iteration of one subset, on ``subset``, ``level_sums``, ``interpolation``, ``warps``, ``lanes``
``repetition``     search for a pattern that repeats itself, whose matches can be wrong by its period
``parallel``       kernels on several threads
``spline``         B-spline coefficients and gradients of an image, by the compiled ``filters``
``bench``          speed of the correlation on this machine, against the limits of its processor by ``machine``
``command``        the correlation of two image files
"""

from ringdic.correlation.correlate import PointMatches, as_start_values, correlate_independently, correlate_points
from ringdic.correlation.grid import grid
from ringdic.correlation.hypotheses import WarpHypotheses, search_hypotheses, search_warps
from ringdic.correlation.prepared import Current, Reference, prepare_current, prepare_reference
from ringdic.correlation.refinement import reference_bytes
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status

__all__ = [
    "CorrelationSettings",
    "Current",
    "PointMatches",
    "Reference",
    "Status",
    "WarpHypotheses",
    "as_start_values",
    "correlate_independently",
    "correlate_points",
    "grid",
    "prepare_current",
    "prepare_reference",
    "reference_bytes",
    "search_hypotheses",
    "search_warps",
]
