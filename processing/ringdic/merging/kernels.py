"""Compiled loops over triangles for the removal of overlaps between surfaces.

Triangles that are separated by less than the gap that is to be left count as overlapping.
"""

from __future__ import annotations

import heapq
import math

import numba as nb
import numpy as np

from ringdic.mesh.nearest import near


@nb.njit(cache=True, nogil=True)
def peel_triangles(start, rival, beside, living, bad):  # type: ignore[no-untyped-def]
    """Remove border triangles that overlap remaining ones of other surfaces, worst first, as far as the border reaches.

    start : (M + 1,), where the triangles that each one overlaps begin in ``rival``. rival : (R,), triangles. beside :
    (M, 3), the neighbours of each triangle, -1 at a border. living : (M,) bool, triangles that remain, changed in
    place. bad : (M,), badness, the larger the worse.
    """
    left = np.zeros(len(living), np.int64)
    queue = [(0.0, 0) for _ in range(0)]
    worst = -1
    for f in range(len(living)):
        left[f] = start[f + 1] - start[f]
        if left[f]:
            if worst < 0 or bad[f] > bad[worst]:
                worst = f
            for g in beside[f]:
                if g < 0 or not living[g]:
                    queue.append((-bad[f], f))
                    break
    if not queue and worst >= 0:  # closed surfaces: somewhere the first has to go
        queue.append((-bad[worst], worst))
    heapq.heapify(queue)
    while queue:
        _, f = heapq.heappop(queue)
        if not living[f] or not left[f]:
            continue
        living[f] = False
        for at in range(start[f], start[f + 1]):
            left[rival[at]] -= 1
        for g in beside[f]:
            if g >= 0 and living[g] and left[g]:
                heapq.heappush(queue, (-bad[g], g))


@nb.njit(cache=True, nogil=True)
def regrow_triangles(start, rival, beside, living, wanted, bad):  # type: ignore[no-untyped-def]
    """Restore removed triangles that overlap no remaining one and adjoin remaining ones of their own surface.

    Those with most remaining neighbours come first, of these the best. start : (M + 1,), where the triangles that each
    one overlaps begin in ``rival``. rival : (R,), triangles. beside : (M, 3), the neighbours of each triangle, -1 at a
    border. living : (M,) bool, triangles that remain, changed in place. wanted : (M,) bool, triangles that may be
    restored. bad : (M,), badness, the larger the worse.
    """
    queue = [(0, 0.0, 0) for _ in range(0)]
    for f in range(len(living)):
        count = _count(beside, living, f) if wanted[f] else 0
        if count:
            queue.append((-count, bad[f], f))
    heapq.heapify(queue)
    while queue:
        _, _, f = heapq.heappop(queue)
        free = not living[f]
        for at in range(start[f], start[f + 1]):
            if living[rival[at]]:
                free = False
                break
        if not free:
            continue
        living[f] = True
        for g in beside[f]:
            if g >= 0 and wanted[g] and not living[g]:
                heapq.heappush(queue, (-_count(beside, living, g), bad[g], g))


@nb.njit(cache=True, nogil=True)
def _count(beside, living, f):  # type: ignore[no-untyped-def]
    """Number of remaining neighbours of triangle f."""
    count = 0
    for g in beside[f]:
        if g >= 0 and living[g]:
            count += 1
    return count


