"""Distances along a triangle mesh: what lies near a place when one stays on the surface.

Paths run along edges and straight across pairs of triangles that share an edge, unfolded into one plane. On a regular
mesh such a path is at most 8 % longer than the shortest one (the worst direction lies 22.5° from both).
"""

from __future__ import annotations

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices
from ringdic.mesh.mesh import Mesh

#: A path of :func:`step_graph` may be this much longer than the shortest one.
DETOUR = 1.1
_BLOCK = 256  # sources of one run of Dijkstra's algorithm, chosen near one another


def step_graph(mesh: Mesh) -> scipy.sparse.csr_matrix:
    """Lengths (N, N), symmetric, mm, of the single steps between vertices: edges, and straight across shared edges.

    A triangle that has lost a corner takes no part.
    """
    mesh = mesh.without_lost()
    i, j, length = (np.concatenate(parts) for parts in zip(_edges(mesh), _crossings(mesh), strict=True))
    count = len(mesh.vertices)
    keep = np.unique(i * count + j, return_index=True)[1]  # a pair named twice counts once
    i, j, length = i[keep], j[keep], length[keep]
    return scipy.sparse.csr_matrix(
        (np.concatenate([length, length]), (np.concatenate([i, j]), np.concatenate([j, i]))), (count, count)
    )


def reach(mesh: Mesh, distance: float) -> scipy.sparse.csr_matrix:
    """Which vertices are reached from which within ``distance`` mm along the mesh: (N, N), 1 if so, 1 for itself."""
    graph = step_graph(mesh)
    finite = np.flatnonzero(np.isfinite(mesh.vertices).all(axis=1))
    tree = scipy.spatial.cKDTree(mesh.vertices[finite])
    blocks: list[scipy.sparse.csr_matrix] = []
    order = finite[_along_cells(mesh.vertices[finite], _BLOCK)]
    for start in range(0, len(order), _BLOCK):
        sources = order[start : start + _BLOCK]
        near = _near(tree, finite, mesh.vertices[sources], distance)
        path = scipy.sparse.csgraph.dijkstra(
            graph[near][:, near], indices=np.searchsorted(near, sources), limit=distance
        )
        at, to = np.nonzero(np.isfinite(path))
        blocks.append(scipy.sparse.csr_matrix((np.ones(len(at)), (at, near[to])), (len(sources), len(mesh.vertices))))
    count = len(mesh.vertices)
    if not blocks:
        return scipy.sparse.csr_matrix((count, count))
    found = scipy.sparse.vstack(blocks, format="coo")
    return scipy.sparse.csr_matrix((found.data, (order[found.row], found.col)), (count, count))


def _edges(mesh: Mesh) -> tuple[Indices, Indices, Floats]:
    edges, _ = mesh.edges()
    return edges[:, 0], edges[:, 1], np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)


def _crossings(mesh: Mesh) -> tuple[Indices, Indices, Floats]:
    """Opposite corners of two triangles at one edge, if the straight line in the unfolded plane crosses that edge."""
    directed = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    opposite = mesh.faces[:, [2, 0, 1]].reshape(-1)
    unique, inverse, count = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(inverse.reshape(-1), kind="stable")
    first = (np.cumsum(count) - count)[count == 2]
    i, j = opposite[order[first]], opposite[order[first + 1]]
    a, b = (mesh.vertices[unique[count == 2][:, k]] for k in (0, 1))
    p, q = mesh.vertices[i], mesh.vertices[j]
    along = b - a
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    (px, py), (qx, qy) = ((_dot(c - a, along), _height(c - a, along)) for c in (p, q))
    crossing = px + (qx - px) * py / np.maximum(py + qy, 1e-300)  # where the line meets the edge, from a
    direct = (crossing > 0) & (crossing < length)
    i, j = i[direct], j[direct]
    return np.minimum(i, j), np.maximum(i, j), np.hypot(qx - px, py + qy)[direct]


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("ij,ij->i", a, b)


def _height(a: Floats, unit: Floats) -> Floats:
    return np.linalg.norm(a - _dot(a, unit)[:, None] * unit, axis=1)


def _along_cells(points: Floats, block: int) -> Indices:
    """An order of points (n, 3) in which ``block`` that follow one another lie together: cells of a bisection."""
    order = np.arange(len(points))
    pending, done = [order], []
    while pending:
        part = pending.pop()
        if len(part) <= block:
            done.append(part)
            continue
        axis = np.ptp(points[part], axis=0).argmax()
        half = len(part) // 2 // block * block or len(part) // 2
        part = part[np.argpartition(points[part, axis], half)]
        pending += [part[half:], part[:half]]
    return np.concatenate(done) if done else order


def _near(tree: scipy.spatial.cKDTree, index: Indices, points: Floats, distance: float) -> Indices:
    """Sorted vertices in the ball round all of ``points`` that is ``distance`` larger than they need."""
    middle = points.mean(axis=0)
    radius = float(np.linalg.norm(points - middle, axis=1).max()) + distance
    return np.sort(index[tree.query_ball_point(middle, radius)])
