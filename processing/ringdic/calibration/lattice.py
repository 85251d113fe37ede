"""Spots of an image joined to a lattice of rows and columns by walking from neighbour to neighbour.

Scale and perspective are taken from the spots themselves: the target says how many dot sizes the neighbour is away,
the spot's own width and height say how large a dot is just there.
"""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
import scipy

from ringdic.arrays import Indices
from ringdic.calibration.dots import Dots
from ringdic.session.rig import Target

#: Neighbours nearer or farther than these parts of the expected distance are not neighbours.
_NEAREST, _FARTHEST = 0.55, 1.5
#: Directions allowed off the vertical and off the horizontal, as tangents.
_VERTICAL_SLOPE, _HORIZONTAL_SLOPE = 0.35, 0.9
#: A column shorter than this is not trusted; two columns are joined by at least so many rows.
_SHORTEST_COLUMN, _FEWEST_VOTES = 4, 3


def walk(dots: Dots, target: Target) -> tuple[Indices, Indices, Indices]:
    """The largest lattice among spots of an upright image.

    Returns the indices of its spots, their rows counted upwards and their columns counted to the right, both from 0.
    Spots seen too obliquely to be linked safely are left to whoever knows the camera.
    """
    frontal = np.flatnonzero(
        (dots.width > 0.45 * dots.height) & (dots.width < 1.7 * dots.height) & (dots.contrast > 0.35)
    )
    chosen = dots[frontal]
    if len(chosen) < _SHORTEST_COLUMN:
        return (np.zeros(0, dtype=np.intp),) * 3
    above, right = _neighbours(chosen, target)
    columns = [column for column in _columns(above) if len(column) >= _SHORTEST_COLUMN]
    labels = _label(columns, right)
    if not labels:
        return (np.zeros(0, dtype=np.intp),) * 3
    spots = np.array(list(labels), dtype=np.intp)
    place = np.array([labels[spot] for spot in spots.tolist()], dtype=np.intp)
    place -= place.min(axis=0)
    return frontal[spots], place[:, 0], place[:, 1]


def _neighbours(dots: Dots, target: Target) -> tuple[Indices, Indices]:
    """For each spot the one above and the one to the right; −1 where there is none. Only mutual neighbours count."""
    tall = target.row_spacing_mm / target.dot_size_mm * dots.height
    wide = target.column_spacing_mm / target.dot_size_mm * dots.width
    tree = scipy.spatial.cKDTree(dots.px)
    n = len(dots)
    found = {name: np.full(n, -1, dtype=np.intp) for name in ("above", "below", "right", "left")}
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
                found[name][i] = j[ok][np.argmin(np.hypot(dx, dy)[ok])]
    return _mutual(found["above"], found["below"]), _mutual(found["right"], found["left"])


def _mutual(forth: Indices, back: Indices) -> Indices:
    i = np.arange(len(forth))
    return np.where((forth >= 0) & (back[forth] == i), forth, -1)


def _columns(above: Indices) -> list[list[int]]:
    """Chains of spots from the bottom upwards."""
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


def _label(columns: list[list[int]], right: Indices) -> dict[int, tuple[int, int]]:
    """(row, column) of each spot of the largest set of columns that hang together."""
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
    seen: set[int] = set()
    for first in links:
        if first in seen:
            continue
        placed = {first: (0, 0)}
        queue = deque([first])
        while queue:
            c = queue.popleft()
            for other, shift, step in links[c]:
                if other not in placed:
                    placed[other] = (placed[c][0] + shift, placed[c][1] + step)
                    queue.append(other)
        seen |= set(placed)
        labels = {spot: (row + r, column) for c, (row, column) in placed.items() for r, spot in enumerate(columns[c])}
        if len(labels) > len(best):
            best = labels
    return best
