"""Layout of results.h5, the one HDF5 file that holds the results of a processing run.

::

    results.h5
      VTKHDF/                    moving triangles with the arrays that all fields follow from: opens in ParaView (a lost
                                 point stays at its reference position there, with ``measured`` = 0 and NaN fields)
      ringdic/                   attributes: schema, rig, steps, pairs, cameras, fields (JSON where not plain)
        reference                (N, 3) mm
        faces, pair, vertex_pair
        rigid_motion/R, t        per step, the motion that takes it back onto the reference
        cameras/<id>/            P, size, and K, distortion where the lens is known
        unmeasured/<id>/         textured places of a camera's reference image without a measurement: px, status, area
                                 (mm², the camera's share), attribute spacing (px); absent where not determined
        matches/<k>/             2D matches of a camera pair, or of a camera alone: xy, px, c_ls, sigma, status, vertex
        settings, calibration, summary    text: TOML, JSON, JSON

Fields are computed from the stored arrays when they are read: a step takes about 100 bytes a point, 130 a triangle.
Standard deviations are stored in two parts, ``sigma_…`` by image noise alone and ``sigma_…calibration…``; fields join
them.
A reader ignores groups, arrays and attributes that it does not know, and refuses a file of another schema than its own.
The schema number is raised by a change that an older reader would misunderstand.
"""

from __future__ import annotations

SCHEMA = 2

#: Arrays that are stored for every step, of points in PointData and of triangles in CellData; the other fields follow
#: from them and from the positions.
STEP_ARRAYS = (
    "displacement", "correlation", "sigma_xyz", "sigma_displacement", "chi2",
    "J", "lambda1", "lambda2", "E1", "E2", "E_tensor", "direction1_reference", "direction1_current", "isotropy",
    "linear1", "linear2",
    "sigma_calibration", "sigma_displacement_calibration", "sigma_lambda_calibration1", "sigma_lambda_calibration2",
    "face_correlation", "sigma_lambda1", "sigma_lambda2", "window_lambda1", "window_lambda2", "window_E1", "window_E2",
    "window_sigma_lambda1", "window_sigma_lambda2",
)  # fmt: skip

#: Arrays of the triangles that are stored once, since they are the same at every step.
CONSTANT_ARRAYS = ("area", "pair")
