"""How the triangles of a surface hang together: borders, holes, pieces, and places covered twice.

A surface is *sound* when every edge has one or two triangles that run along it in opposite directions, every vertex
one fan of triangles, and no place is covered twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask
from ringdic.mesh.adjacency import fan_numbers, piece_numbers, twins, vertices_of_several_fans
from ringdic.mesh.mesh import Mesh, half_edges
from ringdic.mesh.projection import line_hits

#: Where a triangle is looked at for a second layer: its middle and the middles of its corner parts.
_SAMPLES = np.array([[1 / 3, 1 / 3, 1 / 3], [2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]])


class Kind(Enum):
    """What a border goes round."""

    HOLE = "hole"  # the surface lies all round it
    RIM = "rim"  # the outer border of a sheet
    END = "end"  # of a tube


@dataclass(frozen=True)
class Border:
    """One closed line of edges with a triangle on one side only.

    loop : (n,) vertices in the direction in which the triangles run along it; where two borders touch in a vertex,
    that vertex is passed twice. area : mm², of the vector area that the line encloses (the cross-section of a
    tube for its end). turning : geodesic curvature along the line in full turns: +1 for a flat sheet's rim, -1 for a
    flat hole, 0 for a cylinder's end, however ragged (theorem of Gauss and Bonnet).
    """

    loop: Indices
    area: float
    turning: float

    @property
    def kind(self) -> Kind:
        """Hole, rim or end: the nearest whole number of turns."""
        return Kind.HOLE if self.turning < -0.5 else Kind.RIM if self.turning > 0.5 else Kind.END


def non_manifold_edges(mesh: Mesh) -> Indices:
    """Edges (K, 2) with more than two triangles."""
    edges, count = mesh.edges()
    return edges[count > 2]


def inconsistent_edges(mesh: Mesh) -> Indices:
    """Edges (K, 2) along which two triangles run in the same direction: one of them is turned over."""
    half = half_edges(mesh.faces)
    unique, count = np.unique(half[:, 0] * len(mesh.vertices) + half[:, 1], return_counts=True)
    return np.stack(np.divmod(unique[count > 1], len(mesh.vertices)), axis=1)


def non_manifold_vertices(mesh: Mesh) -> Indices:
    """Vertices (K,) where triangles meet in more than one fan: two pieces or two borders touch in a point."""
    corners = mesh.faces.ravel()
    return np.unique(corners[vertices_of_several_fans(corners, fans(mesh))])


def fans(mesh: Mesh) -> Indices:
    """Number of the fan of each corner, (3M,): the corners at a vertex whose triangles hang together round it."""
    return np.asarray(fan_numbers(half_edges(mesh.faces)))


def without_pinches(mesh: Mesh, weights: Floats | None = None) -> Mask:
    """Triangles (M,) left when at every vertex only the fan of the largest weight stays, of equal ones the first.

    weights : (M,) float64, mm², of the triangles; their areas where None is given.
    """
    weights = np.nan_to_num(mesh.areas) if weights is None else weights
    kept = np.ones(len(mesh.faces), bool)
    while True:
        left = np.flatnonzero(kept)
        part = Mesh(mesh.vertices, mesh.faces[left])
        fan = fans(part)
        pinched = vertices_of_several_fans(part.faces.ravel(), fan)
        if not pinched.any():
            return kept
        weight = np.bincount(fan, np.repeat(weights[left], 3))
        corners = np.flatnonzero(pinched)
        # The largest fan of each vertex: the last of its corners in order of the fan's weight.
        order = np.lexsort((-fan[corners], weight[fan[corners]], part.faces.ravel()[corners]))
        corners = corners[order]
        vertex = part.faces.ravel()[corners]
        last = np.flatnonzero(np.append(vertex[1:] != vertex[:-1], True))
        largest = np.repeat(fan[corners[last]], np.diff(np.append(-1, last)))
        kept[left[np.unique(corners[fan[corners] != largest] // 3)]] = False


def pieces(mesh: Mesh) -> Indices:
    """Number of the connected piece of each triangle, (M,): triangles hang together by shared edges."""
    return np.asarray(piece_numbers(half_edges(mesh.faces)))


def borders(mesh: Mesh) -> tuple[Border, ...]:
    """All borders of a surface, the longest first.

    Raises ValueError for a surface with non-manifold edges or triangles turned over: its borders have no direction.
    """
    if len(non_manifold_edges(mesh)) or len(inconsistent_edges(mesh)):
        raise ValueError("a surface with non-manifold edges or triangles turned over has no borders in order")
    half = half_edges(mesh.faces)
    twin = twins(half)
    following = np.arange(len(half)) // 3 * 3 + (np.arange(len(half)) + 1) % 3
    angle = _corner_angles(mesh).ravel()
    border = np.flatnonzero(twin < 0)
    # From the end of a border edge, round its triangles to the next border edge of the same fan.
    ahead = following[border]
    inner_angle = angle[ahead]
    while (inner := twin[ahead] >= 0).any():
        ahead[inner] = following[twin[ahead[inner]]]
        inner_angle[inner] += angle[ahead[inner]]
    succeeding = dict(zip(border.tolist(), ahead.tolist(), strict=True))
    turning = dict(zip(border.tolist(), (np.pi - inner_angle).tolist(), strict=True))
    found = []
    while succeeding:
        first, onward = succeeding.popitem()
        loop = [first]
        while onward != first:
            loop.append(onward)
            onward = succeeding.pop(onward)
        at = half[loop, 0]
        found.append(Border(at, _enclosed(mesh.vertices[at]), sum(turning[h] for h in loop) / (2 * np.pi)))
    return tuple(sorted(found, key=lambda border: -len(border.loop)))


def holes(mesh: Mesh, above: float = 0.0) -> tuple[Border, ...]:
    """Holes with an area above a limit in mm²."""
    return tuple(border for border in borders(mesh) if border.kind is Kind.HOLE and border.area > above)


def is_closed_tube(mesh: Mesh, largest_hole: float = 0.0) -> bool:
    """Whether the surface is one sound piece closed round an axis: two ends, no rim, no hole above a limit in mm²."""
    if not len(mesh.faces) or pieces(mesh).max() > 0 or len(non_manifold_edges(mesh)) or len(inconsistent_edges(mesh)):
        return False
    found = borders(mesh)
    kinds = [border.kind for border in found if border.kind is not Kind.HOLE or border.area > largest_hole]
    return sorted(kind.value for kind in kinds) == ["end", "end"]


def doubly_covered(mesh: Mesh, reach: float) -> Floats:
    """Share of each triangle that has another layer of the surface above or below it, (M,), in quarters.

    reach : mm, how far off along the normal a layer may lie to count; one of opposite orientation is another side of
    the body and does not.
    """
    covered = np.zeros((len(mesh.faces), len(_SAMPLES)), bool)
    if not len(mesh.faces):
        return np.zeros(0)
    normals, corners = mesh.normals, mesh.vertices[mesh.faces]
    own, other = _neighbourhood(mesh, reach)
    kept = np.einsum("ni,ni->n", normals[own], normals[other]) > 0.2
    own, other = own[kept], other[kept]
    for part in np.array_split(np.arange(len(own)), max(1, len(own) // 500_000)):
        first, second = own[part], other[part]
        for k, weights in enumerate(_SAMPLES):
            there, along = line_hits(weights @ corners[first], normals[first], corners[second])
            covered[first[(there > 1e-6).all(axis=1) & (np.abs(along) < reach)], k] = True
    return covered.mean(axis=1)


def _neighbourhood(mesh: Mesh, reach: float) -> tuple[Indices, Indices]:
    """Ordered pairs (P,), (P,) of triangles close enough for one to lie above the other."""
    centroids = mesh.centroids
    size = np.linalg.norm(mesh.vertices[mesh.faces] - centroids[:, None], axis=2).max(axis=1)
    usual = 1.4 * float(np.median(size))
    tree = scipy.spatial.cKDTree(centroids)
    pairs = tree.query_pairs(float(np.hypot(2 * usual, reach)), output_type="ndarray").astype(np.int64)
    large = np.flatnonzero(size > usual)
    around = tree.query_ball_point(centroids[large], np.hypot(size[large] + size.max(), reach))
    more = np.array([(a, b) for a, row in zip(large, around, strict=True) for b in row if a != b], np.int64)
    pairs = np.concatenate([pairs, more.reshape(-1, 2)])
    return np.concatenate([pairs[:, 0], pairs[:, 1]]), np.concatenate([pairs[:, 1], pairs[:, 0]])


def overlap_area(mesh: Mesh, reach: float) -> float:
    """Area covered twice, mm²: half of what lies in two layers. ``reach`` as in :func:`doubly_covered`."""
    return float(0.5 * (doubly_covered(mesh, reach) * mesh.areas).sum())


def _enclosed(points: Floats) -> float:
    """Length of the vector area that a closed line of points (n, 3) encloses."""
    about = points - points.mean(axis=0)
    return float(np.linalg.norm(0.5 * np.cross(about, np.roll(about, -1, axis=0)).sum(axis=0)))


def _corner_angles(mesh: Mesh) -> Floats:
    """Angles of the triangles at their corners, (M, 3) rad."""
    corners = mesh.vertices[mesh.faces]
    ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    return np.arctan2(np.linalg.norm(np.cross(ahead, behind), axis=2), np.einsum("mki,mki->mk", ahead, behind))


def face_neighbours(faces: Indices) -> Indices:
    """Triangles beside each triangle, (M, 3): across the edge from corner k to the next; -1 at a border.

    Where more than two triangles share an edge, one of the others.
    """
    twin = twins(half_edges(faces))
    return np.where(twin >= 0, twin // 3, -1).reshape(-1, 3)
