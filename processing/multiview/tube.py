"""Triangles over the measured nodes of a lattice: closed round the ring where the nodes are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def lattice_faces(xyz: Array) -> tuple[Ints, tuple[Ints, Ints]]:
    """Triangles between the measured nodes of a lattice (columns, rows, 3) mm that closes from the last column to the
    first; NaN where not measured.

    Returns faces (M, 3), counter-clockwise seen from outside, and the columns and rows (n,) of the points they use.
    A cell with four corners is divided along its shorter diagonal, one with three is one triangle.
    """
    columns, rows = xyz.shape[:2]
    measured = np.isfinite(xyz).all(axis=2)
    index = np.where(measured, np.arange(columns * rows).reshape(columns, rows), -1)
    onward = np.roll(index, -1, axis=0)
    a, b, c, d = index[:, :-1].ravel(), onward[:, :-1].ravel(), onward[:, 1:].ravel(), index[:, 1:].ravel()
    flat = xyz.reshape(-1, 3)
    whole = (a >= 0) & (b >= 0) & (c >= 0) & (d >= 0)
    with np.errstate(invalid="ignore"):
        first = np.linalg.norm(flat[a] - flat[c], axis=1) <= np.linalg.norm(flat[b] - flat[d], axis=1)
    parts = [
        np.stack([a, b, c], 1)[whole & first],
        np.stack([a, c, d], 1)[whole & first],
        np.stack([a, b, d], 1)[whole & ~first],
        np.stack([b, c, d], 1)[whole & ~first],
    ]
    for p, q, r, missing in ((a, b, c, d), (b, c, d, a), (c, d, a, b), (d, a, b, c)):
        parts.append(np.stack([p, q, r], 1)[(p >= 0) & (q >= 0) & (r >= 0) & (missing < 0)])
    faces = np.concatenate(parts)
    used = np.unique(faces)
    renumber = np.full(columns * rows, -1, np.int64)
    renumber[used] = np.arange(len(used))
    return renumber[faces], (used // rows, used % rows)
