"""Images of the scenes by ray tracing: each sample of a pixel has the brightness of the surface that its ray meets.

The printed pattern is averaged over the sample's footprint on the surface. A pixel whose footprint on a speckled body
is small takes one sample, any other the mean of ``SAMPLES``² samples on a grid. Radiance is linear; 1 saturates.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic_node.virtual_rig.arrays import Radiance
from ringdic_node.virtual_rig.body import CYLINDER, approach, body_point
from ringdic_node.virtual_rig.disturbance import CALM, ShotCondition, mosaicked, smeared
from ringdic_node.virtual_rig.lens import VirtualCamera, ideal_of_pixel
from ringdic_node.virtual_rig.rig import paper_rig
from ringdic_node.virtual_rig.room import BLACK, SKIN, STAMP, WHITE, brightness, room_radiance, to_world
from ringdic_node.virtual_rig.scenes import BoardScene, Scene, SolidSpecimen, Specimen, TargetScene
from ringdic_node.virtual_rig.scenes import scene as make_scene
from ringdic_node.virtual_rig.scenes.board import MARGIN, SQUARE, SQUARES, bow_height
from ringdic_node.virtual_rig.scenes.damage import BAR, GLARE_PEAK, GLARE_WIDTH, Damage
from ringdic_node.virtual_rig.sensor import POINT_SPREAD, blurred, expose
from ringdic_node.virtual_rig.texture import RADIUS, checker, covered, dots, speckle

SAMPLES = 2
# mm on the surface: a pixel with a footprint no larger takes one sample. The error of a subset of 41 px is then less
# than 0.0001 px in the mean and 0.0007 px for each, a fifth of what the sensor's noise makes.
FINE = 0.2
_BASE = 0.03  # reflectance times exposure
_TARGET_TOP, _BASE_RADIUS, _BASE_BOTTOM = 250.0, 66.0, -35.0  # mm
_PRINT_SPECKLE, _PRINT_DOTS = 0, 1
_FAR = 400.0  # mm, further than any camera is from the body
_GRAZING = 0.02  # mm, by which the estimated clearance of a ray that meets the limb may be wrong


def render(camera: VirtualCamera, scene: Scene, seed: int = 0, condition: ShotCondition = CALM) -> NDArray[np.uint8]:
    """The image of a scene as a camera delivers it: (height, width) grey levels.

    seed : of the sensor's noise. condition : exposure, noise and motion of the image.
    """
    light = smeared(radiance(camera, scene), condition.smear)
    light = mosaicked(light) if condition.mosaic else light
    image = expose(light, seed, condition.light, condition.noise)
    if condition.upside_down:
        image = image[::-1, ::-1]
    return np.ascontiguousarray(image[:, ::-1] if condition.mirrored else image)


def load_renderer(specimen: str = "limb") -> None:
    """Load, or compile and cache, everything that rendering needs, by rendering each kind of scene very small."""
    small = paper_rig(cameras=12, scale=0.05).cameras[0]
    for kind in ("board", "target", "specimen"):
        render(small, make_scene(kind, 0, specimen=specimen), 0)


def radiance(camera: VirtualCamera, scene: Scene) -> Radiance:
    """Noise-free image (height, width) of a scene after the lens, in linear light without unit; 1 saturates."""
    if isinstance(scene, SolidSpecimen):
        from ringdic_node.virtual_rig.solid_render import solid_radiance  # compiled only where a solid body is rendered

        return solid_radiance(camera, scene)
    out = np.zeros((camera.height, camera.width), np.float32)
    if isinstance(scene, BoardScene):
        R, t = scene.pose(camera)
        _board_kernel(camera.lens, camera.R, camera.centre, R, t, scene.bow, out)
        return blurred(out)
    if isinstance(scene, TargetScene):
        look = np.array([_PRINT_DOTS, 0.0, 0.0, 0.0, _TARGET_TOP, _widest(scene)])
        prints, damage, seed = scene.prints(), Damage(), 0
    else:
        look = np.array([_PRINT_SPECKLE, *scene.band, *_extent(scene), _widest(scene)])
        prints, damage, seed = np.zeros((1, 1, 2)), scene.damage, scene.seed
    marks = (prints, *damage.arrays())
    _body_kernel(camera.lens, camera.R, camera.centre, scene.body(), look, seed, marks, out)
    return blurred(out) if isinstance(scene, TargetScene) else out


def _extent(scene: Specimen) -> tuple[float, float]:
    """Lowest and highest z of the body, mm; a limb extends beyond the image."""
    return (0.0, _TARGET_TOP) if scene.body()[0] == CYLINDER else (-120.0, 420.0)


def _widest(scene: Specimen | TargetScene) -> float:
    """Radius about the z axis, mm, that body and base nowhere exceed at the heights that cameras see."""
    if isinstance(scene, TargetScene) or scene.body()[0] == CYLINDER:
        return _BASE_RADIUS + math.hypot(*scene.body()[2:4])
    theta, z = np.meshgrid(np.linspace(0.0, 2.0 * math.pi, 73), np.linspace(-120.0, 370.0, 50))
    xyz = scene.surface.position(theta, z, scene.step)
    return float(np.hypot(xyz[..., 0], xyz[..., 1]).max()) + 1.0


@nb.njit(nogil=True)
def _on_cylinder(o, d, radius, x, y):  # type: ignore[no-untyped-def]
    """Distance along the ray to the nearer wall of an upright cylinder about (x, y), or -1."""
    ox, oy = o[0] - x, o[1] - y
    a = d[0] * d[0] + d[1] * d[1]
    b = ox * d[0] + oy * d[1]
    root = b * b - a * (ox * ox + oy * oy - radius * radius)
    return (-b - math.sqrt(root)) / a if root > 0.0 else -1.0


@nb.njit(nogil=True)
def _miss(o, d, p):  # type: ignore[no-untyped-def]
    """Distance between a ray and the wall of the cylinder p, seen along z, mm; negative if it meets the wall."""
    cross = (o[0] - p[2]) * d[1] - (o[1] - p[3]) * d[0]
    return abs(cross) / math.sqrt(d[0] * d[0] + d[1] * d[1]) - p[1]


@nb.njit(nogil=True)
def _corrected(o, d, frame, theta, z, t):  # type: ignore[no-untyped-def]
    """One Newton step towards the point in which a ray meets the body, from theta, z, t.

    frame : position and tangents of the body at theta, z. Returns theta, z, t and whether they have converged on a side
    that faces the camera.
    """
    x, y, h, tx, ty, tz, zx, zy, zz = frame
    ex, ey, ez = o[0] + t * d[0] - x, o[1] + t * d[1] - y, o[2] + t * d[2] - h
    # Solve [T Z -d] (dtheta, dz, dt) = e by Cramer's rule.
    nx, ny, nz = ty * zz - tz * zy, tz * zx - tx * zz, tx * zy - ty * zx
    det = -(nx * d[0] + ny * d[1] + nz * d[2])
    if det == 0.0:
        return theta, z, t, False
    dt = (nx * ex + ny * ey + nz * ez) / det
    fx, fy, fz = ex + dt * d[0], ey + dt * d[1], ez + dt * d[2]
    a, b, c = tx * tx + ty * ty + tz * tz, tx * zx + ty * zy + tz * zz, zx * zx + zy * zy + zz * zz
    f, g = tx * fx + ty * fy + tz * fz, zx * fx + zy * fy + zz * fz
    area = a * c - b * b
    dtheta, dz = (c * f - b * g) / area, (a * g - b * f) / area
    dtheta = min(0.5, max(-0.5, dtheta))
    # Quadratic convergence: a step so small leaves less than 1e-6 mm.
    settled = det > 0.0 and abs(dtheta) < 2e-5 and abs(dz) < 1e-3
    return theta + dtheta, z + dz, t + dt, settled


@nb.njit(nogil=True)
def _place(theta, z, p, frame):  # type: ignore[no-untyped-def]
    """Write position and tangents of the body at theta, z to frame: x y z, d/dtheta x y z, d/dz x y z."""
    values = body_point(theta, z, p)
    for i in range(9):
        frame[i] = values[i]


@nb.njit(nogil=True)
def _newton(o, d, p, theta, z, t, frame):  # type: ignore[no-untyped-def]
    """Point in which a ray meets the limb, by Newton's method from theta, z, t: theta, z, t, and whether it meets it.

    Fills frame with the position and tangents there.
    """
    for k in range(10):
        _place(theta, z, p, frame)
        before = theta
        theta, z, t, settled = _corrected(o, d, frame, theta, z, t)
        if settled:
            return theta, z, t, t > 0.0
        if k > 4 and abs(theta - before) > 0.02:  # wanders: the ray passes by
            break
    return theta, z, t, False


@nb.njit(nogil=True)
def _on_limb(o, d, p, near, theta, z, t, frame):  # type: ignore[no-untyped-def]
    """First point in which a ray meets the limb, or its clearance.

    near : whether theta, z, t are those of a ray close by.
    Returns theta, z, t, met, clearance (mm, 0 if met). Fills frame where it meets.
    """
    if near:
        theta, z, t, met = _newton(o, d, p, theta, z, t, frame)
        if met:
            return theta, z, t, True, 0.0
    clearance, theta, z, t = approach(o, d, p)
    if clearance > _GRAZING:
        return theta, z, t, False, clearance
    theta, z, t, met = _newton(o, d, p, theta, z, t, frame)
    return theta, z, t, met, max(clearance, 0.0)


@nb.njit(nogil=True)
def _on_round(o, d, p, frame):  # type: ignore[no-untyped-def]
    """Point in which a ray meets the cylinder: theta, z, t, and whether it meets it; then fills frame."""
    t = _on_cylinder(o, d, p[1], p[2], p[3])
    if t < 0.0:
        return 0.0, 0.0, t, False
    theta = math.atan2(o[1] + t * d[1] - p[3], o[0] + t * d[0] - p[2])
    z = o[2] + t * d[2] - p[4]
    _place(theta, z, p, frame)
    return theta, z, t, True


@nb.njit(nogil=True)
def _footprint(d, t, frame, per_x, per_y):  # type: ignore[no-untyped-def]
    """Widths that a sample covers along arc and height of the print, mm. per_x, per_y : its widths at distance 1."""
    _, _, _, tx, ty, tz, zx, zy, zz = frame
    nx, ny = ty * zz - tz * zy, tz * zx - tx * zz
    along = math.sqrt(tx * tx + ty * ty + tz * tz)
    flat = -(nx * d[0] + ny * d[1]) / (math.sqrt(nx * nx + ny * ny) * math.sqrt(d[0] * d[0] + d[1] * d[1]))
    ws = t * per_x * RADIUS / along / max(0.05, flat)
    return ws, t * per_y / math.sqrt(zx * zx + zy * zy + zz * zz)


@nb.njit(nogil=True)
def _shade(o, d, p, look, seed, marks, theta, z, t, frame, per_x, per_y, samples):  # type: ignore[no-untyped-def]
    """Brightness of the body where a ray meets it.

    per_x, per_y : width of a sample at distance 1. samples : width of a pixel in samples. look : as in `_render_body`.
    marks : print errors of the target; worn patches, lamps and bars of a specimen.
    """
    _, _, _, tx, ty, tz, zx, zy, zz = frame
    nx, ny, nz = ty * zz - tz * zy, tz * zx - tx * zz, tx * zy - ty * zx
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    cosine = max(0.02, -(nx * d[0] + ny * d[1] + nz * d[2]) / (size * length))
    ws, wz = _footprint(d, t, frame, per_x, per_y)
    s = (theta - 2.0 * math.pi * math.floor(theta / (2.0 * math.pi))) * RADIUS
    light = brightness(cosine) * (1.0 - 0.0006 * abs(z - 130.0))
    if look[0] == _PRINT_DOTS:
        dark = dots(s, z, ws, wz, marks[0])
        return light * (WHITE + dark * (BLACK - WHITE))
    glare = _glare(o, d, t, nx / size, ny / size, nz / size, length, marks[2]) if len(marks[2]) else 0.0
    if p[0] != CYLINDER and not look[1] + 6.0 < z < look[2] - 6.0:
        ragged = 2.0 * math.sin(5.0 * theta) + 1.3 * math.sin(13.0 * theta + 1.0) + 0.6 * math.sin(31.0 * theta)
        low, high = look[1] - 3.0 + 0.5 * ragged, look[2] + 3.0 + 0.5 * ragged
        if z < low or z > high:
            return glare + light * SKIN * (1.0 + 0.03 * math.sin(0.8 * z + 3.0 * math.sin(4.0 * theta)))
    blur = math.sqrt((POINT_SPREAD * samples) ** 2 + 1.0 / 12.0)  # of lens and sample, in widths of a sample
    dark = speckle(s, z, blur * ws, blur * wz, seed) if look[1] < z < look[2] else 0.0
    if dark > 0.0 and len(marks[1]):
        dark *= 1.0 - _worn(s, z, ws + wz, marks[1])
    return glare + light * (WHITE + dark * (BLACK - WHITE))


@nb.njit(nogil=True)
def _worn(s, z, wide, patches):  # type: ignore[no-untyped-def]
    """Share of a sample of this width that lies in a patch whose speckles are worn off."""
    share = 0.0
    for k in range(len(patches)):
        off = s - patches[k, 0]
        off -= 2.0 * math.pi * RADIUS * math.floor(off / (2.0 * math.pi * RADIUS) + 0.5)
        a, b = off / patches[k, 2], (z - patches[k, 1]) / patches[k, 3]
        share = max(share, covered((math.sqrt(a * a + b * b) - 1.0) * min(patches[k, 2], patches[k, 3]), wide))
    return share


@nb.njit(nogil=True)
def _glare(o, d, t, nx, ny, nz, length, lamps):  # type: ignore[no-untyped-def]
    """Radiance of the lamps' reflections: a lobe of the normal about the half vector between lamp and camera."""
    x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
    total = 0.0
    for k in range(len(lamps)):
        lx, ly, lz = lamps[k, 0] - x, lamps[k, 1] - y, lamps[k, 2] - z
        far = math.sqrt(lx * lx + ly * ly + lz * lz)
        if lx * nx + ly * ny + lz * nz <= 0.0:
            continue
        hx, hy, hz = lx / far - d[0] / length, ly / far - d[1] / length, lz / far - d[2] / length
        cosine = (hx * nx + hy * ny + hz * nz) / math.sqrt(hx * hx + hy * hy + hz * hz)
        total += GLARE_PEAK * math.exp((cosine - 1.0) / (GLARE_WIDTH * GLARE_WIDTH))
    return total


