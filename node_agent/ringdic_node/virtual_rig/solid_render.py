"""Images of solid bodies by ray tracing: each pixel has the brightness of the first point that its ray meets.

The rays of a tile of pixels start where a cone about all of them comes near to the body. A pixel within the body whose
footprint on it is small takes one sample, a pixel at an edge or with a long footprint the mean of four, and a pixel of
the room one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numba as nb
import numpy as np

from ringdic_node.virtual_rig.arrays import Radiance
from ringdic_node.virtual_rig.lens import VirtualCamera, ideal_of_pixel
from ringdic_node.virtual_rig.room import BLACK, SKIN, STAMP, WHITE, brightness, room_radiance, to_world
from ringdic_node.virtual_rig.scenes.damage import Damage
from ringdic_node.virtual_rig.scenes.solid import SolidSpecimen
from ringdic_node.virtual_rig.sensor import POINT_SPREAD, blurred
from ringdic_node.virtual_rig.solid import box_span, clear_distance, first_hit, shape_gradient, undeformed
from ringdic_node.virtual_rig.solid_damage import with_damage
from ringdic_node.virtual_rig.texture import solid_speckle

# mm along the body: a pixel with a longer footprint takes four samples.
LONG = 0.8
_TILE = 8  # px
_STEEP = 5.0  # depths of neighbouring pixels that differ by more pixels than this lie on both sides of an edge
_FINE_SPECKLE, _SUBPIXELS = 0.7, 2  # size of speckles below which the image has this many pixels for one, both ways
_DELTA = 1e-3  # mm, of the central differences


def solid_radiance(camera: VirtualCamera, scene: SolidSpecimen) -> Radiance:
    """Noise-free image (height, width) of a solid body, in linear light without unit; 1 saturates."""
    out = _of_fine_speckles(camera, scene) if scene.speckle < _FINE_SPECKLE else _sampled(camera, scene)
    out = with_damage(camera, scene, out) if scene.damage != Damage() else out
    return blurred(out, scene.defocus) if scene.defocus > 0.0 else out


def _sampled(camera: VirtualCamera, scene: SolidSpecimen) -> Radiance:
    out = np.zeros((camera.height, camera.width), np.float32)
    shape, motion = scene.solid.parameters, scene.motion.parameters(scene.solid)
    R, t = motion[10:19].reshape(3, 3), motion[19:22]
    look = np.array([*scene.solid.band, float(scene.motion.is_rigid), scene.speckle, scene.period])
    pose = (camera.R, camera.centre, R.T @ camera.R.T, R.T @ (camera.centre - t))
    _solid_kernel(camera.lens, pose, look, scene.deformed_box(), shape, motion, scene.seed, out)
    return out


def _of_fine_speckles(camera: VirtualCamera, scene: SolidSpecimen) -> Radiance:
    """Image (height, width) of speckles about as small as a pixel, in linear light, averaged from smaller pixels.

    The formula of a speckle holds where its radius is larger than the blur through which it is seen.
    """
    n = _SUBPIXELS
    K = np.diag([n, n, 1.0]) @ camera.K
    K[:2, 2] += 0.5 * (n - 1)
    finer = replace(camera, K=K, width=n * camera.width, height=n * camera.height)
    image = _sampled(finer, scene).reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))
    return blurred(image, POINT_SPREAD * math.sqrt(1.0 - 1.0 / n**2))


@nb.njit(nogil=True)
def _towards(M, x, y, d):  # type: ignore[no-untyped-def]
    """Write the unit direction of the camera's ray (x, y, 1) in the body's frame to d; returns its length before."""
    length = math.sqrt(x * x + y * y + 1.0)
    for i in range(3):
        d[i] = (M[i, 0] * x + M[i, 1] * y + M[i, 2]) / length
    return length


@nb.njit(nogil=True)
def _tile_spread(lens, M, left, top, middle, d):  # type: ignore[no-untyped-def]
    """Radius over distance of the cone of a tile's rays; writes the direction of its middle ray to ``middle``."""
    u, v = left + 0.5 * _TILE - 0.5, top + 0.5 * _TILE - 0.5
    x, y = (u - lens[3]) / lens[0], (v - lens[4]) / lens[1]
    x, y, _, _, _, _ = ideal_of_pixel(u, v, lens, x, y)
    _towards(M, x, y, middle)
    spread = 0.0
    for k in range(4):
        a, b = left - 0.5 + _TILE * (k % 2), top - 0.5 + _TILE * (k // 2)
        xk, yk, _, _, _, _ = ideal_of_pixel(a, b, lens, x, y)
        _towards(M, xk, yk, d)
        off = 0.0
        for i in range(3):
            off += (d[i] - middle[i]) ** 2
        spread = max(spread, math.sqrt(off))
    return 1.05 * spread


@nb.njit(nogil=True)
def _trace(lens, M, o, box, shape, m, starts, depth):  # type: ignore[no-untyped-def]
    """Distances at which the middle rays of all pixels meet the body, 0 where they do not, and at which tiles start.

    starts : (rows, columns of tiles) mm, -1 where no ray of the tile meets the body. depth : (height, width) mm.
    """
    height, width = depth.shape
    d, middle = np.empty(3), np.empty(3)
    for i in range(starts.shape[0]):
        for j in range(starts.shape[1]):
            top, left = i * _TILE, j * _TILE
            spread = _tile_spread(lens, M, left, top, middle, d)
            start = clear_distance(o, middle, spread, box, shape, m)
            starts[i, j] = start
            if start < 0.0:
                continue
            x, y = (left - lens[3]) / lens[0], (top - lens[4]) / lens[1]
            for v in range(top, min(top + _TILE, height)):
                for u in range(left, min(left + _TILE, width)):
                    x, y, _, _, _, _ = ideal_of_pixel(u, v, lens, x, y)
                    _towards(M, x, y, d)
                    enter, leave = box_span(o, d, box, 1.0)
                    if leave > enter:
                        depth[v, u] = max(0.0, first_hit(o, d, start, leave, shape, m))


@nb.njit(nogil=True)
def _inside(depth, u, v, wide):  # type: ignore[no-untyped-def]
    """How a pixel lies: 0 in the room, 1 at an edge of the body, 2 within it. wide : width of a pixel at distance 1."""
    height, width = depth.shape
    near, far, hits, count = 1e9, 0.0, 0, 0
    for b in range(max(0, v - 1), min(height, v + 2)):
        for a in range(max(0, u - 1), min(width, u + 2)):
            count += 1
            if depth[b, a] > 0.0:
                hits += 1
                near, far = min(near, depth[b, a]), max(far, depth[b, a])
    if hits == 0:
        return 0
    return 2 if hits == count and far - near < 2.0 * _STEEP * wide * near else 1


@nb.njit(nogil=True)
def _surface(o, d, s, rigid, shape, m, point, normal, slopes):  # type: ignore[no-untyped-def]
    """Material point and unit normal of the undeformed surface where a ray meets the body, and how they change.

    slopes : (3, 3), derivatives of the material point by the point of the deformed body, column by column.
    Returns the cosine of the angle between the deformed surface's normal, written to slopes' last row, and the ray.
    """
    px, py, pz = o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2]
    point[0], point[1], point[2] = undeformed(px, py, pz, m)
    gx, gy, gz = shape_gradient(point[0], point[1], point[2], shape)
    size = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1e-12)
    normal[0], normal[1], normal[2] = gx / size, gy / size, gz / size
    for k in range(3):
        for i in range(3):
            slopes[i, k] = 1.0 if i == k else 0.0
        if rigid:
            continue
        ex, ey, ez = _DELTA * (k == 0), _DELTA * (k == 1), _DELTA * (k == 2)
        ax, ay, az = undeformed(px + ex, py + ey, pz + ez, m)
        bx, by, bz = undeformed(px - ex, py - ey, pz - ez, m)
        slopes[0, k], slopes[1, k] = (ax - bx) / (2.0 * _DELTA), (ay - by) / (2.0 * _DELTA)
        slopes[2, k] = (az - bz) / (2.0 * _DELTA)
    size = 0.0
    for k in range(3):
        slopes[3, k] = slopes[0, k] * normal[0] + slopes[1, k] * normal[1] + slopes[2, k] * normal[2]
        size += slopes[3, k] ** 2
    size = math.sqrt(size)
    cosine = 0.0
    for k in range(3):
        slopes[3, k] /= size
        cosine -= slopes[3, k] * d[k]
    return cosine


