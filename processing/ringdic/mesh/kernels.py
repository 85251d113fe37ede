"""Compiled loops over the triangles of a mesh: area vectors, and sums of vectors at the vertices."""

from __future__ import annotations

import math

import numba as nb


@nb.njit(cache=True, nogil=True)
def area_vectors(vertices, faces, out):  # type: ignore[no-untyped-def]
    """Fill out (M, 3) mm² with the area vectors of triangles: normal to them, with the length of their areas.

    vertices (N, 3) mm. faces (M, 3) vertex indices.
    """
    for m in range(len(faces)):
        a, b, c = vertices[faces[m, 0]], vertices[faces[m, 1]], vertices[faces[m, 2]]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            out[m, k] = 0.5 * ((b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i]))


@nb.njit(cache=True, nogil=True)
def corner_sums(vectors, faces, total):  # type: ignore[no-untyped-def]
    """Add the vectors (M, 3) of the triangles to the sums at their corners; total (N, 3) is changed in place.

    faces (M, 3) vertex indices. A vector that is not finite is left out.
    """
    for corner in range(3):
        for m in range(len(faces)):
            if math.isfinite(vectors[m, 0] + vectors[m, 1] + vectors[m, 2]):
                for k in range(3):
                    total[faces[m, corner], k] += vectors[m, k]
