"""Which triangles share an edge, and what hangs together: loops over half-edges sorted by their vertices, compiled.

``half`` is everywhere what ``ringdic.mesh.mesh.half_edges`` gives of the triangles (M, 3): directed edges (3M, 2).
"""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def _starts(key, size):  # type: ignore[no-untyped-def]
    """Where the numbers with each key begin (size + 1,) in a row sorted by key, and that row."""
    start = np.zeros(size + 1, np.int64)
    for k in key:
        start[k + 1] += 1
    for c in range(1, size + 1):
        start[c] += start[c - 1]
    free = start[:-1].copy()
    order = np.empty(len(key), np.int64)
    for i in range(len(key)):
        order[free[key[i]]] = i
        free[key[i]] += 1
    return start, order


@nb.njit(cache=True, nogil=True)
def twins(half):  # type: ignore[no-untyped-def]
    """The half-edge that runs along the same edge the other way, (3M,), the first if several do; -1 at a border."""
    twin = np.full(len(half), -1)
    if not len(half):
        return twin
    start, order = _starts(half[:, 0], half.max() + 1)
    for h in range(len(half)):
        a, b = half[h]
        for at in range(start[b], start[b + 1]):
            if half[order[at], 1] == a:
                twin[h] = order[at]
                break
    return twin


@nb.njit(cache=True, nogil=True)
def alike(half):  # type: ignore[no-untyped-def]
    """The half-edge before each along the same edge, either way, (3M,), or -1; and which have the edge alone (3M,)."""
    before, alone = np.full(len(half), -1), np.ones(len(half), np.bool_)
    if not len(half):
        return before, alone
    least = np.minimum(half[:, 0], half[:, 1])
    most = np.maximum(half[:, 0], half[:, 1])
    start, order = _starts(least, most.max() + 1)
    for c in range(len(start) - 1):
        for at in range(start[c], start[c + 1]):
            h = order[at]
            for earlier in range(at - 1, start[c] - 1, -1):
                g = order[earlier]
                if most[g] == most[h]:
                    before[h] = g
                    alone[h] = alone[g] = False
                    break
    return before, alone


@nb.njit(cache=True, nogil=True)
def _root(parent, i):  # type: ignore[no-untyped-def]
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@nb.njit(cache=True, nogil=True)
def _join(parent, i, j):  # type: ignore[no-untyped-def]
    a, b = _root(parent, i), _root(parent, j)
    parent[max(a, b)] = min(a, b)


@nb.njit(cache=True, nogil=True)
def _numbered(parent):  # type: ignore[no-untyped-def]
    """Numbers of the sets, in the order of their first members."""
    number, count = np.empty(len(parent), np.int64), 0
    for i in range(len(parent)):
        root = _root(parent, i)
        if root == i:
            number[i] = count
            count += 1
        else:
            number[i] = number[root]
    return number


@nb.njit(cache=True, nogil=True)
def piece_numbers(half):  # type: ignore[no-untyped-def]
    """Number of the piece of each triangle, (M,): those that share an edge hang together."""
    before, _ = alike(half)
    parent = np.arange(len(half) // 3)
    for h in range(len(half)):
        if before[h] >= 0:
            _join(parent, h // 3, before[h] // 3)
    return _numbered(parent)


@nb.njit(cache=True, nogil=True)
def fan_numbers(half):  # type: ignore[no-untyped-def]
    """Number of the fan of each corner, (3M,): corners at one vertex whose triangles share an edge there."""
    before, _ = alike(half)
    parent = np.arange(len(half))
    for h in range(len(half)):
        g = before[h]
        if g < 0:
            continue
        h_end, g_end = h - h % 3 + (h + 1) % 3, g - g % 3 + (g + 1) % 3
        turned = half[h, 0] == half[g, 1]
        _join(parent, h, g_end if turned else g)
        _join(parent, h_end, g if turned else g_end)
    return _numbered(parent)


@nb.njit(cache=True, nogil=True)
def vertices_of_several_fans(corners, fan):  # type: ignore[no-untyped-def]
    """Which corners (3M,), given by their vertices, are at a vertex with more than one fan. Bool (3M,)."""
    several = np.zeros(len(corners), np.bool_)
    if not len(corners):
        return several
    first = np.full(corners.max() + 1, -1)
    more = np.zeros(len(first), np.bool_)
    for c in range(len(corners)):
        v = corners[c]
        if first[v] < 0:
            first[v] = fan[c]
        elif first[v] != fan[c]:
            more[v] = True
    for c in range(len(corners)):
        several[c] = more[corners[c]]
    return several
