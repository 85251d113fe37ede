"""Topology of a triangulated surface: borders, holes, connected pieces, and area covered by two layers.

A surface is *sound* when every edge has one or two triangles that run along it in opposite directions, every vertex
one fan of triangles, and no part of it lies in a second layer above another.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask, Points, Vectors
from ringdic.mesh.adjacency import fan_numbers, piece_numbers, shared_edges, twins, vertices_of_several_fans
from ringdic.mesh.mesh import Mesh, half_edges
from ringdic.mesh.projection import line_hits

#: Barycentric coordinates at which a triangle is tested for a second layer: its centroid and a point near each corner.
_SAMPLES = np.array([[1 / 3, 1 / 3, 1 / 3], [2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]])


class Kind(Enum):
    """Kind of a border of a surface: around a hole, around an open surface, or around the end of a tube."""

    HOLE = "hole"  # the surface surrounds it
    RIM = "rim"  # it surrounds an open surface
    END = "end"  # it closes a tube


@dataclass(frozen=True)
class Border:
    """A closed line of edges that have a triangle on one side only.

    loop : (n,) vertex indices in the direction in which the triangles run along the line; where two borders touch in a
        vertex, it occurs in both.
    area : mm², size of the vector area that the line encloses (for the end of a tube, its cross-section).
    turning : integral of the geodesic curvature along the line, in full turns: +1 for the rim of a flat surface, -1 for
        a flat hole, 0 for the end of a cylinder, however ragged (theorem of Gauss and Bonnet).
    """

    loop: Indices
    area: float
    turning: float

    @property
    def kind(self) -> Kind:
        """Hole, rim or end, by the whole number nearest to ``turning``."""
        return Kind.HOLE if self.turning < -0.5 else Kind.RIM if self.turning > 0.5 else Kind.END


def non_manifold_edges(mesh: Mesh) -> Indices:
    """Edges with more than two triangles. Returns vertex indices (K, 2), the smaller first."""
    edges, count = mesh.edges()
    return edges[count > 2]


def inconsistent_edges(mesh: Mesh) -> Indices:
    """Edges along which two triangles run in the same direction, so that their orientations differ.

    Returns vertex indices (K, 2), in that direction.
    """
    half = half_edges(mesh.faces)
    unique, count = np.unique(half[:, 0] * len(mesh.vertices) + half[:, 1], return_counts=True)
    return np.stack(np.divmod(unique[count > 1], len(mesh.vertices)), axis=1)


def without_pinches(mesh: Mesh) -> Mask:
    """Which triangles remain when every vertex keeps only its fan of the largest area, (M,) bool.

    A fan is a set of triangles at one vertex that are connected by edges which end in that vertex. Of fans of equal
    area the first stays.
    """
    remaining = np.ones(len(mesh.faces), bool)
    while True:
        left = np.flatnonzero(remaining)
        part = Mesh(mesh.vertices, mesh.faces[left])
        fan = np.asarray(fan_numbers(half_edges(part.faces)))  # of each triangle corner, (3M,)
        pinched = vertices_of_several_fans(part.faces.ravel(), fan)
        if not pinched.any():
            return remaining
        area = np.bincount(fan, np.repeat(np.nan_to_num(part.areas), 3))
        corners = np.flatnonzero(pinched)
        # Sorted by the area of their fans, the last corner at each vertex belongs to its largest fan.
        order = np.lexsort((-fan[corners], area[fan[corners]], part.faces.ravel()[corners]))
        corners = corners[order]
        vertex = part.faces.ravel()[corners]
        last = np.flatnonzero(np.append(vertex[1:] != vertex[:-1], True))
        largest = np.repeat(fan[corners[last]], np.diff(np.append(-1, last)))
        remaining[left[np.unique(corners[fan[corners] != largest] // 3)]] = False


def pieces(mesh: Mesh) -> Indices:
    """Number of the connected piece of each triangle, (M,); triangles are connected by shared edges."""
    return np.asarray(piece_numbers(half_edges(mesh.faces)))


def borders(mesh: Mesh) -> tuple[Border, ...]:
    """All borders of a surface, the one with the most edges first.

    Raises ValueError for a surface with non-manifold edges or triangles of opposite orientation, whose borders have no
    direction.
    """
    half = half_edges(mesh.faces)
    twin, (_, alone) = twins(half), shared_edges(half)
    if not (alone | ((twin >= 0) & (twin[twin] == np.arange(len(half))))).all():
        raise ValueError("a surface with non-manifold edges or triangles turned over has no borders in order")
    following = np.arange(len(half)) // 3 * 3 + (np.arange(len(half)) + 1) % 3
    border = np.flatnonzero(twin < 0)
    at_border = np.zeros(len(mesh.vertices), bool)
    at_border[half[border]] = True
    of_interest = at_border[mesh.faces].any(axis=1)
    angle = np.full((len(mesh.faces), 3), np.nan)
    angle[of_interest] = _corner_angles(Mesh(mesh.vertices, mesh.faces[of_interest]))
    # From the end of a border edge, across the triangles of its fan, to the next border edge.
    ahead = following[border]
    inner_angle = angle.flat[ahead]
    while (inner := twin[ahead] >= 0).any():
        ahead[inner] = following[twin[ahead[inner]]]
        inner_angle[inner] += angle.flat[ahead[inner]]
    succeeding = dict(zip(border.tolist(), ahead.tolist(), strict=True))
    turning = dict(zip(border.tolist(), (np.pi - inner_angle).tolist(), strict=True))
    loops = []
    while succeeding:
        first, onward = succeeding.popitem()
        loop = [first]
        while onward != first:
            loop.append(onward)
            onward = succeeding.pop(onward)
        at = half[loop, 0]
        area = float(np.linalg.norm(vector_area(mesh.vertices[at])))
        loops.append(Border(at, area, sum(turning[h] for h in loop) / (2 * np.pi)))
    return tuple(sorted(loops, key=lambda border: -len(border.loop)))


def holes(mesh: Mesh, above: float = 0.0) -> tuple[Border, ...]:
    """The holes of a surface with an area above a limit in mm², the one with the most edges first."""
    return tuple(border for border in borders(mesh) if border.kind is Kind.HOLE and border.area > above)


def is_closed_tube(mesh: Mesh, largest_hole: float = 0.0) -> bool:
    """Whether the surface is one manifold piece with two ends, no rim and no hole of an area above a limit in mm²."""
    if not len(mesh.faces) or pieces(mesh).max() > 0 or len(non_manifold_edges(mesh)) or len(inconsistent_edges(mesh)):
        return False
    kinds = [border.kind for border in borders(mesh) if border.kind is not Kind.HOLE or border.area > largest_hole]
    return sorted(kind.value for kind in kinds) == ["end", "end"]


def doubly_covered(mesh: Mesh, reach: float) -> Floats:
    """Share of each triangle that has another layer of the surface above or below it, (M,), tested at four points.

    reach : mm, largest distance of another layer along the normal. A layer of opposite orientation is the other side
    of the body and does not count.
    """
    covered = np.zeros((len(mesh.faces), len(_SAMPLES)), bool)
    if not len(mesh.faces):
        return np.zeros(0)
    normals, corners = mesh.normals, mesh.vertices[mesh.faces]
    own, other = _neighbourhood(mesh, reach)
    alike = np.einsum("ni,ni->n", normals[own], normals[other]) > 0.2
    own, other = own[alike], other[alike]
    for part in np.array_split(np.arange(len(own)), max(1, len(own) // 500_000)):
        first, second = own[part], other[part]
        for k, weights in enumerate(_SAMPLES):
            inside, along = line_hits(weights @ corners[first], normals[first], corners[second])
            covered[first[(inside > 1e-6).all(axis=1) & (np.abs(along) < reach)], k] = True
    return covered.mean(axis=1)


def _neighbourhood(mesh: Mesh, reach: float) -> tuple[Indices, Indices]:
    """Ordered pairs (P,), (P,) of triangles close enough for the one to lie within ``reach`` mm above the other."""
    centroids = mesh.centroids
    size = np.linalg.norm(mesh.vertices[mesh.faces] - centroids[:, None], axis=2).max(axis=1)
    ordinary = 1.4 * float(np.median(size))
    tree = scipy.spatial.cKDTree(centroids)
    pairs = tree.query_pairs(float(np.hypot(2 * ordinary, reach)), output_type="ndarray").astype(np.int64)
    large = np.flatnonzero(size > ordinary)
    around = tree.query_ball_point(centroids[large], np.hypot(size[large] + size.max(), reach))
    more = np.array([(a, b) for a, row in zip(large, around, strict=True) for b in row if a != b], np.int64)
    pairs = np.concatenate([pairs, more.reshape(-1, 2)])
    return np.concatenate([pairs[:, 0], pairs[:, 1]]), np.concatenate([pairs[:, 1], pairs[:, 0]])


def overlap_area(mesh: Mesh, reach: float) -> float:
    """Area in mm² over which the surface lies in two layers, counted once.

    reach : mm, largest distance between two layers along the normal.
    """
    return float(0.5 * (doubly_covered(mesh, reach) * mesh.areas).sum())


def vector_area(points: Points) -> Vectors:
    """Vector area that a closed line encloses. points : (n, 3) mm, along the line. Returns (3,) mm²."""
    about = points - points.mean(axis=0)
    x, y, z = about.T
    ahead_x, ahead_y, ahead_z = np.concatenate([about[1:], about[:1]]).T
    return 0.5 * np.array([y @ ahead_z - z @ ahead_y, z @ ahead_x - x @ ahead_z, x @ ahead_y - y @ ahead_x])


def _corner_angles(mesh: Mesh) -> Floats:
    """Angles of the triangles at their corners, (M, 3) rad."""
    corners = mesh.vertices[mesh.faces]
    ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    return np.arctan2(np.linalg.norm(np.cross(ahead, behind), axis=2), np.einsum("mki,mki->mk", ahead, behind))


def face_neighbours(faces: Indices) -> Indices:
    """Neighbouring triangles of each triangle, across the edges from corner k to the next.

    faces : (M, 3) vertex indices. Returns triangle indices (M, 3), -1 at a border; one of the others where more than
    two triangles share an edge.
    """
    twin = twins(half_edges(faces))
    return np.where(twin >= 0, twin // 3, -1).reshape(-1, 3)