@nb.njit(nogil=True)
def _footprint(d, n, cosine, deviation, slopes, blur):  # type: ignore[no-untyped-def]
    """Write two vectors of the undeformed surface, which a pixel's deviation across and along its tilt covers, to blur.

    n : (3,) unit normal of the deformed surface. deviation : mm, of the Gaussian across the ray.
    """
    wx, wy, wz = d[1] * n[2] - d[2] * n[1], d[2] * n[0] - d[0] * n[2], d[0] * n[1] - d[1] * n[0]
    size = math.sqrt(wx * wx + wy * wy + wz * wz)
    if size < 1e-6:  # seen squarely: any direction across the normal
        wx, wy, wz = (0.0, n[2], -n[1]) if abs(n[0]) < 0.7 else (n[2], 0.0, -n[0])
        size = math.sqrt(wx * wx + wy * wy + wz * wz)
    wx, wy, wz = wx / size, wy / size, wz / size
    tx, ty, tz = n[1] * wz - n[2] * wy, n[2] * wx - n[0] * wz, n[0] * wy - n[1] * wx
    for i in range(3):
        blur[0, i] = deviation * (slopes[i, 0] * wx + slopes[i, 1] * wy + slopes[i, 2] * wz)
        blur[1, i] = deviation / cosine * (slopes[i, 0] * tx + slopes[i, 1] * ty + slopes[i, 2] * tz)


