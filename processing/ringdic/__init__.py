"""Multi-view 3D digital image correlation: from images of calibrated cameras to displacement and strain of a surface.

Conventions, stated once
------------------------
Lengths are millimetres, image positions pixels, angles radians (degrees only in ``rig.toml``).

Pixel
    (0, 0) is the centre of the top-left pixel, x to the right, y down. A position is ``(x, y)``; an image array
    is indexed ``[y, x]``.
World
    The frame of the calibration target: z along the cylinder's axis, upwards, z = 0 at its lower edge; dot
    column 1 lies on +x; columns run counter-clockwise seen from +z. Right-handed.
Camera
    Poses map world to camera: ``X_camera = R X_world + t``; camera axes x right, y down, z forward.
    ``K = [[fx, s, cx], [0, fy, cy], [0, 0, 1]]``; ``distortion = (k1, k2, p1, p2, k3)`` after Brown-Conrady.
    A *distorted* pixel is what the image shows. An *undistorted* pixel is ``(fx x + cx, fy y + cy)``: the skew
    goes with the distortion. Projection matrices ``P`` (3, 4) and the DLT parameters act on undistorted pixels.
Mesh
    Triangles are vertex indices (M, 3), counter-clockwise seen from outside: normals point outwards.
Correlation
    ``C_LS = 2 (1 - ZNCC)`` from 0 (best) to 4. Displacement ``uv`` is current minus reference position, given at
    the reference position; ``gradient[i, j] = d u_i / d x_j``.
Deformation
    ``F`` maps reference to current; ``C = FᵀF``, ``E = (C - I)/2``, ``e = (I - B⁻¹)/2``; λ1 ≤ λ2 are the in-plane
    principal stretches, ``J = λ1 λ2``.
Lost points
    A point that could not be measured is NaN and carries a status; it is never an exception and never zero.

The front door
--------------
``ringdic.api`` offers what is listed in ``__all__``; the names are loaded when they are first used. Below it lie the
rooms, by storey: ``jobs`` processes whole sessions; ``report`` writes their reports; ``charts`` measures the surface,
``export``, ``pictures`` and ``measure`` make something of it; ``results`` holds fields and the results' file;
``uncertainty``; ``calibration`` and ``correlation``; ``tasks`` keeps what was computed; ``session`` reads what was
captured, ``strain`` computes the deformation of a mesh and ``merging`` makes several meshes one; ``mesh`` and
``geometry``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ringdic.compiled import choose_cache_folder
from ringdic.errors import ComputationError, InputError, RingdicError, missing_extra

if TYPE_CHECKING:
    from ringdic.api import Correlation, correlate, import_folder, process, read_run
    from ringdic.jobs.run import Run
    from ringdic.session.folder import Session, open_session
    from ringdic.settings import Settings, load_settings

__version__ = "0.2.0"

__all__ = [
    "ComputationError",
    "Correlation",
    "InputError",
    "RingdicError",
    "Run",
    "Session",
    "Settings",
    "__version__",
    "correlate",
    "import_folder",
    "load_settings",
    "open_session",
    "process",
    "read_run",
]

_MODULES = {
    "Correlation": "ringdic.api",
    "Run": "ringdic.jobs.run",
    "Session": "ringdic.session.folder",
    "Settings": "ringdic.settings",
    "correlate": "ringdic.api",
    "import_folder": "ringdic.api",
    "load_settings": "ringdic.settings",
    "open_session": "ringdic.session.folder",
    "process": "ringdic.api",
    "read_run": "ringdic.api",
}

choose_cache_folder()  # before any kernel is imported


def __getattr__(name: str) -> Any:
    """A public name, whose module is loaded now: importing the package alone is quick."""
    if name not in _MODULES:
        raise AttributeError(f"module 'ringdic' has no attribute '{name}'")
    try:
        value = getattr(import_module(_MODULES[name]), name)
    except ModuleNotFoundError as error:
        raise missing_extra(error) or error from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
