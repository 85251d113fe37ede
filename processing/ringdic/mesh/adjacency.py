"""Compiled adjacency of a triangle mesh: half-edges along one edge, connected pieces, fans of triangles at a vertex.

``half`` (3M, 2) is everywhere the vertices of the half-edges of M triangles, by ``ringdic.mesh.mesh.half_edges``.
"""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def counting_sort(key, size):  # type: ignore[no-untyped-def]
    """Sort items by their keys (n,), 0 ≤ key < size, by counting.

    Returns start (size + 1,) and order (n,): the items with key c are ``order[start[c] : start[c + 1]]``.
    """
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
    """Opposite half-edge of each, (3M,): the first in ``half`` that runs along its edge the other way, or -1."""
    twin = np.full(len(half), -1)
    if not len(half):
        return twin
    start, order = counting_sort(half[:, 0], half.max() + 1)
    for h in range(len(half)):
        a, b = half[h]
        for at in range(start[b], start[b + 1]):
            if half[order[at], 1] == a:
                twin[h] = order[at]
                break
    return twin


@nb.njit(cache=True, nogil=True)
def shared_edges(half):  # type: ignore[no-untyped-def]
    """Half-edges of ``half`` along one edge, in either direction, linked to one another.

    Returns for each half-edge the next earlier one along its edge (3M,), or -1, and whether it has the edge alone
    (3M,) bool.
    """
    before, alone = np.full(len(half), -1), np.ones(len(half), np.bool_)
    if not len(half):
        return before, alone
    least = np.minimum(half[:, 0], half[:, 1])
    most = np.maximum(half[:, 0], half[:, 1])
    start, order = counting_sort(least, most.max() + 1)
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
    """Representative of the set of ``i`` in a union-find forest, with path halving."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@nb.njit(cache=True, nogil=True)
def _join(parent, i, j):  # type: ignore[no-untyped-def]
    """Unite the sets of ``i`` and ``j``; the smaller representative stays."""
    a, b = _root(parent, i), _root(parent, j)
    parent[max(a, b)] = min(a, b)


@nb.njit(cache=True, nogil=True)
def _numbered(parent):  # type: ignore[no-untyped-def]
    """Number of the set of each member (n,), counted from 0 in the order of the sets' first members."""
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
    """Number of the connected piece of each triangle, (M,); triangles are connected by the edges shared in ``half``."""
    before, _ = shared_edges(half)
    parent = np.arange(len(half) // 3)
    for h in range(len(half)):
        if before[h] >= 0:
            _join(parent, h // 3, before[h] // 3)
    return _numbered(parent)


@nb.njit(cache=True, nogil=True)
def fan_numbers(half):  # type: ignore[no-untyped-def]
    """Number of the fan of each triangle corner, (3M,), from ``half``.

    A fan is a set of triangles at one vertex that are connected by edges which end in that vertex.
    """
    before, _ = shared_edges(half)
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
    """Which corners are at a vertex with more than one fan, (3M,) bool.

    corners (3M,) vertex of each corner. fan (3M,) number of its fan.
    """
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