@nb.njit(nogil=True)
def _body_radiance(o, d, s, wide, samples, height, look, shape, m, seed, scratch):  # type: ignore[no-untyped-def]
    """Brightness of the body where a ray meets it, and the sample's largest width on it, mm.

    wide : width of a sample across the ray, mm; samples : of a pixel, in samples. height : of the point in the world,
    mm. look : lowest and highest z of the speckles, whether the motion is rigid, the size of the speckles, and the
    mm after which they repeat.
    """
    point, normal, blur, slopes = scratch[0], scratch[1], scratch[2:4], scratch[4:8]
    cosine = max(0.02, _surface(o, d, s, look[2] > 0.0, shape, m, point, normal, slopes))
    light = brightness(cosine) * (1.0 - 0.0006 * abs(height - 130.0))
    z = point[2]
    if not look[0] < z < look[1]:
        if look[0] - 3.0 < z < look[1] + 3.0:
            return light * WHITE, wide
        return light * SKIN * (1.0 + 0.03 * math.sin(0.8 * z)), wide
    size = look[3]
    deviation = math.sqrt((POINT_SPREAD * samples) ** 2 + 1.0 / 12.0) * wide / size
    _footprint(d, slopes[3], cosine, deviation, slopes, blur)
    if look[4] > 0.0:
        for i in range(3):
            point[i] -= look[4] * math.floor(point[i] / look[4])
    dark = solid_speckle(point[0] / size, point[1] / size, point[2] / size, normal, blur, seed)
    return light * (WHITE + dark * (BLACK - WHITE)), wide / cosine


@nb.njit(nogil=True)
def _render_solid(lens, pose, look, box, shape, m, seed, out):  # type: ignore[no-untyped-def]
    """Render a body in front of the room.

    pose : world to camera, centre in the world; camera to body's frame, centre in the body's frame.
    """
    R, o, M, ob = pose
    height, width = out.shape
    starts = np.empty(((height + _TILE - 1) // _TILE, (width + _TILE - 1) // _TILE))
    depth = np.zeros((height, width))
    _trace(lens, M, ob, box, shape, m, starts, depth)
    d, world, scratch = np.empty(3), np.empty(3), np.empty((8, 3))
    per = 1.0 / lens[0]
    first_x, first_y = -lens[3] / lens[0], -lens[4] / lens[1]  # the first pixel, were there no distortion
    for v in range(height):
        x, y = first_x, first_y
        for u in range(width):
            x, y, xu, xv, yu, yv = ideal_of_pixel(u, v, lens, x, y)
            if u == 0:
                first_x, first_y = x, y
            to_world(R, x, y, world)
            within = _inside(depth, u, v, per)
            if within == 0:
                out[v, u] = room_radiance(o, world, per)
                continue
            if within == 2:
                length = _towards(M, x, y, d)
                s = depth[v, u]
                up = o[2] + s * world[2] / length
                value, wide = _body_radiance(ob, d, s, per * s / length, 1, up, look, shape, m, seed, scratch)
                if wide < LONG:
                    out[v, u] = value
                    continue
            start, total = starts[v // _TILE, u // _TILE], 0.0
            for k in range(4):
                a, b = 0.5 * (k % 2) - 0.25, 0.5 * (k // 2) - 0.25
                xk, yk = x + a * xu + b * xv, y + a * yu + b * yv
                to_world(R, xk, yk, world)
                length = _towards(M, xk, yk, d)
                enter, leave = box_span(ob, d, box, 1.0)
                s = first_hit(ob, d, start, leave, shape, m) if start >= 0.0 and leave > enter else -1.0
                if s > 0.0:
                    up = o[2] + s * world[2] / length
                    wide = 0.5 * per * s / length
                    total += _body_radiance(ob, d, s, wide, 2, up, look, shape, m, seed, scratch)[0]
                else:
                    total += room_radiance(o, world, 0.5 * per)
            out[v, u] = 0.25 * total


def _compiled_kernel(stamp: int) -> Callable[..., None]:
    """The kernel that renders a solid body, compiled and cached on disk under a key that includes the stamp."""

    @nb.njit(cache=True, nogil=True)
    def solid(lens, pose, look, box, shape, m, seed, out):  # type: ignore[no-untyped-def]
        if stamp >= 0:  # the kernel uses the stamp, so that numba includes it in the key of its cache
            _render_solid(lens, pose, look, box, shape, m, seed, out)

    return solid


_solid_kernel = _compiled_kernel(STAMP)
