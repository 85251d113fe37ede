"""Rows and columns of the dots in an image, by linking neighbouring dots to a lattice.

Scale and perspective are taken from the dots themselves: the target gives the distance of neighbours in dot sizes, and
the width and height of a dot give the size at its position in the image.
"""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
import scipy

from ringdic.arrays import Indices
from ringdic.calibration.dots import Dots
from ringdic.session.rig import Target

#: Least and largest distance of neighbours, as parts of the expected one.
_NEAREST, _FARTHEST = 0.55, 1.5
#: Largest deviations of their directions from the vertical and the horizontal, as tangents.
_VERTICAL_SLOPE, _HORIZONTAL_SLOPE = 0.35, 0.9
#: Fewest dots of a column, and fewest rows in which two columns must agree on their relation.
_SHORTEST_COLUMN, _FEWEST_VOTES = 4, 3


def dot_lattice(dots: Dots, target: Target) -> tuple[Indices, Indices, Indices]:
    """The largest lattice of dots in an upright image.

    Spots that are seen too obliquely to be linked safely are left out.

    Returns the indices (n,) of its spots, their rows (n,) counted upwards and their columns (n,) counted to the right,
    both from 0.
    """
    frontal = np.flatnonzero(
        (dots.width > 0.45 * dots.height) & (dots.width < 1.7 * dots.height) & (dots.contrast > 0.35)
    )
    chosen = dots[frontal]
    if len(chosen) < _SHORTEST_COLUMN:
        return (np.zeros(0, dtype=np.intp),) * 3
    above, right = _neighbours(chosen, target)
    columns = [column for column in _columns(above) if len(column) >= _SHORTEST_COLUMN]
    positions = _lattice_positions(columns, right)
    if not positions:
        return (np.zeros(0, dtype=np.intp),) * 3
    spots = np.array(list(positions), dtype=np.intp)
    position = np.array(list(positions.values()), dtype=np.intp)
    position -= position.min(axis=0)
    return frontal[spots], position[:, 0], position[:, 1]


def _neighbours(dots: Dots, target: Target) -> tuple[Indices, Indices]:
    """Indices of the neighbours above (n,) and to the right (n,) of each dot, -1 where there is none.

    The relation must be mutual: the dot must also be the neighbour below, or to the left, of its neighbour.
    """
    tall = target.row_spacing_mm / target.dot_size_mm * dots.height
    wide = target.column_spacing_mm / target.dot_size_mm * dots.width
    tree = scipy.spatial.cKDTree(dots.px)
    n = len(dots)
    neighbours = {name: np.full(n, -1, dtype=np.intp) for name in ("above", "below", "right", "left")}
    reach = _FARTHEST * np.hypot(np.maximum(tall, wide), _HORIZONTAL_SLOPE * wide)
    for i, near in enumerate(tree.query_ball_point(dots.px, reach)):
        j = np.array([k for k in near if k != i], dtype=np.intp)
        if not j.size:
            continue
        dx, dy = (dots.px[j] - dots.px[i]).T
        vertical = np.abs(dx) < _VERTICAL_SLOPE * np.abs(dy)
        horizontal = np.abs(dy) < _HORIZONTAL_SLOPE * np.abs(dx)
        alike = (dots.height[j] < 1.5 * dots.height[i]) & (dots.height[i] < 1.5 * dots.height[j])
        up = alike & vertical & (np.abs(dy) > _NEAREST * tall[i]) & (np.abs(dy) < _FARTHEST * tall[i])
        across = alike & horizontal & (np.abs(dx) > _NEAREST * wide[i]) & (np.abs(dx) < _FARTHEST * wide[i])
        for name, ok in (
            ("above", up & (dy < 0)),
            ("below", up & (dy > 0)),
            ("right", across & (dx > 0)),
            ("left", across & (dx < 0)),
        ):
            if ok.any():
                neighbours[name][i] = j[ok][np.argmin(np.hypot(dx, dy)[ok])]
    return _mutual(neighbours["above"], neighbours["below"]), _mutual(neighbours["right"], neighbours["left"])


def _mutual(forth: Indices, back: Indices) -> Indices:
    """Links (n,) that lead back by the opposite links (n,); -1 for the others."""
    i = np.arange(len(forth))
    return np.where((forth >= 0) & (back[forth] == i), forth, -1)


def _columns(above: Indices) -> list[list[int]]:
    """Columns as lists of dots from the bottom upwards, by the links to the neighbours above (n,)."""
    has_below = set(above[above >= 0].tolist())
    chains = []
    for bottom in range(len(above)):
        if bottom in has_below:
            continue
        chain = [bottom]
        while above[chain[-1]] >= 0:
            chain.append(int(above[chain[-1]]))
        chains.append(chain)
    return chains


def _lattice_positions(columns: list[list[int]], right: Indices) -> dict[int, tuple[int, int]]:
    """Row and column of each dot of the largest set of linked columns, by the links to the right neighbours (n,)."""
    where = {spot: (c, r) for c, chain in enumerate(columns) for r, spot in enumerate(chain)}
    links: dict[int, list[tuple[int, int, int]]] = {c: [] for c in range(len(columns))}
    votes: dict[tuple[int, int], Counter[int]] = {}
    for spot, (c, r) in where.items():
        if int(right[spot]) in where:
            other, r_other = where[int(right[spot])]
            votes.setdefault((c, other), Counter())[r - r_other] += 1
    for (c, other), counter in votes.items():
        shift, count = counter.most_common(1)[0]
        if count >= _FEWEST_VOTES and count >= 0.7 * counter.total():
            links[c].append((other, shift, 1))
            links[other].append((c, -shift, -1))
    best: dict[int, tuple[int, int]] = {}
    visited: set[int] = set()
    for first in links:
        if first in visited:
            continue
        origins = {first: (0, 0)}  # row of its lowest dot, and column, of each linked chain
        queue = deque([first])
        while queue:
            c = queue.popleft()
            for other, shift, step in links[c]:
                if other not in origins:
                    origins[other] = (origins[c][0] + shift, origins[c][1] + step)
                    queue.append(other)
        visited |= set(origins)
        positions = {
            spot: (row + r, column) for c, (row, column) in origins.items() for r, spot in enumerate(columns[c])
        }
        if len(positions) > len(best):
            best = positions
    return best
