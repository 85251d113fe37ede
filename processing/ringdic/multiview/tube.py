"""Triangulation of the measured nodes of a lattice about an axis, closed all round, with small holes filled.

No vertex is added: a hole is filled with triangles between the measured nodes about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ringdic.arrays import Indices, Points
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.polygon import triangulate_polygon
from ringdic.mesh.topology import pieces, without_pinches

_LARGEST_HOLE = 5.0  # mm², of a hole that is filled
_MOST_NODES = 16  # lost nodes of a hole that may be filled
_LEAST_PIECE = 32  # triangles of a piece that stays, about those of a subset: points of a smaller one cannot be judged


@dataclass(frozen=True)
class _Nodes:
    """The nodes of a lattice whose last column adjoins the first. xyz : (columns, rows, 3) mm, NaN where lost."""

    xyz: Points

    @property
    def index(self) -> Indices:
        """Number of each node, (columns, rows) int, column by column; -1 where lost."""
        numbers = np.arange(self.xyz[..., 0].size).reshape(self.xyz.shape[:2])
        return np.where(np.isfinite(self.xyz).all(axis=2), numbers, -1)

    def mesh(self, faces: Indices) -> Mesh:
        """Mesh of some triangles (M, 3) between nodes; its vertices are all nodes of the lattice."""
        return Mesh(self.xyz.reshape(-1, 3), faces)

    def coordinates(self, node: Indices) -> Indices:
        """Column and row (n, 2) of nodes (n,)."""
        return np.stack(np.divmod(node, self.xyz.shape[1]), axis=-1)

    def unrolled(self, node: Indices) -> Indices:
        """Column and row (n, 2) of nodes (n,) near one another, the columns without a jump from the last to
        the first.
        """
        coordinates = self.coordinates(node)
        columns = self.xyz.shape[0]
        coordinates[:, 0] = (
            coordinates[0, 0] + (coordinates[:, 0] - coordinates[0, 0] + columns // 2) % columns - columns // 2
        )
        return coordinates


def lattice_faces(xyz: Points) -> tuple[Indices, tuple[Indices, Indices]]:
    """Triangulate the measured nodes of a lattice whose last column adjoins the first.

    A cell with four measured corners is divided along its shorter diagonal, one with three is one triangle. Holes of a
    single lost node, or of up to 5 mm², are filled. Where two parts of the surface would touch in one point only, the
    smaller one is left out, and so are small separate pieces.

    xyz : (columns, rows, 3) float64, mm, NaN where not measured. Returns faces (M, 3) int, counter-clockwise seen from
    outside, and the columns and rows (n,) int of the nodes that they use.
    """
    nodes = _Nodes(xyz)
    faces = _cells(nodes)
    faces = np.concatenate([faces, _fillings(nodes, faces)])
    faces = faces[without_pinches(nodes.mesh(faces), np.ones(len(faces)))]
    mesh, used = nodes.mesh(_without_scraps(nodes.mesh(faces))).compact()
    column, row = nodes.coordinates(used).T
    return mesh.faces, (column, row)


def _cells(nodes: _Nodes) -> Indices:
    """One or two triangles (M, 3) in every cell of the lattice with three or four measured corners."""
    index = nodes.index
    onward = np.roll(index, -1, axis=0)
    a, b, c, d = index[:, :-1].ravel(), onward[:, :-1].ravel(), onward[:, 1:].ravel(), index[:, 1:].ravel()
    flat = nodes.xyz.reshape(-1, 3)
    complete = (a >= 0) & (b >= 0) & (c >= 0) & (d >= 0)
    with np.errstate(invalid="ignore"):
        first_is_shorter = np.linalg.norm(flat[a] - flat[c], axis=1) <= np.linalg.norm(flat[b] - flat[d], axis=1)
    parts = [
        np.stack([a, b, c], 1)[complete & first_is_shorter],
        np.stack([a, c, d], 1)[complete & first_is_shorter],
        np.stack([a, b, d], 1)[complete & ~first_is_shorter],
        np.stack([b, c, d], 1)[complete & ~first_is_shorter],
    ]
    for p, q, r, missing in ((a, b, c, d), (b, c, d, a), (c, d, a, b), (d, a, b, c)):
        parts.append(np.stack([p, q, r], 1)[(p >= 0) & (q >= 0) & (r >= 0) & (missing < 0)])
    return np.concatenate(parts)


def _fillings(nodes: _Nodes, faces: Indices) -> Indices:
    """Triangles (k, 3) that fill the small holes of the surface of some triangles (M, 3)."""
    edges = nodes.mesh(faces).boundary_edges()
    holes, size = _holes(nodes)
    lost_node = _adjacent_lost_node(nodes, edges)
    hole = np.where(lost_node[:, 1] >= 0, holes[lost_node[:, 0], np.maximum(lost_node[:, 1], 0)], -1)
    fillings = [np.empty((0, 3), np.int64)]
    small = np.flatnonzero((size <= _MOST_NODES)[np.maximum(hole, 0)] & (hole >= 0))
    if not len(small):
        return np.empty((0, 3), np.int64)
    small = small[np.argsort(hole[small], kind="stable")]
    first = np.flatnonzero(np.diff(hole[small], prepend=-1))
    for number, loop_edges in zip(hole[small[first]], np.split(edges[small], first[1:]), strict=True):
        loop = _loop(loop_edges)
        if loop is None:
            continue
        # On the lattice itself the outline never folds over, however the surface lies in space.
        outline = np.column_stack([nodes.unrolled(loop), np.zeros(len(loop))]).astype(np.float64)
        triangles = triangulate_polygon(outline, np.array([0.0, 0.0, 1.0]))
        if triangles is None:
            continue
        filling = nodes.mesh(loop[triangles])
        if filling.areas.sum() <= _LARGEST_HOLE or size[number] == 1:
            fillings.append(filling.faces)
    return np.concatenate(fillings)


def _holes(nodes: _Nodes) -> tuple[Indices, Indices]:
    """Groups of lost nodes that lie side by side or corner to corner.

    Returns the number of each node's group (columns, rows), -1 where measured, and the sizes of the groups, which
    count as endless where the group touches the first or last row.
    """
    lost = nodes.index < 0
    columns, rows = lost.shape
    numbers = np.arange(lost.size).reshape(lost.shape)
    links = []
    for step in (-1, 0, 1):
        following = np.roll(numbers, -1, axis=0)
        low, high = max(0, -step), rows - max(0, step)
        here, there = numbers[:, low:high], following[:, low + step : high + step]
        links.append((here, there))
    links.append((numbers[:, :-1], numbers[:, 1:]))
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in links])
    flat = lost.ravel()
    pairs = pairs[flat[pairs].all(axis=1)]
    joined = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(lost.size, lost.size))
    count, label = connected_components(joined, directed=False)
    size = np.bincount(label, minlength=count)
    rims = label.reshape(columns, rows)[:, [0, -1]][lost[:, [0, -1]]]
    size[rims] = lost.size
    return np.where(flat, label, -1).reshape(columns, rows), size


def _adjacent_lost_node(nodes: _Nodes, edges: Indices) -> Indices:
    """Lost node (k, 2), column and row, in the cell on the open side of each border edge (k, 2); row -1 for none."""
    index = nodes.index
    columns, rows = index.shape
    start, end = nodes.coordinates(edges[:, 0]), nodes.coordinates(edges[:, 1])
    along = end - start
    along[:, 0] = (along[:, 0] + columns // 2) % columns - columns // 2
    middle = start + 0.5 * along + 0.5 * np.stack([along[:, 1], -along[:, 0]], axis=1)
    out = np.full((len(edges), 2), -1, np.int64)
    for corner in ((0, 0), (0.5, 0.5), (-0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)):
        at = middle + corner
        whole = (at == np.rint(at)).all(axis=1)
        column, row = np.rint(at).astype(np.int64).T
        column %= columns
        inside = whole & (row >= 0) & (row < rows) & (np.abs(along) <= 1).all(axis=1)
        lost = inside & (index[column, np.clip(row, 0, rows - 1)] < 0)
        out[lost] = np.stack([column, row], axis=1)[lost]
    return out


def _loop(edges: Indices) -> Indices | None:
    """Nodes (k,) of directed border edges (k, 2), counter-clockwise round the hole; None if not one closed loop."""
    onward = {int(b): int(a) for a, b in edges}  # against the triangles' sense, so that the hole lies to the left
    if len(onward) != len(edges):
        return None
    loop = [int(edges[0, 0])]
    while (following := onward.get(loop[-1])) is not None and following != loop[0]:
        if len(loop) > len(edges):
            return None
        loop.append(following)
    return np.array(loop) if following is not None and len(loop) == len(edges) else None


def _without_scraps(mesh: Mesh) -> Indices:
    """Triangles (M, 3) of the largest piece of a mesh and of all others that are not too small to be judged."""
    if not len(mesh.faces):
        return mesh.faces
    piece = pieces(mesh)
    triangles = np.bincount(piece)
    return mesh.faces[triangles[piece] >= min(_LEAST_PIECE, triangles.max())]
