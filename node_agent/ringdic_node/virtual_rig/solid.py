"""Solid bodies as implicit functions in their own frame, with smooth maps of their motion that are inverted exactly.

The *frame of a body* has its origin in the body's middle and z along its axis; mm. A *shape* is an array of parameters,
``[kind, …]``, of a function f that is negative inside the body, zero on its surface and steeper than ``STEEPEST``
nowhere outside. A *motion* is an array ``[stretch, axis (3), swell, its z, its width, twist, bend (2), R (9), t (3)]``:
the body is stretched along an axis, swollen about z, twisted and bent, each of which keeps z where the next one needs
it, and then moved rigidly from its frame to the world by R and t.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

BOX, COLUMN, BRANCHES = 0.0, 1.0, 2.0
STEEPEST = 1.35  # largest change of f a mm of the deformed body, outside it
_BRANCH = 8  # parameters of a branch: two ends and their radii
_LEAST_STEP = 0.05  # mm along a ray; a body that is thinner along the ray than this may be missed
_EXACT = 1e-9  # mm along a ray, to which its first point of the surface is found
_DELTA = 1e-3  # mm, of the central differences: the error of a derivative is about 1e-10
_NONE = -1.0
_RIM = 4.0  # mm, width over which wall and flat end of a column pass into one another


@nb.njit(cache=True, nogil=True)
def shape_value(x, y, z, shape):  # type: ignore[no-untyped-def]
    """Value f at the point x y z (mm) of the body's frame, about the distance from the surface; negative inside.

    shape : parameters. Box: half sizes (3), radius of the edges. Column: as `_column_value`. Branches: blend, number,
    then two ends with their radii for each.
    """
    if shape[0] == BOX:
        r = shape[4]
        qx, qy, qz = abs(x) - shape[1] + r, abs(y) - shape[2] + r, abs(z) - shape[3] + r
        ox, oy, oz = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
        return math.sqrt(ox * ox + oy * oy + oz * oz) + min(max(qx, max(qy, qz)), 0.0) - r
    if shape[0] == COLUMN:
        return _column_value(x, y, z, shape)
    value = 1e9
    for k in range(int(shape[2])):
        branch = _branch_value(x, y, z, shape, 3 + _BRANCH * k)
        value = _blended(value, branch, shape[1])
    return value


@nb.njit(cache=True, nogil=True)
def _column_value(x, y, z, shape):  # type: ignore[no-untyped-def]
    """Value of a body about z with the radius r(theta, z) between two flat ends, or one flat and one round end.

    shape : 1 radius, 2 its slope; 3 swelling, 4 its z, 5 its width, 6 its share by the side at 7 theta; 8 oval, 9 its
    theta; 10 dent, 11 its sharpness, 12 its theta; 13, 14 lowest and highest z; 15 z above which the body closes, 16
    its radius over the height of the dome; 17 flattening along y.
    """
    flat = y * shape[17]
    rho = math.sqrt(x * x + flat * flat)
    theta = math.atan2(flat, x)
    r = shape[1] + shape[2] * z
    if shape[3] != 0.0:
        u = (z - shape[4]) / shape[5]
        r += shape[3] * math.exp(-u * u) * (1.0 + shape[6] * math.cos(theta - shape[7]))
    if shape[8] != 0.0:
        r += shape[8] * math.cos(2.0 * (theta - shape[9]))
    if shape[10] != 0.0:
        r += shape[10] * math.exp(shape[11] * (math.cos(theta - shape[12]) - 1.0))
    if z > shape[15]:
        rise = shape[16] * (z - shape[15])
        rho = math.sqrt(rho * rho + rise * rise)
    # The largest of the distances from wall and ends, its edge rounded off.
    return -_blended(r - rho, min(z - shape[13], shape[14] - z), _RIM)


@nb.njit(cache=True, nogil=True)
def _branch_value(x, y, z, shape, at):  # type: ignore[no-untyped-def]
    """Value of a rod between two points, round at its ends, whose radius passes smoothly from one to the other."""
    ax, ay, az = x - shape[at], y - shape[at + 1], z - shape[at + 2]
    bx, by, bz = shape[at + 4] - shape[at], shape[at + 5] - shape[at + 1], shape[at + 6] - shape[at + 2]
    size = bx * bx + by * by + bz * bz
    share = min(1.0, max(0.0, (ax * bx + ay * by + az * bz) / size)) if size > 0.0 else 0.0
    ax, ay, az = ax - share * bx, ay - share * by, az - share * bz
    radius = shape[at + 3] + (shape[at + 7] - shape[at + 3]) * share * share * (3.0 - 2.0 * share)
    return math.sqrt(ax * ax + ay * ay + az * az) - radius


@nb.njit(cache=True, nogil=True)
def _blended(a, b, width):  # type: ignore[no-untyped-def]
    """Minimum of two values, rounded off where they differ by less than a width (cubic polynomial), mm."""
    if width <= 0.0:
        return min(a, b)
    share = max(width - abs(a - b), 0.0) / width
    return min(a, b) - share * share * share * width / 6.0


@nb.njit(cache=True, nogil=True)
def shape_gradient(x, y, z, shape):  # type: ignore[no-untyped-def]
    """Gradient of f at the point x y z (mm) of the body's frame by central differences, without unit. shape : of f."""
    d = _DELTA
    gx = shape_value(x + d, y, z, shape) - shape_value(x - d, y, z, shape)
    gy = shape_value(x, y + d, z, shape) - shape_value(x, y - d, z, shape)
    gz = shape_value(x, y, z + d, shape) - shape_value(x, y, z - d, shape)
    return gx / (2.0 * d), gy / (2.0 * d), gz / (2.0 * d)