@nb.njit(nogil=True)
def _before_bars(o, d, t, wide, bars, value):  # type: ignore[no-untyped-def]
    """Radiance along a ray, where bars may stand before the surface.

    t : distance to the surface, 0 for none; value : its radiance. wide : width of the sample at distance 1.
    """
    for k in range(len(bars)):
        ex, ey, ez = bars[k, 3] - bars[k, 0], bars[k, 4] - bars[k, 1], bars[k, 5] - bars[k, 2]
        wx, wy, wz = o[0] - bars[k, 0], o[1] - bars[k, 1], o[2] - bars[k, 2]
        a, b = d[0] * d[0] + d[1] * d[1] + d[2] * d[2], d[0] * ex + d[1] * ey + d[2] * ez
        c, f, g = ex * ex + ey * ey + ez * ez, d[0] * wx + d[1] * wy + d[2] * wz, ex * wx + ey * wy + ez * wz
        along = min(1.0, max(0.0, (a * g - b * f) / max(a * c - b * b, 1e-12)))
        at = (b * along - f) / a
        if at <= 0.0 or (t > 0.0 and at > t):
            continue
        gx, gy, gz = wx + at * d[0] - along * ex, wy + at * d[1] - along * ey, wz + at * d[2] - along * ez
        share = covered(math.sqrt(gx * gx + gy * gy + gz * gz) - bars[k, 6], wide * at)
        value += share * (BAR - value)
    return value


