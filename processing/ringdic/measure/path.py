"""The shortest path along the surface between two material points, followed as a material line.

The path crosses edges. A first guess comes from Dijkstra's algorithm over points set on the edges (Lanthier et al.
2001), a few on every edge of a wide corridor, then more in a narrower one. The triangles it passes, unfolded into a
plane, contain an exact shortest path (the funnel algorithm of Lee and Preparata 1984). Where that path bends at a
vertex, the other side of the vertex is tried, until no change shortens it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from ringdic.arrays import Floats, Indices
from ringdic.errors import ComputationError
from ringdic.measure.place import Place
from ringdic.mesh.geodesic import DETOUR, step_graph
from ringdic.mesh.mesh import Mesh

#: Points on an edge in the searches, and greatest ratio of the previous search's path length to the shortest.
_SEARCHES = ((3, DETOUR), (9, 1.03))
_MOST_TURNS = 2000


@dataclass(frozen=True)
class SurfacePath:
    """A material line on the surface: from ``start`` over K crossings of edges to ``end``.

    edges : (K, 2) vertex indices. shares : (K,) where each edge is crossed, 0 at its first vertex, 1 at its second.
    """

    start: Place
    end: Place
    edges: Indices
    shares: Floats

    def line(self, vertices: Floats, faces: Indices) -> Floats:
        """Points of the line in a configuration, (K + 2, 3) mm; NaN where the material is lost.

        vertices : (N, 3) mm. faces : (M, 3).
        """
        a, b = vertices[self.edges[:, 0]], vertices[self.edges[:, 1]]
        shares = self.shares[:, None]
        crossings = np.where(shares == 0, a, np.where(shares == 1, b, a + shares * (b - a)))
        return np.vstack([self.start.at(vertices, faces), crossings, self.end.at(vertices, faces)])

    def length(self, vertices: Floats, faces: Indices) -> float:
        """Length of the line in a configuration, mm; NaN if any of its material is lost.

        vertices : (N, 3) mm. faces : (M, 3).
        """
        return float(np.linalg.norm(np.diff(self.line(vertices, faces), axis=0), axis=1).sum())


def shortest_path(mesh: Mesh, start: Place, end: Place) -> SurfacePath:
    """The shortest path along the reference surface between two material points.

    Raises ComputationError if the places lie on parts of the surface that do not touch.
    """
    if start.face == end.face:
        return SurfacePath(start, end, np.empty((0, 2), dtype=np.int64), np.empty(0))
    graph = step_graph(mesh)
    away = np.add(*(dijkstra(graph, indices=mesh.faces[place.face], min_only=True) for place in (start, end)))
    if not np.isfinite(away.min()):
        raise ComputationError(
            f"no way along the surface leads from {start.label} to {end.label}: they lie on parts that do not touch"
        )
    whole = mesh.whole_faces()
    corners = mesh.vertices[mesh.faces[whole]]
    slack = 2.0 * float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    portals: list[tuple[int, int]] = []
    for points, longer in _SEARCHES:
        near = (away <= longer * away.min() + slack)[mesh.faces].any(axis=1)
        portals, away = _search(mesh, np.flatnonzero(near & whole), points, start, end)
    return _Strip(mesh, start, end, portals).tightened()


def _search(mesh: Mesh, which: Indices, points: int, start: Place, end: Place) -> tuple[list[tuple[int, int]], Floats]:
    """Edges crossed by the shortest path over ``points`` points placed on every edge of the triangles ``which`` (m,).

    Also the approximate length (N,) mm of the shortest such path through each vertex.
    """
    faces = mesh.faces[which]
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, side = np.unique(sides, axis=0, return_inverse=True)
    side = side.reshape(len(faces), 3)
    shares = (np.arange(points) + 0.5) / points
    a, b = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]]
    spots = (a[:, None] + shares[None, :, None] * (b - a)[:, None]).reshape(-1, 3)
    count = len(spots)
    spots = np.vstack([spots, [place.at(mesh.vertices, mesh.faces) for place in (start, end)]])
    on_side = side[:, :, None] * points + np.arange(points)  # (m, 3, points)
    first, second = [], []
    for one, other in ((0, 1), (1, 2), (2, 0)):  # across a triangle, from one side to another
        first.append(np.repeat(on_side[:, one], points, axis=1).ravel())
        second.append(np.tile(on_side[:, other], (1, points)).ravel())
    for place, node in ((start, count), (end, count + 1)):
        own = on_side[np.flatnonzero(which == place.face)].ravel()
        first.append(np.full(len(own), node))
        second.append(own)
    i, j = np.concatenate(first), np.concatenate(second)
    length = np.maximum(np.linalg.norm(spots[i] - spots[j], axis=1), 1e-12)  # 0 would be no link
    graph = csr_matrix((length, (i, j)), (count + 2, count + 2))
    path, before = dijkstra(graph, directed=False, indices=[count, count + 1], return_predecessors=True)
    way: list[int] = []
    spot = int(before[0, count + 1])
    while spot != count:
        way.append(spot // points)
        spot = int(before[0, spot])
    over = np.full(len(mesh.vertices), np.inf)
    through = path.sum(axis=0)[:count].reshape(-1, points)
    np.minimum.at(over, edges[:, 0], through[:, 0])
    np.minimum.at(over, edges[:, 1], through[:, -1])
    return [(int(edges[k, 0]), int(edges[k, 1])) for k in way[::-1]], over


class _Strip:
    """A strip of adjacent triangles from the start to the end, and the shortest path inside it."""

    def __init__(self, mesh: Mesh, start: Place, end: Place, portals: Sequence[tuple[int, int]]) -> None:
        self._mesh, self._start, self._end = mesh, start, end
        self._portals = list(portals)
        self._faces_at: dict[int, list[int]] = {}
        self._shares: list[float] = []
        self._held_at: list[int] = []
        self._length = float("inf")
        self._pull()

    def tightened(self) -> SurfacePath:
        """The shortest path after each vertex at which it bends has been passed on its better side."""
        for _ in range(_MOST_TURNS):
            if not any(self._turned_round(vertex) for vertex in list(self._held_at)):
                break
        edges = np.array(self._portals, dtype=np.int64).reshape(-1, 2)
        return SurfacePath(self._start, self._end, edges, np.array(self._shares))

    def _turned_round(self, vertex: int) -> bool:
        """Move the strip to the other side of a vertex if the path becomes shorter; whether it did."""
        at = [k for k, portal in enumerate(self._portals) if vertex in portal]
        if not at or at != list(range(at[0], at[-1] + 1)):
            return False
        fan = self._other_side(vertex, at[0], at[-1])
        if fan is None:
            return False
        before = self._portals, self._shares, self._held_at, self._length
        self._portals = _without_returns([*self._portals[: at[0]], *fan, *self._portals[at[-1] + 1 :]])
        self._pull()
        if self._length < before[3] * (1 - 1e-12):
            return True
        self._portals, self._shares, self._held_at, self._length = before
        return False

    def _other_side(self, vertex: int, first: int, last: int) -> list[tuple[int, int]] | None:
        """Edges at a vertex crossed on the side opposite to the portals ``first`` … ``last``; None at a border."""
        faces = self._mesh.faces
        before, after = self._face_before(first), self._face_before(last + 1)
        at = before
        crossed = self._portals[first]
        fan: list[tuple[int, int]] = []
        for _ in range(len(self._around(vertex)) + 1):
            if at == after and fan:
                return fan
            others = [int(v) for v in faces[at] if v != vertex]
            sides = [(min(vertex, v), max(vertex, v)) for v in others]
            if crossed not in sides:
                return None
            (leave,) = (side for side in sides if side != crossed)
            following = [f for f in self._around(vertex) if f != at and leave[0] in faces[f] and leave[1] in faces[f]]
            if len(following) != 1:
                return None  # the border of the surface
            fan.append(leave)
            at, crossed = following[0], leave
        return None

    def _face_before(self, portal: int) -> int:
        """The triangle between the portal before and this one."""
        if portal == 0:
            return self._start.face
        if portal == len(self._portals):
            return self._end.face
        corners = {*self._portals[portal - 1], *self._portals[portal]}
        (vertex,) = {*self._portals[portal - 1]} & {*self._portals[portal]}
        return next(f for f in self._around(vertex) if corners == {int(v) for v in self._mesh.faces[f]})

    def _around(self, vertex: int) -> list[int]:
        if vertex not in self._faces_at:
            self._faces_at[vertex] = np.flatnonzero((self._mesh.faces == vertex).any(axis=1)).tolist()
        return self._faces_at[vertex]

    def _pull(self) -> None:
        """Compute the shortest path inside the strip: its crossings, its length, the vertices at which it bends."""
        left, right, names, first, last = self._unfolded()
        corners = _funnel(left, right, first, last)
        line = np.array([first, *(point for point, _, _ in corners), last])
        self._held_at = [names[portal][side] for _, portal, side in corners]
        self._length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        knots = [-1, *(portal for _, portal, _ in corners), len(self._portals)]
        self._shares = []
        for k, (a, _) in enumerate(self._portals):
            part = next(i for i in range(1, len(knots)) if k <= knots[i])
            if k == knots[part]:
                share = float(corners[part - 1][2])  # at the vertex that is turned about: left 0, right 1
            else:
                share = _crossing(left[k], right[k], line[part - 1], line[part])
            self._shares.append(share if names[k][0] == a else 1.0 - share)

    def _unfolded(self) -> tuple[Floats, Floats, list[tuple[int, int]], Floats, Floats]:
        """The strip unfolded into a plane: left and right ends of the portals (K, 2), their vertices, start and end."""
        V = self._mesh.vertices
        a, b = self._portals[0]
        plane = {a: np.zeros(2), b: np.array([float(np.linalg.norm(V[b] - V[a])), 0.0])}
        start = self._start.at(V, self._mesh.faces)
        first = _unfold_point(V[a], V[b], start, plane[a], plane[b], -1.0)  # below the first portal: right is b
        ends = [(a, b)]
        spots = [(plane[a], plane[b])]
        for portal in self._portals[1:]:
            (la, rb) = ends[-1]
            (new,) = {*portal} - {la, rb}
            pl, pr = spots[-1]
            at = _unfold_point(V[la], V[rb], V[new], pl, pr, 1.0)
            ends.append((la, new) if la in portal else (new, rb))
            spots.append((pl, at) if la in portal else (at, pr))
        la, rb = ends[-1]
        end = self._end.at(V, self._mesh.faces)
        last = _unfold_point(V[la], V[rb], end, *spots[-1], 1.0)
        left, right = (np.array([spot[side] for spot in spots]) for side in (0, 1))
        return left, right, ends, first, last


def _unfold_point(a: Floats, b: Floats, c: Floats, at_a: Floats, at_b: Floats, side: float) -> Floats:
    """Unfold the point c into the plane: its position by its distances from a and b, on one side of the line a to b.

    a, b, c : (3,). at_a, at_b : (2,), positions of a and b in the plane.
    """
    along = (b - a) / np.linalg.norm(b - a)
    x = (c - a) @ along
    y = np.linalg.norm(c - a - x * along)
    unit = (at_b - at_a) / np.linalg.norm(at_b - at_a)
    return np.asarray(at_a + x * unit + side * y * np.array([-unit[1], unit[0]]))


def _funnel(left: Floats, right: Floats, first: Floats, last: Floats) -> list[tuple[Floats, int, int]]:
    """Corners of the shortest line from first to last through portals: point, number of the portal, side (0 left)."""
    ends = [*zip(left, right, strict=True), (last, last)]
    corners: list[tuple[Floats, int, int]] = []
    apex, limits, at = first, [*ends[0]], [0, 0]
    k = 1
    while k < len(ends):
        for side, inwards in ((1, 1.0), (0, -1.0)):
            new, other = ends[k][side], 1 - side
            if inwards * _turn(apex, limits[side], new) < 0:  # this side does not close in
                continue
            if np.array_equal(apex, limits[side]) or inwards * _turn(apex, limits[other], new) < 0:
                limits[side], at[side] = new, k
            else:  # it crosses the other: the path turns there
                apex, k = limits[other], at[other]
                corners.append((apex, k, other))
                limits, at = [apex, apex], [k, k]
                break
        k += 1
    return [corner for corner in corners if corner[1] < len(left)]


def _turn(a: Floats, b: Floats, c: Floats) -> float:
    """Twice the signed area of a, b, c: above 0 if c lies to the left of the line from a to b."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _crossing(left: Floats, right: Floats, a: Floats, b: Floats) -> float:
    """Share from left to right at which the line from a to b crosses a portal; where a is, if there is no line."""
    portal = right - left
    from_left, from_right = _turn(a, b, left), _turn(a, b, right)
    if abs(from_left - from_right) <= 1e-9 * float(portal @ portal):
        share = float((a - left) @ portal / (portal @ portal))
    else:
        share = from_left / (from_left - from_right)
    return float(np.clip(share, 0.0, 1.0))


def _without_returns(portals: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Portals without pairs that are crossed and immediately crossed back."""
    remaining: list[tuple[int, int]] = []
    for portal in portals:
        if remaining and remaining[-1] == portal:
            remaining.pop()
        else:
            remaining.append(portal)
    return remaining