@nb.njit(cache=True, nogil=True)
def _swelling(z, m):  # type: ignore[no-untyped-def]
    """Factor by which a motion widens the body at the stretched height z."""
    w = (z - m[5]) / m[6]
    return 1.0 + m[4] * math.exp(-w * w)


@nb.njit(cache=True, nogil=True)
def deformed(x, y, z, m):  # type: ignore[no-untyped-def]
    """Point of the deformed body, not yet moved rigidly, of the point x y z (mm) in the body's frame. m : motion."""
    along = m[0] * (x * m[1] + y * m[2] + z * m[3])
    x, y, z = x + along * m[1], y + along * m[2], z + along * m[3]
    if m[4] != 0.0:
        grow = _swelling(z, m)
        x, y = grow * x, grow * y
    if m[7] != 0.0:
        c, s = math.cos(m[7] * z), math.sin(m[7] * z)
        x, y = c * x - s * y, s * x + c * y
    return x + m[8] * z * z, y + m[9] * z * z, z


@nb.njit(cache=True, nogil=True)
def undeformed(x, y, z, m):  # type: ignore[no-untyped-def]
    """Point in the body's frame of the point x y z (mm) of the deformed body: inverse of `deformed`. m : motion."""
    x, y = x - m[8] * z * z, y - m[9] * z * z
    if m[7] != 0.0:
        c, s = math.cos(m[7] * z), math.sin(m[7] * z)
        x, y = c * x + s * y, c * y - s * x
    if m[4] != 0.0:
        grow = _swelling(z, m)
        x, y = x / grow, y / grow
    along = m[0] / (1.0 + m[0]) * (x * m[1] + y * m[2] + z * m[3])
    return x - along * m[1], y - along * m[2], z - along * m[3]


@nb.njit(cache=True, nogil=True)
def ray_value(o, d, s, shape, m):  # type: ignore[no-untyped-def]
    """Value f of the deformed body at distance s (mm) along a ray.

    o, d : origin (3,) mm and unit direction (3,) in the frame of the deformed body. shape, m : shape and motion.
    """
    x, y, z = undeformed(o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2], m)
    return shape_value(x, y, z, shape)


@nb.njit(cache=True, nogil=True)
def box_span(o, d, box, more):  # type: ignore[no-untyped-def]
    """Distances along a ray at which it enters and leaves a box; the second is the smaller one if it misses the box.

    o, d : origin (3,) mm and direction (3,). box : (6,) lowest, then highest corner, mm. more : mm, by which the box is
    enlarged.
    """
    enter, leave = 0.0, 1e9
    for k in range(3):
        low, high = box[k] - more - o[k], box[3 + k] + more - o[k]
        if abs(d[k]) < 1e-12:
            if low > 0.0 or high < 0.0:
                return 1.0, 0.0
            continue
        a, b = low / d[k], high / d[k]
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter, leave


@nb.njit(cache=True, nogil=True)
def first_hit(o, d, start, stop, shape, m):  # type: ignore[no-untyped-def]
    """Distance along a ray at which it first meets the deformed body between start and stop, mm; -1 if it does not.

    The ray is followed in steps that cannot pass the surface (sphere tracing: Hart 1996), and the change of sign is
    refined by the Illinois method. o, d : as in `ray_value`. shape, m : shape and motion.
    """
    s = start
    value = ray_value(o, d, s, shape, m)
    while s < stop:
        ahead = s + max(value / STEEPEST, _LEAST_STEP)
        beyond = ray_value(o, d, ahead, shape, m)
        if beyond <= 0.0 and value > 0.0:
            return _between(o, d, s, value, ahead, beyond, shape, m)
        s, value = ahead, beyond
    return _NONE


@nb.njit(cache=True, nogil=True)
def _between(o, d, a, value_a, b, value_b, shape, m):  # type: ignore[no-untyped-def]
    """Zero of f along a ray between a, where it is positive, and b, where it is not."""
    side = 0
    for _ in range(60):
        s = (a * value_b - b * value_a) / (value_b - value_a)
        value = ray_value(o, d, s, shape, m)
        if b - a < _EXACT or abs(value) < 0.1 * _EXACT:
            return s
        if value > 0.0:
            a, value_a = s, value
            if side == 1:
                value_b *= 0.5
            side = 1
        else:
            b, value_b = s, value
            if side == -1:
                value_a *= 0.5
            side = -1
    return 0.5 * (a + b)