@nb.njit(nogil=True)
def _render_body(lens, R, o, p, look, seed, marks, out):  # type: ignore[no-untyped-def]
    """Render a body on its base in front of the room.

    look : kind of print, lowest and highest z of the speckles, bottom and top of the body, largest radius; mm.
    """
    height, width = out.shape
    d, straight, middle, frame = np.empty(3), np.empty(3), np.empty(9), np.empty(9)
    share = 1.0 / SAMPLES
    per_x, per_y = share / lens[0], share / lens[1]
    round_body = p[0] == CYLINDER
    first_x, first_y = -lens[3] / lens[0], -lens[4] / lens[1]  # the first pixel, were there no distortion
    for v in range(height):
        theta = z = t = 0.0
        near = False
        x, y = first_x, first_y  # starts from the first pixel of the row above
        for u in range(width):
            x, y, xu, xv, yu, yv = ideal_of_pixel(u, v, lens, x, y)
            if u == 0:
                first_x, first_y = x, y
            to_world(R, x, y, straight)
            beside = _on_cylinder(o, straight, look[5], 0.0, 0.0) < 0.0
            if round_body:
                near = False
                if not beside:
                    theta, z, t, near = _on_round(o, straight, p, middle)
                    if not near and _miss(o, straight, p) > 2.0 * SAMPLES * per_x * _FAR:
                        value = _behind(o, straight, p, SAMPLES * per_x)
                        out[v, u] = _before_bars(o, straight, 0.0, SAMPLES * per_x, marks[3], value)
                        continue
            elif not beside:
                theta, z, t, near, clearance = _on_limb(o, straight, p, near, theta, z, t, middle)
                beside = clearance > 2.0 * SAMPLES * per_x * t
            depth = t if near and look[3] <= z <= look[4] else 0.0
            if beside:  # one sample of the room is enough
                near = False
                room = room_radiance(o, straight, SAMPLES * per_x)
                out[v, u] = _before_bars(o, straight, 0.0, SAMPLES * per_x, marks[3], room)
                continue
            if near and look[0] == _PRINT_SPECKLE:
                ws, wz = _footprint(straight, t, middle, SAMPLES * per_x, SAMPLES * per_y)
                if max(ws, wz) < FINE and look[3] + wz < z < look[4] - wz:
                    value = _shade(
                        o, straight, p, look, seed, marks, theta, z, t, middle, SAMPLES * per_x, SAMPLES * per_y, 1
                    )
                    out[v, u] = _before_bars(o, straight, t, SAMPLES * per_x, marks[3], value)
                    continue
            total = 0.0
            for k in range(SAMPLES * SAMPLES):
                a = (k % SAMPLES + 0.5) * share - 0.5
                b = (k // SAMPLES + 0.5) * share - 0.5
                to_world(R, x + a * xu + b * xv, y + a * yu + b * yv, d)
                if round_body:
                    theta_k, z_k, t_k, met = _on_round(o, d, p, frame)
                else:
                    theta_k, z_k, t_k, met = _on_limb_beside(o, d, p, near, theta, z, t, middle, frame)
                if met and look[3] <= z_k <= look[4]:
                    total += _shade(o, d, p, look, seed, marks, theta_k, z_k, t_k, frame, per_x, per_y, SAMPLES)
                else:
                    total += _behind(o, d, p, per_x)
            out[v, u] = _before_bars(o, straight, depth, SAMPLES * per_x, marks[3], total * share * share)


@nb.njit(nogil=True)
def _on_limb_beside(o, d, p, near, theta, z, t, middle, frame):  # type: ignore[no-untyped-def]
    """Point in which a sample's ray meets the limb: mostly two Newton steps from that of the pixel's middle ray."""
    if near:
        theta_k, z_k, t_k, _ = _corrected(o, d, middle, theta, z, t)
        _place(theta_k, z_k, p, frame)
        theta_k, z_k, t_k, settled = _corrected(o, d, frame, theta_k, z_k, t_k)
        if settled:
            return theta_k, z_k, t_k, True
    theta_k, z_k, t_k, met, _ = _on_limb(o, d, p, near, theta, z, t, frame)
    return theta_k, z_k, t_k, met


@nb.njit(nogil=True)
def _behind(o, d, p, per):  # type: ignore[no-untyped-def]
    """Radiance behind the wall of the body: of the top and the base of a cylinder, else of the room."""
    if p[0] == CYLINDER:
        lid = (_TARGET_TOP + p[4] - o[2]) / d[2] if d[2] < 0.0 else 0.0
        if lid > 0.0 and (o[0] + lid * d[0] - p[2]) ** 2 + (o[1] + lid * d[1] - p[3]) ** 2 < p[1] * p[1]:
            return 2.0 * _BASE
        t = _on_cylinder(o, d, _BASE_RADIUS, p[2], p[3])
        if t > 0.0:
            h = o[2] + t * d[2]
            if _BASE_BOTTOM < h < 0.0:
                return _BASE
            if h >= 0.0 and d[2] < 0.0:  # onto the top of the base
                t = -o[2] / d[2]
                x, y = o[0] + t * d[0] - p[2], o[1] + t * d[1] - p[3]
                if x * x + y * y < _BASE_RADIUS * _BASE_RADIUS:
                    return 2.0 * _BASE
    return room_radiance(o, d, per)


@nb.njit(nogil=True)
def _board_sample(x, y, o, R, d, Rb, tb, bow, per_x, per_y):  # type: ignore[no-untyped-def]
    """Brightness along the ray (x, y, 1) of the camera's frame, and how many squares outside the sheet it passes."""
    slope = Rb[0, 2] * x + Rb[1, 2] * y + Rb[2, 2]
    off = Rb[0, 2] * tb[0] + Rb[1, 2] * tb[1] + Rb[2, 2] * tb[2]
    depth, bx, by = off / slope, 0.0, 0.0
    for _ in range(1 if bow == 0.0 else 5):  # each step multiplies the error by the slope of the bow, a few hundredths
        px, py, pz = depth * x - tb[0], depth * y - tb[1], depth - tb[2]
        bx = (Rb[0, 0] * px + Rb[1, 0] * py + Rb[2, 0] * pz) / SQUARE
        by = (Rb[0, 1] * px + Rb[1, 1] * py + Rb[2, 1] * pz) / SQUARE
        if bow != 0.0:
            depth = (off + bow_height(SQUARE * by, bow)) / slope
    outside = (
        max(abs(bx - SQUARES[0] / 2) - SQUARES[0] / 2, abs(by - SQUARES[1] / 2) - SQUARES[1] / 2) - MARGIN / SQUARE
    )
    if outside > 0.0 or depth < 0.0:
        to_world(R, x, y, d)
        return room_radiance(o, d, per_x), outside
    # Footprint of the sample: derivatives of the board's coordinates by x and y.
    across = Rb[0, 0] * x + Rb[1, 0] * y + Rb[2, 0]
    along = Rb[0, 1] * x + Rb[1, 1] * y + Rb[2, 1]
    gx, gy = Rb[0, 2] / slope, Rb[1, 2] / slope
    ux, uy = depth * per_x / SQUARE, depth * per_y / SQUARE
    wx = abs(Rb[0, 0] - gx * across) * ux + abs(Rb[1, 0] - gy * across) * uy
    wy = abs(Rb[0, 1] - gx * along) * ux + abs(Rb[1, 1] - gy * along) * uy
    cosine = abs(slope) / math.sqrt(x * x + y * y + 1.0)
    return brightness(cosine) * (WHITE + checker(bx, by, wx, wy) * (BLACK - WHITE)), outside


@nb.njit(nogil=True)
def _render_board(lens, R, o, Rb, tb, bow, out):  # type: ignore[no-untyped-def]
    """Render the sheet with the checkerboard in front of the room.

    Rb, tb : from the board's frame to the camera's. bow : of the sheet, mm.
    """
    height, width = out.shape
    d = np.empty(3)
    share = 1.0 / SAMPLES
    per_x, per_y = share / lens[0], share / lens[1]
    first_x, first_y = -lens[3] / lens[0], -lens[4] / lens[1]  # the first pixel, were there no distortion
    for v in range(height):
        x, y = first_x, first_y
        for u in range(width):
            x, y, xu, xv, yu, yv = ideal_of_pixel(u, v, lens, x, y)
            if u == 0:
                first_x, first_y = x, y
            total, outside = _board_sample(x, y, o, R, d, Rb, tb, bow, SAMPLES * per_x, SAMPLES * per_y)
            if outside > 1.0:  # more than a square beside the sheet: one sample of the room is enough
                out[v, u] = total
                continue
            total = 0.0
            for k in range(SAMPLES * SAMPLES):
                a = (k % SAMPLES + 0.5) * share - 0.5
                b = (k // SAMPLES + 0.5) * share - 0.5
                value, _ = _board_sample(x + a * xu + b * xv, y + a * yu + b * yv, o, R, d, Rb, tb, bow, per_x, per_y)
                total += value
            out[v, u] = total * share * share


def _compiled_kernels(stamp: int) -> tuple[Callable[..., None], Callable[..., None]]:
    """The kernels that render a body and a board, compiled and cached on disk under a key that includes the stamp."""

    @nb.njit(cache=True, nogil=True)
    def body(lens, R, o, p, look, seed, marks, out):  # type: ignore[no-untyped-def]
        if stamp >= 0:  # the kernel uses the stamp, so that numba includes it in the key of its cache
            _render_body(lens, R, o, p, look, seed, marks, out)

    @nb.njit(cache=True, nogil=True)
    def board(lens, R, o, Rb, tb, bow, out):  # type: ignore[no-untyped-def]
        if stamp >= 0:
            _render_board(lens, R, o, Rb, tb, bow, out)

    return body, board


_body_kernel, _board_kernel = _compiled_kernels(STAMP)
