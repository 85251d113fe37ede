"""Printed patterns (speckles, dots, digits, squares) as shares of dark ink in a sample of the surface.

``s`` is the arc along the circumference of the 57 mm cylinder (57 theta), ``z`` the height; both mm. ``ws`` and
``wz`` are the widths that one sample covers on the surface. A pattern is a formula that gives the share of the sample
that is dark, so no pixel image is ever resampled. The lens's point spread is a part of the formula of the speckles:
blurred only after sampling, their sharp rims would alias, as they do in no camera.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

RADIUS = 57.0  # mm
CIRCUMFERENCE = 2.0 * math.pi * RADIUS
_CELLS = 179  # speckle cells round the circumference
_CELL = CIRCUMFERENCE / _CELLS  # mm
_GRID, _BALL, _FAINTEST = 1.9, 1.0, 0.3  # mm: of the balls, the largest radius, the radius of the faintest disk
_COLUMNS, _ROWS, _SPACING = 30, 20, 12.0
_DOT = 4.0  # mm
_MARK_Z, _MARK_RADIUS = 124.0, 1.5  # mm, the disk between columns 1 and 2
_DIGIT_Z, _DIGIT_HEIGHT, _DIGIT_WIDTH, _STROKE = 242.5, 5.0, 2.6, 0.7  # mm
# Segments of the digits 0 … 9: top, top right, bottom right, bottom, bottom left, top left, middle.
_SEGMENTS = np.array([0x3F, 0x06, 0x5B, 0x4F, 0x66, 0x6D, 0x7D, 0x07, 0x7F, 0x6F], dtype=np.int64)


@nb.njit(cache=True, nogil=True)
def covered(distance, width):  # type: ignore[no-untyped-def]
    """Share of a sample that lies inside a straight edge, 0 to 1.

    distance : from the edge to the middle of the sample, negative inside. width : of the sample, in the same unit.
    """
    return min(1.0, max(0.0, 0.5 - distance / width))


@nb.njit(cache=True, nogil=True)
def _disk(x, y, radius, ws, wz):  # type: ignore[no-untyped-def]
    """Dark share of a sample at (x, y) from the centre of a disk that is larger than the sample.

    Exact for a straight rim (the sample's chords across it are a box convolved with a box); the rim's curvature
    enters to first order, as half the curvature times the sample's variance along the rim.
    """
    length = math.sqrt(x * x + y * y)
    if length < 0.3 * radius:  # no rim near by; the direction means nothing at the centre
        return 1.0 if ws + wz < 1.2 * radius else covered(length - radius, 0.5 * (ws + wz))
    a, b = abs(x) / length, abs(y) / length
    distance = length - radius + (b * b * ws * ws + a * a * wz * wz) / (24.0 * radius)
    wide, narrow = max(a * ws, b * wz), min(a * ws, b * wz)
    off = abs(distance)
    if off >= 0.5 * (wide + narrow):
        outer = 0.0
    elif off <= 0.5 * (wide - narrow):
        outer = 0.5 - off / wide
    else:
        outer = (0.5 * (wide + narrow) - off) ** 2 / (2.0 * wide * narrow)
    return outer if distance > 0.0 else 1.0 - outer


@nb.njit(cache=True, nogil=True)
def _random(i, j, k, seed):  # type: ignore[no-untyped-def]
    """Pseudo-random number in [0, 1) from the cell (i, j), a counter k and the seed."""
    h = np.uint64(i) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(j) * np.uint64(0xC2B2AE3D27D4EB4F)
    h += np.uint64(k) * np.uint64(0x165667B19E3779F9) + np.uint64(seed) * np.uint64(0xD6E8FEB86659FD93)
    h ^= h >> np.uint64(32)
    h *= np.uint64(0xD6E8FEB86659FD93)
    h ^= h >> np.uint64(32)
    h *= np.uint64(0xD6E8FEB86659FD93)
    h ^= h >> np.uint64(32)
    return float(h >> np.uint64(11)) * 1.1102230246251565e-16


@nb.njit(cache=True, nogil=True)
def _spot(x, y, radius, ds, dz):  # type: ignore[no-untyped-def]
    """Dark share at (x, y) from the centre of a disk seen through a Gaussian of deviations ds along s and dz along z.

    Exact for a straight rim; a rim's curvature enters to first order, as half the curvature times the Gaussian's
    variance along the rim.
    """
    length = math.sqrt(x * x + y * y)
    if length > 0.3 * radius:
        a, b = x / length, y / length
    else:  # the direction means nothing at the centre
        a = b = math.sqrt(0.5)
    across, along = a * a * ds * ds + b * b * dz * dz, b * b * ds * ds + a * a * dz * dz
    scaled = (length - radius + along / (2.0 * radius)) / math.sqrt(2.0 * across)
    if scaled > 4.0:
        return 0.0
    return 1.0 if scaled < -4.0 else 0.5 * math.erfc(scaled)


@nb.njit(cache=True, nogil=True)
def speckle(s, z, ds, dz, seed):  # type: ignore[no-untyped-def]
    """Dark share at arc s, height z (mm) of random disks of 1.0 … 1.6 mm on a jittered grid, seamless round the body.

    seed : of the pattern. ds, dz : mm, standard deviations along s and z of the Gaussian that it is seen through.
    """
    ci, cj = math.floor(s / _CELL), math.floor(z / _CELL)
    reach = 0.8 + 0.35 * _CELL + 5.0 * max(ds, dz)  # largest radius, largest displacement, rim of the Gaussian
    white = 1.0
    for j in range(cj - 1, cj + 2):
        if abs(z - (j + 0.5) * _CELL) > reach:
            continue
        for i in range(ci - 1, ci + 2):
            if abs(s - (i + 0.5) * _CELL) > reach:
                continue
            key = np.int64(i % _CELLS)
            row = np.int64(j + 4096)
            x = (i + 0.5 + 0.7 * (_random(key, row, 0, seed) - 0.5)) * _CELL
            y = (j + 0.5 + 0.7 * (_random(key, row, 1, seed) - 0.5)) * _CELL
            r = 0.5 + 0.3 * _random(key, row, 2, seed)
            white *= 1.0 - _spot(s - x, z - y, r, ds, dz)
    return 1.0 - white


@nb.njit(cache=True, nogil=True)
def solid_speckle(x, y, z, normal, blur, seed):  # type: ignore[no-untyped-def]
    """Dark share at the point x y z (mm) of a surface that cuts random balls of 1.4 to 2 mm on a jittered 3D grid.

    A ball appears as a disk of at most its own radius. Disks under 0.3 mm radius are left out, those up to 0.45 mm are
    fainter, as functions of the place alone. The grid is turned against the axes, so that no flat face lies along it.

    normal : (3,) unit normal of the surface. blur : (2, 3) mm, two vectors of the tangent plane, the standard
    deviations along two directions of the Gaussian that the surface is seen through. seed : of the pattern.
    """
    px, py, pz = _turned(x, y, z)
    nx, ny, nz = _turned(normal[0], normal[1], normal[2])
    ax, ay, az = _turned(blur[0, 0], blur[0, 1], blur[0, 2])
    bx, by, bz = _turned(blur[1, 0], blur[1, 1], blur[1, 2])
    every = ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz
    off_plane = _BALL + 0.35 * _GRID * (abs(nx) + abs(ny) + abs(nz))
    reach = _BALL + 5.0 * math.sqrt(every)
    ci, cj, ck = math.floor(px / _GRID), math.floor(py / _GRID), math.floor(pz / _GRID)
    white = 1.0
    for i in range(ci - 1, ci + 2):
        ex = px - (i + 0.5) * _GRID
        for j in range(cj - 1, cj + 2):
            ey = py - (j + 0.5) * _GRID
            for k in range(ck - 1, ck + 2):
                ez = pz - (k + 0.5) * _GRID
                if abs(ex * nx + ey * ny + ez * nz) > off_plane:
                    continue
                row, layer = np.int64(j + 4096), 8 * np.int64(k + 4096)
                key = np.int64(i + 4096)
                qx = ex - 0.7 * _GRID * (_random(key, row, layer, seed) - 0.5)
                qy = ey - 0.7 * _GRID * (_random(key, row, layer + 1, seed) - 0.5)
                qz = ez - 0.7 * _GRID * (_random(key, row, layer + 2, seed) - 0.5)
                ball = _BALL - 0.28 * _random(key, row, layer + 3, seed)
                off = qx * nx + qy * ny + qz * nz
                square = ball * ball - off * off
                if square < _FAINTEST * _FAINTEST:
                    continue
                radius = math.sqrt(square)
                qx, qy, qz = qx - off * nx, qy - off * ny, qz - off * nz
                length = math.sqrt(qx * qx + qy * qy + qz * qz)
                if length > reach:
                    continue
                if length > 0.3 * radius:
                    a, b = (ax * qx + ay * qy + az * qz) / length, (bx * qx + by * qy + bz * qz) / length
                    across = a * a + b * b
                else:  # the direction means nothing at the centre
                    across = 0.5 * every
                scaled = (length - radius + (every - across) / (2.0 * radius)) / math.sqrt(2.0 * across)
                if scaled > 4.0:
                    continue
                ink = min(1.0, (radius - _FAINTEST) / 0.15)
                white *= 1.0 - ink * ink * (3.0 - 2.0 * ink) * (1.0 if scaled < -4.0 else 0.5 * math.erfc(scaled))
    return 1.0 - white


@nb.njit(cache=True, nogil=True)
def _turned(x, y, z):  # type: ignore[no-untyped-def]
    """The vector x y z in the frame of the grid of balls."""
    return (
        0.75461729 * x + 0.38233943 * y + 0.53326289 * z,
        -0.65271865 * x + 0.52058389 * y + 0.55040964 * z,
        -0.06716476 * x - 0.76341927 * y + 0.64240168 * z,
    )


@nb.njit(cache=True, nogil=True)
def _box(a, b, half_a, half_b, ws, wz):  # type: ignore[no-untyped-def]
    """Dark share of a sample at (a, b) of a rectangle about the origin with sides along s and z; exact."""
    in_a = min(a + ws / 2, half_a) - max(a - ws / 2, -half_a)
    in_b = min(b + wz / 2, half_b) - max(b - wz / 2, -half_b)
    return max(0.0, in_a) * max(0.0, in_b) / (ws * wz)


@nb.njit(cache=True, nogil=True)
def _digit(a, b, number, ws, wz):  # type: ignore[no-untyped-def]
    """Dark share of a sample at (a, b) of a seven-segment digit whose lower left corner is the origin."""
    bits = _SEGMENTS[number]
    w, h, t = _DIGIT_WIDTH - 0.8, _DIGIT_HEIGHT, _STROKE / 2
    dark = 0.0
    if bits & 1:
        dark = max(dark, _box(a - w / 2, b - h + t, w / 2, t, ws, wz))
    if bits & 2:
        dark = max(dark, _box(a - w + t, b - 0.75 * h, t, h / 4, ws, wz))
    if bits & 4:
        dark = max(dark, _box(a - w + t, b - 0.25 * h, t, h / 4, ws, wz))
    if bits & 8:
        dark = max(dark, _box(a - w / 2, b - t, w / 2, t, ws, wz))
    if bits & 16:
        dark = max(dark, _box(a - t, b - 0.25 * h, t, h / 4, ws, wz))
    if bits & 32:
        dark = max(dark, _box(a - t, b - 0.75 * h, t, h / 4, ws, wz))
    if bits & 64:
        dark = max(dark, _box(a - w / 2, b - h / 2, w / 2, t, ws, wz))
    return dark


@nb.njit(cache=True, nogil=True)
def dots(s, z, ws, wz, prints):  # type: ignore[no-untyped-def]
    """Dark share of the target's print at arc s, height z: squares, column numbers above the top row, one disk as mark.

    ws, wz : mm, width and height of the sample on the surface.
    prints : (rows, columns, 2) deviation of each square from its nominal place, mm.
    """
    column = math.floor(s / _SPACING + 0.5)
    a = s - column * _SPACING
    if column >= _COLUMNS:
        column, a = 0, s - CIRCUMFERENCE
        if a < -_SPACING / 2:
            column, a = _COLUMNS - 1, s - (_COLUMNS - 1) * _SPACING
    dark = 0.0
    row = math.floor((z - 10.0) / _SPACING + 0.5)
    if 0 <= row < _ROWS:
        off_s, off_z = prints[row, column, 0], prints[row, column, 1]
        dark = _box(a - off_s, z - 10.0 - row * _SPACING - off_z, _DOT / 2, _DOT / 2, ws, wz)
    if abs(z - _MARK_Z) < 3.0 and abs(s - _SPACING / 2) < 3.0:
        dark = max(dark, _disk(s - _SPACING / 2, z - _MARK_Z, _MARK_RADIUS, ws, wz))
    if z > _DIGIT_Z - 1.0:
        number = column + 1
        if number < 10:
            dark = max(dark, _digit(a + _DIGIT_WIDTH / 2 - 0.4, z - _DIGIT_Z, number, ws, wz))
        else:
            dark = max(dark, _digit(a + _DIGIT_WIDTH - 0.4, z - _DIGIT_Z, number // 10, ws, wz))
            dark = max(dark, _digit(a - 0.4, z - _DIGIT_Z, number % 10, ws, wz))
    return dark


@nb.njit(cache=True, nogil=True)
def _square_wave(x, width):  # type: ignore[no-untyped-def]
    """Square wave, +1 over [0, 1) and -1 over [1, 2), repeated, averaged over a width."""
    return (_triangle(x + width / 2) - _triangle(x - width / 2)) / width


@nb.njit(cache=True, nogil=True)
def _triangle(x):  # type: ignore[no-untyped-def]
    """Integral of the square wave: a triangle wave."""
    x = x - 2.0 * math.floor(x / 2.0)
    return x if x < 1.0 else 2.0 - x


@nb.njit(cache=True, nogil=True)
def checker(x, y, wx, wy):  # type: ignore[no-untyped-def]
    """Dark share at (x, y) of a checkerboard of unit squares over [0, 15] x [0, 20], white around it.

    wx, wy : width and height of the sample, in squares.
    """
    if not (-wx < x < 15.0 + wx and -wy < y < 20.0 + wy):
        return 0.0
    inside = min(1.0, max(0.0, min(x, 15.0 - x) / wx + 0.5)) * min(1.0, max(0.0, min(y, 20.0 - y) / wy + 0.5))
    return inside * (0.5 + 0.5 * _square_wave(x, wx) * _square_wave(y, wy))