@nb.njit(cache=True, nogil=True)
def clear_distance(o, d, spread, box, shape, m):  # type: ignore[no-untyped-def]
    """Distance up to which a cone of rays about a ray certainly meets nothing, mm; -1 if it misses the body altogether.

    o, d : as in `ray_value`. spread : radius of the cone over the distance. box : (6,) mm, of the deformed body. shape,
    m : shape and motion.
    """
    s, stop = box_span(o, d, box, 1000.0 * spread)
    while s < stop:
        free = ray_value(o, d, s, shape, m) / STEEPEST
        step = (free - spread * s) / (1.0 + spread)
        if step < 0.5:
            return s
        s += step
    return _NONE


@nb.njit(cache=True, nogil=True)
def first_hits(o, d, box, shape, m, out):  # type: ignore[no-untyped-def]
    """Distances along n rays at which they first meet the body: out (n,) mm, -1 where they do not.

    o (n, 3) mm, d (n, 3) : origins and unit directions in the frame of the deformed body. box : (6,) mm, of the
    deformed body. shape, m : shape and motion.
    """
    for i in range(len(d)):
        start, stop = box_span(o[i], d[i], box, 1.0)
        out[i] = first_hit(o[i], d[i], start, stop, shape, m)


@nb.njit(cache=True, nogil=True)
def shape_values(xyz, shape, values, gradients):  # type: ignore[no-untyped-def]
    """Values of f and gradients at points xyz (n, 3) mm of the body's frame: values (n,) mm, gradients (n, 3).

    shape : of f.
    """
    for i in range(len(xyz)):
        x, y, z = xyz[i]
        values[i] = shape_value(x, y, z, shape)
        gradients[i, 0], gradients[i, 1], gradients[i, 2] = shape_gradient(x, y, z, shape)


@nb.njit(cache=True, nogil=True)
def feet(xyz, shape, out):  # type: ignore[no-untyped-def]
    """Surface points nearest to points xyz (n, 3) mm of the body's frame: out (n, 3) mm, by Newton's method.

    Each iteration steps onto the surface along the gradient, and then by the tangential part of what separates the
    foot from the point. shape : of f.
    """
    for i in range(len(xyz)):
        x, y, z = xyz[i]
        for _ in range(40):
            for _ in range(3):
                value = shape_value(x, y, z, shape)
                gx, gy, gz = shape_gradient(x, y, z, shape)
                step = value / max(gx * gx + gy * gy + gz * gz, 1e-12)
                x, y, z = x - step * gx, y - step * gy, z - step * gz
                if abs(value) < 1e-11:
                    break
            ex, ey, ez = xyz[i, 0] - x, xyz[i, 1] - y, xyz[i, 2] - z
            along = (ex * gx + ey * gy + ez * gz) / max(gx * gx + gy * gy + gz * gz, 1e-12)
            ex, ey, ez = 0.7 * (ex - along * gx), 0.7 * (ey - along * gy), 0.7 * (ez - along * gz)
            if ex * ex + ey * ey + ez * ez < 1e-20:
                break
            x, y, z = x + ex, y + ey, z + ez
        out[i, 0], out[i, 1], out[i, 2] = x, y, z


@nb.njit(cache=True, nogil=True)
def placed(xyz, m, out):  # type: ignore[no-untyped-def]
    """Positions in the world of points xyz (n, 3) mm of the body's frame: out (n, 3) mm. m : motion."""
    for i in range(len(xyz)):
        x, y, z = deformed(xyz[i, 0], xyz[i, 1], xyz[i, 2], m)
        for k in range(3):
            out[i, k] = m[10 + 3 * k] * x + m[11 + 3 * k] * y + m[12 + 3 * k] * z + m[19 + k]


@nb.njit(cache=True, nogil=True)
def placed_back(xyz, m, out):  # type: ignore[no-untyped-def]
    """Points of the body's frame, out (n, 3) mm, of positions xyz (n, 3) mm in the world. m : motion."""
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0] - m[19], xyz[i, 1] - m[20], xyz[i, 2] - m[21]
        bx = m[10] * x + m[13] * y + m[16] * z
        by = m[11] * x + m[14] * y + m[17] * z
        bz = m[12] * x + m[15] * y + m[18] * z
        out[i, 0], out[i, 1], out[i, 2] = undeformed(bx, by, bz, m)


@nb.njit(cache=True, nogil=True)
def placed_slopes(xyz, m, out):  # type: ignore[no-untyped-def]
    """Derivatives dx/dX of positions in the world by the body's frame, out (n, 3, 3), at points xyz (n, 3) mm.

    m : motion. By central differences, with an error of about 1e-10.
    """
    ends = np.empty((2, 3))
    at = np.empty((2, 3))
    for i in range(len(xyz)):
        for k in range(3):
            at[0], at[1] = xyz[i], xyz[i]
            at[0, k] += _DELTA
            at[1, k] -= _DELTA
            placed(at, m, ends)
            for j in range(3):
                out[i, j, k] = (ends[0, j] - ends[1, j]) / (2.0 * _DELTA)
