"""Errors of the library: bad input, which the operator can correct, and input that does not determine a result.

RingdicError
├── InputError        the images, the rig file or the settings are at fault: exit code 2
└── ComputationError  the input is valid but the result cannot be computed: exit code 3
"""

from __future__ import annotations


class RingdicError(Exception):
    """Base class of errors whose message tells the operator what is wrong, in which file or camera, and what to do."""

    exit_code = 1


class InputError(RingdicError, ValueError):
    """Bad input: an unknown key, a missing folder, an unreadable image, an empty mask."""

    exit_code = 2


class ComputationError(RingdicError, RuntimeError):
    """Valid input that does not determine a result: no texture in common, a board seen from one side only."""

    exit_code = 3


# Extras of the installation and the packages that each brings, by the names under which they are imported.
_EXTRAS = {
    "processing": ("cv2", "h5py", "matplotlib", "numba", "PIL", "pydantic", "rich", "scipy", "trimesh", "typer"),
    "controller": ("argon2", "cryptography", "fastapi", "itsdangerous", "uvicorn"),
    "cluster": ("dask", "distributed"),
    "viewer": ("pyvista",),
}


def missing_extra(error: ModuleNotFoundError) -> InputError | None:
    """The sentence that names the extra to install when a package of an extra could not be imported.

    Returns None for a package of no extra: then the installation is damaged, or the code is wrong.
    """
    package = (error.name or "").partition(".")[0]
    for extra, packages in _EXTRAS.items():
        if package in packages:
            return InputError(
                f"this needs the extra '{extra}', which is not installed ({package} is missing); "
                f"install it with: pip install 'ringdic[{extra}]'"
            )
    return None
