"""Digital image correlation of two images: where every point of the reference lies in the current image.

``prepare_reference`` and ``prepare_current`` filter the images once, ``grid`` lays the points, ``correlate`` matches
them. The room knows images, masks and points only: no camera, no calibration, no session.

``kernels``      one subset by inverse-compositional Gauss-Newton, and many in parallel
``spline``       B-spline coefficients and gradients, by the compiled ``filters``
``propagation``  from matched points to their neighbours, in waves
``neighbours``   the neighbours' judgement: prediction, outliers, islands
``seeds``        first matches in time; ``features`` first matches between cameras
``quadratic``    a quadratic of any field over the neighbours of each point
``hypotheses``   many given warps tried at each point, for start values that come from geometry
``command``      the same for two files
"""

from ringdic.correlation.correlate import Correlation, correlate_points, refine_alone, start_order
from ringdic.correlation.grid import grid
from ringdic.correlation.hypotheses import Row, search_hypotheses, search_row
from ringdic.correlation.prepared import Current, Reference, prepare_current, prepare_reference
from ringdic.correlation.refinement import reference_bytes
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status

__all__ = [
    "Correlation",
    "CorrelationSettings",
    "Current",
    "Reference",
    "Row",
    "Status",
    "correlate_points",
    "grid",
    "prepare_current",
    "prepare_reference",
    "reference_bytes",
    "refine_alone",
    "search_hypotheses",
    "search_row",
    "start_order",
]