@nb.njit(cache=True, nogil=True)
def closer(middles, inside, owner, normals, corners, radius, usual, gap, reach, same_side, first, last):  # type: ignore[no-untyped-def]
    """Pairs (P, 2) of triangles of different surfaces that overlap or are separated by less than a gap.

    middles : centroids (M, 3) mm sorted into cubes. inside : (M,) bool, triangles that are not large and have no other
    surface near. owner : (M,), surface of each triangle. normals : (M, 3). corners : (M, 3, 3) mm. radius : (M,) mm,
    from centroid to farthest corner. usual : mm, radius beyond which a triangle is large. gap : mm, along the surface.
    reach : mm, along the normal. same_side : least cosine between the normals of two layers of one surface. first, last
    : range of the triangles, in the order of the cubes, for which pairs are sought.
    """
    M, widest = len(radius), radius.max()
    nearby, distance = np.empty(M, np.int64), np.empty(M)
    pairs, count = np.empty((last - first + 1, 2), np.int64), 0
    common = math.hypot(2 * usual + gap, reach)
    for k in range(first, last):
        a, x = middles.order[k], middles.at[k]
        large = radius[a] > usual
        if inside[a] and not large:
            continue
        within = math.hypot(radius[a] + widest + gap, reach) if large else common
        for m in range(near(middles, x[0], x[1], x[2], within, nearby, distance)):
            b = middles.order[nearby[m]]
            if owner[a] == owner[b]:
                continue
            if b < a if (radius[b] > usual) == large else not large:  # every pair once, from the larger triangle
                continue
            if not _close(a, b, middles.at[k], middles.at[nearby[m]], normals, corners, radius, gap, reach, same_side):
                continue
            if count == len(pairs):
                pairs = np.concatenate((pairs, np.empty_like(pairs)))
            pairs[count, 0], pairs[count, 1] = a, b
            count += 1
    return pairs[:count]


@nb.njit(cache=True, nogil=True)
def _close(a, b, at_a, at_b, normals, corners, radius, gap, reach, same_side):  # type: ignore[no-untyped-def]
    """Whether two triangles overlap or are separated by less than ``gap``. at_a, at_b : (3,) mm, their centroids."""
    cosine = normals[a, 0] * normals[b, 0] + normals[a, 1] * normals[b, 1] + normals[a, 2] * normals[b, 2]
    if not cosine > same_side:
        return False
    nx, ny, nz = normals[a, 0] + normals[b, 0], normals[a, 1] + normals[b, 1], normals[a, 2] + normals[b, 2]
    length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
    nx, ny, nz = nx / length, ny / length, nz / length
    dx, dy, dz = at_b[0] - at_a[0], at_b[1] - at_a[1], at_b[2] - at_a[2]
    height = dx * nx + dy * ny + dz * nz
    beside = math.sqrt(max(dx * dx + dy * dy + dz * dz - height * height, 0.0))
    if not (abs(height) < reach and beside < radius[a] + radius[b] + gap):
        return False
    return max(_separation(corners[a], corners[b], nx, ny, nz), _separation(corners[b], corners[a], nx, ny, nz)) < gap


@nb.njit(cache=True, nogil=True)
def _separation(one, two, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Widest gap of triangle two (3, 3) beyond the edges of triangle one (3, 3), mm, seen along a normal."""
    widest = -np.inf
    for k in range(3):
        m = (k + 1) % 3
        ex, ey, ez = one[m, 0] - one[k, 0], one[m, 1] - one[k, 1], one[m, 2] - one[k, 2]
        ax, ay, az = ey * nz - ez * ny, ez * nx - ex * nz, ex * ny - ey * nx  # outwards from the triangle
        length = max(math.sqrt(ax * ax + ay * ay + az * az), 1e-12)
        nearest = np.inf
        for j in range(3):
            away = (two[j, 0] - one[k, 0]) * ax + (two[j, 1] - one[k, 1]) * ay + (two[j, 2] - one[k, 2]) * az
            nearest = min(nearest, away / length)
        widest = max(widest, nearest)
    return widest


@nb.njit(cache=True, nogil=True)
def smooth_over_neighbours(values, known, beside, rounds):  # type: ignore[no-untyped-def]
    """Smooth values on triangles by repeatedly averaging over neighbouring triangles.

    values : (M,). known : (M,) bool, triangles whose value counts. beside : (M, 3), the neighbours of each triangle,
    -1 at a border. rounds : their number. Returns (M,), 0 where no value is near.
    """
    total, weight = np.where(known, values, 0.0), known.astype(np.float64)
    for _ in range(rounds):
        old_total, old_weight = total.copy(), weight.copy()
        for f in range(len(values)):
            more, heavier = 0.0, 0.0
            for g in beside[f]:
                if g >= 0:
                    more += old_total[g]
                    heavier += old_weight[g]
            total[f] += more
            weight[f] += heavier
    return np.where(weight > 0, total / np.maximum(weight, 1e-300), 0.0)
