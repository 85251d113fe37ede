"""The surfaces of the bodies as smooth maps from material coordinates (theta, z) to space, with their derivatives.

A body p is an array of parameters, ``[kind, radius, x, y, z, q]``: kind 0 is a cylinder displaced by (x, y, z), kind 1
the limb at load q. Material coordinates are those of the reference: the angle in rad, the height in mm.
"""

from __future__ import annotations

import math

import numba as nb

CYLINDER, LIMB = 0.0, 1.0
MIDDLE = 125.0  # mm, half the height of the body
# At load 1: bulge, twist over half the height (rad), axial stretch, its waviness (mm), bend at the ends (mm).
_BULGE, _TWIST, _STRETCH, _WAVE, _BEND = 0.10, 0.10, 0.05, 3.0, 5.0
_BULGE_Z, _BULGE_WIDTH = 140.0, 70.0  # mm
_SPAN = 8.0  # mm along a ray over which its clearance from the limb is like a parabola
_FAR = 8.0  # mm of clearance where the ray is nearest to the axis, beyond which it cannot meet the sloping surface
_BEND_X, _BEND_Y = math.cos(0.7), math.sin(0.7)


@nb.njit(cache=True, nogil=True)
def _profile(theta, z):  # type: ignore[no-untyped-def]
    """Reference radius of the limb and its derivatives by theta and z: a calf, 9 mm outside to 10 mm inside 57 mm."""
    u = (z - 165.0) / 60.0
    calf = 6.0 * math.exp(-u * u)
    side = 1.0 + 0.5 * math.cos(theta - 2.0)
    r = 54.0 + 5.0 * (z - MIDDLE) / MIDDLE + calf * side + 1.5 * math.cos(2.0 * (theta - 0.5))
    by_theta = -0.5 * calf * math.sin(theta - 2.0) - 3.0 * math.sin(2.0 * (theta - 0.5))
    by_z = 5.0 / MIDDLE - calf * side * 2.0 * u / 60.0
    return r, by_theta, by_z


@nb.njit(cache=True, nogil=True)
def body_point(theta, z, p):  # type: ignore[no-untyped-def]
    """Position of the material point (theta rad, z mm) of the body p, and its derivatives by theta and z.

    Returns x y z, then d/dtheta of x y z, then d/dz of x y z; mm.
    """
    if p[0] == CYLINDER:
        c, s = math.cos(theta), math.sin(theta)
        r = p[1]
        return r * c + p[2], r * s + p[3], z + p[4], -r * s, r * c, 0.0, 0.0, 0.0, 1.0
    q = p[5]
    r0, r0_t, r0_z = _profile(theta, z)
    w = (z - _BULGE_Z) / _BULGE_WIDTH
    swell = _BULGE * q * math.exp(-w * w)
    lobe = 1.0 + 0.3 * math.cos(theta - 2.0)
    grow = 1.0 + swell * lobe
    r = r0 * grow
    r_t = r0_t * grow - r0 * swell * 0.3 * math.sin(theta - 2.0)
    r_z = r0_z * grow - r0 * swell * lobe * 2.0 * w / _BULGE_WIDTH
    zeta = (z - MIDDLE) / MIDDLE
    a = theta + _TWIST * q * zeta
    c, s = math.cos(a), math.sin(a)
    a_z = _TWIST * q / MIDDLE
    bend = _BEND * q * zeta * zeta
    bend_z = 2.0 * _BEND * q * zeta / MIDDLE
    height = MIDDLE + (z - MIDDLE) * (1.0 + _STRETCH * q) + _WAVE * q * math.sin(math.pi * zeta)
    height_z = 1.0 + _STRETCH * q + _WAVE * q * math.pi / MIDDLE * math.cos(math.pi * zeta)
    return (
        r * c + bend * _BEND_X,
        r * s + bend * _BEND_Y,
        height,
        r_t * c - r * s,
        r_t * s + r * c,
        0.0,
        r_z * c - r * s * a_z + bend_z * _BEND_X,
        r_z * s + r * c * a_z + bend_z * _BEND_Y,
        height_z,
    )


@nb.njit(cache=True, nogil=True)
def approach(o, d, p):  # type: ignore[no-untyped-def]
    """Least clearance of the ray o + t d from the limb p, and an estimate of theta, z, t where it meets the surface.

    The clearance (mm, negative inside) is a ray point's distance from the limb's axis less the limb's radius at the
    same angle and height. It and the place of first contact come from a parabola along the ray.
    """
    speed = math.sqrt(d[0] * d[0] + d[1] * d[1])
    t = -(o[0] * d[0] + o[1] * d[1]) / (speed * speed)
    least, reach, sag = 0.0, _SPAN / speed, 1.0
    for _ in range(2):  # the vertex of a parabola, twice
        at = _clearance(o, d, t, p)
        if at > _FAR:
            return at, 0.0, 0.0, t
        before, after = _clearance(o, d, t - reach, p), _clearance(o, d, t + reach, p)
        sag = max(before - 2.0 * at + after, 1e-3)
        shift = min(2.0, max(-2.0, 0.5 * (before - after) / sag))
        t += shift * reach
        least = at - 0.5 * sag * shift * shift
        if abs(shift) < 0.05:
            break
    if least < 0.0:
        t -= reach * math.sqrt(-2.0 * least / sag)
    theta, z, _ = _section(o, d, t, p)
    return least, theta, z, t


@nb.njit(cache=True, nogil=True)
def _clearance(o, d, t, p):  # type: ignore[no-untyped-def]
    """Distance of the ray's point at t from the limb's axis less the limb's radius there, mm."""
    theta, z, rho = _section(o, d, t, p)
    return rho - _radius(theta, z, p[5])


@nb.njit(cache=True, nogil=True)
def _section(o, d, t, p):  # type: ignore[no-untyped-def]
    """theta and z of the limb's cross-section at the ray's point at t, and that point's distance from the axis, mm."""
    q = p[5]
    z = _height_before(o[2] + t * d[2], q)
    zeta = (z - MIDDLE) / MIDDLE
    bend = _BEND * q * zeta * zeta
    x, y = o[0] + t * d[0] - bend * _BEND_X, o[1] + t * d[1] - bend * _BEND_Y
    return math.atan2(y, x) - _TWIST * q * zeta, z, math.sqrt(x * x + y * y)


@nb.njit(cache=True, nogil=True)
def _height_before(height, q):  # type: ignore[no-untyped-def]
    """Reference height z of the cross-section that load q lifts to ``height``, mm."""
    z = MIDDLE + (height - MIDDLE) / (1.0 + _STRETCH * q)
    for _ in range(2):
        zeta = (z - MIDDLE) / MIDDLE
        lifted = MIDDLE + (z - MIDDLE) * (1.0 + _STRETCH * q) + _WAVE * q * math.sin(math.pi * zeta)
        z -= (lifted - height) / (1.0 + _STRETCH * q + _WAVE * q * math.pi / MIDDLE * math.cos(math.pi * zeta))
    return z


@nb.njit(cache=True, nogil=True)
def _radius(theta, z, q):  # type: ignore[no-untyped-def]
    """Radius of the limb's cross-section at load q, mm."""
    w = (z - _BULGE_Z) / _BULGE_WIDTH
    return _profile(theta, z)[0] * (1.0 + _BULGE * q * math.exp(-w * w) * (1.0 + 0.3 * math.cos(theta - 2.0)))


@nb.njit(cache=True, nogil=True)
def points(theta, z, p, out):  # type: ignore[no-untyped-def]
    """Positions and derivatives of points theta, z (n,) of the body p, in the order of `body_point`: out (n, 9)."""
    for i in range(len(theta)):
        out[i] = body_point(theta[i], z[i], p)


@nb.njit(cache=True, nogil=True)
def nearest(xyz, p, out):  # type: ignore[no-untyped-def]
    """Surface points of the body p nearest to points xyz (n, 3) mm, by Gauss-Newton.

    out : (n, 3), theta in rad, z in mm and the signed distance in mm, positive outside.
    """
    for i in range(len(xyz)):
        x, y, h = xyz[i]
        theta = math.atan2(y - p[3], x - p[2])
        z = h - p[4]
        for _ in range(60):
            px, py, pz, tx, ty, tz, zx, zy, zz = body_point(theta, z, p)
            ex, ey, ez = x - px, y - py, h - pz
            a, b, d = tx * tx + ty * ty + tz * tz, tx * zx + ty * zy + tz * zz, zx * zx + zy * zy + zz * zz
            f, g = tx * ex + ty * ey + tz * ez, zx * ex + zy * ey + zz * ez
            det = a * d - b * b
            step_theta, step_z = (d * f - b * g) / det, (a * g - b * f) / det
            theta += step_theta
            z += step_z
            if abs(step_theta) < 1e-13 and abs(step_z) < 1e-11:
                break
        px, py, pz, tx, ty, tz, zx, zy, zz = body_point(theta, z, p)
        nx, ny, nz = ty * zz - tz * zy, tz * zx - tx * zz, tx * zy - ty * zx
        out[i, 0] = theta
        out[i, 1] = z
        out[i, 2] = (nx * (x - px) + ny * (y - py) + nz * (h - pz)) / math.sqrt(nx * nx + ny * ny + nz * nz)
