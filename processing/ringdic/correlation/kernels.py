"""Compiled inverse-compositional Gauss-Newton (IC-GN) of subsets: one subset, and many on all cores.

The functions take plain numbers and arrays only.

Parameters of a subset, 12: u ux uy uxx uxy uyy v vx vy vxx vxy vyy, so that a pixel at (dx, dy) from the centre (x, y)
lies in the current image at x + dx + u + ux dx + uy dy + ½ uxx dx² + uxy dx dy + ½ uyy dy², likewise in y (Lu & Cary
2000). First order keeps the second derivatives at their start values (zero, or a known curvature): its free parameters
are six. Criterion: zero-mean normalised sum of squared differences; scheme: Baker & Matthews (2004).

Structure. A subset is packed once into vectors of LANES pixels of one row (``subset``): the grey level f and its
gradient, zero for pixels outside the subset or the mask, so that a circle and a mask cost nothing. An iteration first
computes the position of every vector in the current image (``_locate_vectors``). Then it interpolates the grey levels g
(``interpolation``) and adds them to all the sums that a step needs (``level_sums``). The Hessian comes from the moments
Σ q dx^i dy^k of products q of the gradients; no steepest-descent image is stored.

Variants. The order and the degree are given by types: ``second`` is True or None, and so is ``cubic``. The compiler
leaves out what only a value other than None needs, and compiles the functions anew for each of the combinations in use.

Precision. With float32 images, fractions of pixels resolve 1e-7 px; f and g are taken about a level near their mean;
lanes are summed in single precision over a strip of the subset, everything after that in double. With float64 images
all of it is double.

The page ``docs/pages/kernels.md`` says why it is built so and what each part gains.
"""

# Numba's cache follows the file of the compiled function alone: after a change in what it imports, remove __pycache__.
from __future__ import annotations

import math

import numba as nb
import numpy as np

from ringdic.correlation.interpolation import (
    ACROSS_X,
    ACROSS_Y,
    FAST,
    REACH_OF_WINDOW,
    SCATTERED,
    WIDE,
    maximum,
)
from ringdic.correlation.lanes import (
    BITS,
    INNER,
    LANES,
    blend,
    floor,
    load,
    pointer,
    store,
    store_integers,
)
from ringdic.correlation.level_sums import sum_levels
from ringdic.correlation.spline import PAD
from ringdic.correlation.subset import (
    MOMENTS,
    centre_level,
    moments,
    normal_matrix,
    pack,
    pack_interior,
    read_cache,
    template,
    well_inside,
    write_cache,
)
from ringdic.correlation.warps import cholesky, compose_inverse, compose_inverse_affine, solve_cholesky, variance

GOOD, NO_CONVERGENCE, OUTSIDE, NO_TEXTURE = 0, 2, 5, 6
N_PARAMETERS = 12
_F, _U = np.float32, np.uint64
_L = np.uint64(LANES)
_ROUNDING = 1e-5  # px; steps below it that no longer shrink are rounding errors of single precision
_SLOWER = 2.0  # safety factor on the predicted length of the next step: steps may shrink half as fast
_SAMPLE = 4  # points of a chunk that must have made two steps before another may stop after one
_SIMILAR = 2.0  # largest 1 - ZNCC of a point that may stop after one step, times the mean of those points
_JUDGED_FROM = 6  # steps from which on a point is given up that will not converge in the steps left
_SPAN = 3  # steps over which the speed of convergence is then judged
CHUNK = 64  # points among which a start value is handed on
_RELIABLE = 0.9  # least ZNCC of a match that the next point may start from
_PAD = PAD


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def _locate_vectors(fx, fy, p, corner, n, place, cell):  # type: ignore[no-untyped-def]
    """Positions of n vectors of pixels in the current image under the warp p (12,), LANES vectors at a time.

    fx, fy : fraction of the centre's position. corner : (2, m), dx and dy of lane 0 of each vector, m the multiple of
        LANES from n on.
    place : (4, m), filled: tx sx ty sy, fraction of the position of lane 0 and slope from lane to lane, in x and in y.
    cell : (3, m) int32, filled: column and row of the pixel at the position, counted from the centre's, and the case of
        the interpolation.

    A vector's own dx and dy are whole numbers and added last, so that the rest is small and single precision is enough.
    """
    kind = place.dtype.type
    ux, uy, vx, vy = kind(p[1]), kind(p[2]), kind(p[7]), kind(p[8])
    qx, xy, mx = kind(0.5 * p[3]), kind(p[4]), kind(0.5 * p[5])
    qy, yx, my = kind(0.5 * p[9]), kind(p[10]), kind(0.5 * p[11])
    far, one = kind(LANES - 1), kind(1)
    bend_x, bend_y = abs(qx) * kind(0.25) * far * far, abs(qy) * kind(0.25) * far * far
    at_x, at_y, number, shape = pointer(corner[0]), pointer(corner[1]), pointer(cell[0]), pointer(place[0])
    step = _U(place.shape[1])
    for v in range(_U(0), _U(n), _L):
        dx, dy = load(at_x, v), load(at_y, v)
        x = dx * (qx * dx + xy * dy + ux) + dy * (mx * dy + uy) + fx
        y = dx * (qy * dx + yx * dy + vx) + dy * (my * dy + vy) + fy
        sx, sy = (qx + qx) * dx + xy * dy + ux, (qy + qy) * dx + yx * dy + vx
        x_far, y_far = far * (sx + far * qx) + x, far * (sy + far * qy) + y
        j, i = floor(_minimum(x, x_far) - bend_x), floor(_minimum(y, y_far) - bend_y)
        wide, high = floor(maximum(x, x_far) + bend_x) - j, floor(maximum(y, y_far) + bend_y) - i
        window = blend(
            maximum(x, x_far + far) + bend_x - j >= kind(REACH_OF_WINDOW), kind(SCATTERED), high + kind(WIDE)
        )
        store_integers(number, v, j + dx)
        store_integers(number, v + step, i + dy)
        near = wide * kind(ACROSS_X) + high * kind(ACROSS_Y)
        store_integers(number, v + step + step, blend(maximum(wide, high) >= one + one, window, near))
        store(shape, v, x - j)
        store(shape, v + step, sx)
        store(shape, v + step + step, y - i)
        store(shape, v + step + step + step, sy)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _minimum(one, other):  # type: ignore[no-untyped-def]
    """The smaller of two vectors, lane by lane."""
    return blend(one >= other, other, one)


@nb.njit(nogil=True, cache=True, **INNER)
def _clearly_inside(shape, x, y, p, reach):  # type: ignore[no-untyped-def]
    """Whether all pixels within ``reach`` of the centre certainly lie inside the current image.

    shape : of the padded coefficients. x, y : the centre. p : (12,), the warp.
    """
    x0, y0, r = x + p[0], y + p[6], float(reach)
    reach_x = r * (1.0 + abs(p[1]) + abs(p[2]) + r * (0.5 * abs(p[3]) + abs(p[4]) + 0.5 * abs(p[5])))
    reach_y = r * (1.0 + abs(p[7]) + abs(p[8]) + r * (0.5 * abs(p[9]) + abs(p[10]) + 0.5 * abs(p[11])))
    last_x, last_y = float(shape[1] - 2 * _PAD - 1), float(shape[0] - 2 * _PAD - 1)
    return x0 > reach_x and y0 > reach_y and x0 + reach_x < last_x and y0 + reach_y < last_y


@nb.njit(nogil=True, cache=True, **INNER)
def _all_pixels_inside(shape, x, y, p, corner, bits):  # type: ignore[no-untyped-def]
    """Whether the pixels of the subset lie in the current image, and the other lanes of its vectors in the padding.

    shape : of the padded coefficients. x, y : the centre. p : (12,), the warp. corner, bits : of the vectors.
    """
    last_x, last_y = float(shape[1] - 2 * _PAD - 1), float(shape[0] - 2 * _PAD - 1)
    x0, y0 = x + p[0], y + p[6]
    for v in range(bits.shape[0]):
        for lane in range(LANES):
            dx, dy = float(corner[0, v]) + lane, float(corner[1, v])
            at_x = x0 + dx + dx * (p[1] + 0.5 * p[3] * dx + p[4] * dy) + dy * (p[2] + 0.5 * p[5] * dy)
            at_y = y0 + dy + dx * (p[7] + 0.5 * p[9] * dx + p[10] * dy) + dy * (p[8] + 0.5 * p[11] * dy)
            edge = 0.0 if (bits[v] >> lane) & 1 else _PAD - 6.0
            if not (at_x >= -edge and at_y >= -edge and at_x <= last_x + edge and at_y <= last_y + edge):
                return False
    return True


@nb.njit(cache=True, nogil=True, **INNER)
def _step(H, sums, sum_J, sum_fJ, mean_g, ratio, terms, b, d):  # type: ignore[no-untyped-def]
    """Increment d (12,) of the parameters from the sums of one pass; returns by how much it lowers the sum of squares.

    H : Cholesky factor of the normal matrix. ratio : of the norms of f and g. b : (2 terms,) scratch.
    """
    for k in range(terms):
        b[k] = ratio * (sums[4 + k] - mean_g * sum_J[k]) - sum_fJ[k]
        b[terms + k] = ratio * (sums[10 + k] - mean_g * sum_J[terms + k]) - sum_fJ[terms + k]
        d[k], d[6 + k] = b[k], b[terms + k]
    solve_cholesky(H, b, 2 * terms)
    gain = 0.0
    for k in range(terms):
        gain += d[k] * b[k] + d[6 + k] * b[terms + k]
        d[k], d[6 + k] = b[k], b[terms + k]
    return gain


@nb.njit(cache=True, nogil=True, **INNER)
def _step_square(d, radius):  # type: ignore[no-untyped-def]
    """Mean square displacement, px², of the subset's rim under an increment d (12,)."""
    r2 = float(radius * radius)
    first = d[1] * d[1] + d[2] * d[2] + d[7] * d[7] + d[8] * d[8]
    second = d[3] * d[3] + d[5] * d[5] + d[9] * d[9] + d[11] * d[11] + 4 * (d[4] * d[4] + d[10] * d[10])
    return d[0] * d[0] + d[6] * d[6] + r2 * first + 0.25 * r2 * r2 * second


@nb.njit(cache=True, nogil=True, **INNER)
def _next_step_square(step_square, previous, second, unlike, convergence):  # type: ignore[no-untyped-def]
    """Predicted square of the next step's length, from the squares of the last step and of the one before (0 for none).

    Steps shrink by the factor between the last two. After a first step, the factor is taken from other points of the
    same images, if this point's 1 - ZNCC, ``unlike``, is like theirs. second : whether this was the point's second
    step; then it is added to convergence (3,), sums over such points: their number, their shrinkage factors, and their
    1 - ZNCC.
    """
    if previous == 0.0:
        if convergence[0] < _SAMPLE or unlike * convergence[0] > _SIMILAR * convergence[2]:
            return step_square
        shrinkage = convergence[1] / convergence[0]
    else:
        shrinkage = math.sqrt(step_square / previous)
        if second:
            convergence[0] += 1.0
            convergence[1] += min(shrinkage, 1.0)
            convergence[2] += unlike
    return step_square * min(_SLOWER * shrinkage, 1.0) ** 2


@nb.njit(forceinline=True, nogil=True, **INNER)
def _refine_point(  # type: ignore[no-untyped-def]
    image, gx, gy, coef_ref, stride_ref, mask, shape_ref, coef, shape, x_ref, y_ref, x_cur, y_cur, p,
    corner, corner_f, offset, uncut, strips, radius, second, cubic, tolerance, max_iterations, texture, noise,
    cache, cached, cache_row, convergence, px, bits, place, cell, bend, lanes, H, moment, vectors, A, B,
):  # fmt: skip
    """Refine the parameters p (12,) of one subset in place by IC-GN.

    (x_ref, y_ref) and (x_cur, y_cur) : the centre in the two images' own crops. corner, uncut, strips : the template;
    corner_f the same as floats, filled up to a multiple of LANES. offset : (n,), of lane 0 from the centre in the
    reference's crop. cache, cached, cache_row : rows of values that ``write_cache`` stored, which of them are filled,
    and this subset's row, -1 for none. convergence : (3,), see ``_next_step_square``. The rest is scratch.

    Returns status, ZNCC, iterations, and sigma of u and of v in px.

    One function of more than a screen on purpose: it is inlined into the loop over the points (a call would hand over
    some forty arrays, a twentieth of a point's time), and its parts share nearly all of their variables.
    """
    n, terms, kind = corner.shape[1], 3 if second is None else 6, px.dtype.type
    size = 2 * terms
    sums, sum_J, sum_fJ, b, d = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    d[:] = 0.0
    column, row = math.floor(x_ref), math.floor(y_ref)
    level = centre_level(image, shape_ref, x_ref, y_ref)
    direct = x_ref == column and y_ref == row and well_inside(shape_ref, x_ref, y_ref, radius)
    if not direct:
        pack(image, gx, gy, coef_ref, stride_ref, mask, shape_ref, x_ref, y_ref, radius, cubic, corner, uncut, px, bits)
    at_centre = row * shape_ref[1] + column
    if cache_row >= 0 and cached[cache_row]:
        if direct:
            pack_interior(image, gx, gy, mask, at_centre, offset, level, uncut, px, bits)
        mean_f, norm_f, pixels = read_cache(cache[cache_row], size, H, sum_J, sum_fJ)
    else:
        sum_f, sum_ff, count = moments(
            direct, second,
            image, gx, gy, mask, at_centre, offset, level, uncut, px, bits, corner_f, strips, lanes,
            moment,
        )  # fmt: skip
        pixels = float(count)
        if pixels < max(0.15 * (2 * radius + 1) ** 2, 6 * terms):
            return NO_TEXTURE, np.nan, 0, np.nan, np.nan
        mean_f = sum_f / pixels
        norm_f = math.sqrt(max(sum_ff - pixels * mean_f * mean_f, 0.0))
        normal_matrix(moment, mean_f, terms, H, sum_J, sum_fJ)
        half_trace = 0.5 * (H[0, 0] + H[terms, terms])
        spread = math.sqrt((0.5 * (H[0, 0] - H[terms, terms])) ** 2 + H[terms, 0] ** 2)
        if not half_trace - spread > pixels * texture * texture or not norm_f > 0.0 or not cholesky(H, size):
            return NO_TEXTURE, np.nan, 0, np.nan, np.nan
        if cache_row >= 0:
            write_cache(cache[cache_row], size, H, sum_J, sum_fJ, mean_f, norm_f, pixels)
            cached[cache_row] = True

    stride, first_tap = _U(shape[1]), 2 if cubic is None else 1
    rounding = _ROUNDING if px.itemsize == 4 else 0.0
    about = (level + mean_f) * (14400.0 if cubic is None else 36.0)  # in the scale of the interpolated g
    status, zncc, iterations, previous = NO_CONVERGENCE, np.nan, 0, 0.0
    limit, earlier = tolerance * tolerance, (np.inf, np.inf)
    for _ in range(max_iterations):
        iterations += 1
        if not _clearly_inside(shape, x_cur, y_cur, p, radius + LANES) and not _all_pixels_inside(
            shape, x_cur, y_cur, p, corner, bits
        ):
            return OUTSIDE, np.nan, iterations, np.nan, np.nan
        column, row = math.floor(x_cur + p[0]), math.floor(y_cur + p[6])
        _locate_vectors(kind(x_cur + p[0] - column), kind(y_cur + p[6] - row), p, corner_f, n, place, cell)
        origin = (row + _PAD - first_tap) * shape[1] + column + _PAD - first_tap
        bend[0], bend[1] = 0.5 * p[3], 0.5 * p[9]
        about = float(kind(about))
        sum_levels(
            cubic, second,
            coef, stride, origin, place, cell, bend, px, bits, corner_f, strips, kind(about), lanes, sums,
        )  # fmt: skip
        mean_g = sums[0] / pixels
        sum_gg = sums[1] - pixels * mean_g * mean_g
        if not sum_gg > 1e-9 * pixels:
            return NO_TEXTURE, np.nan, iterations, np.nan, np.nan
        norm_g = math.sqrt(sum_gg)
        zncc = min((sums[2] - mean_f * sums[0]) / (norm_f * norm_g), 1.0)
        gain = _step(H, sums, sum_J, sum_fJ, mean_g, norm_f / norm_g, terms, b, d)
        about += mean_g
        step_square = _step_square(d, radius)
        if not step_square < 4.0 * radius * radius:
            break
        if second is not None:
            composed = compose_inverse(p, d, A, B)
        else:
            composed = compose_inverse_affine(p, d)
        if not composed:
            break
        next_square = _next_step_square(step_square, previous, iterations == 2, 1.0 - zncc, convergence)
        if next_square < limit or 0.0 < previous <= step_square < rounding * rounding:
            status = GOOD
            zncc = min(zncc + 0.5 * gain / (norm_f * norm_f), 1.0)  # after the last step
            break
        if iterations >= _JUDGED_FROM and step_square >= rounding * rounding:
            shrinkage = math.log(earlier[1] / step_square) / _SPAN
            if not iterations + math.log(step_square / limit) / shrinkage < max_iterations:
                break
        earlier = (previous, earlier[0])
        previous = step_square
    if status != GOOD:
        return status, zncc, iterations, np.nan, np.nan
    # The residual f' - r g' contains the noise of both images: its standard deviation is √2 σ.
    scatter = math.sqrt(2.0) * noise
    if not noise > 0.0:
        scatter = norm_f * math.sqrt(max(2.0 * (1.0 - zncc), 0.0) / (pixels - size - 2))
    sigma_u = scatter * math.sqrt(variance(H, b, size, 0))
    return status, zncc, iterations, sigma_u, scatter * math.sqrt(variance(H, b, size, terms))


@nb.njit(cache=True, nogil=True, **INNER)
def _start_from_previous(source, offset, reach, p):  # type: ignore[no-untyped-def]
    """Replace the start values p (12,) by another point's match, extrapolated by an offset (2,) px, if the two agree.

    source : (12,), parameters of that match. reach : px, largest offset. They agree if they differ by less than 1 px.
    """
    dx, dy = offset
    if max(abs(dx), abs(dy)) > reach:
        return
    q = source.copy()
    for at in (0, 6):
        xx, xy, yy = source[at + 3], source[at + 4], source[at + 5]
        q[at] += source[at + 1] * dx + source[at + 2] * dy + 0.5 * xx * dx * dx + xy * dx * dy + 0.5 * yy * dy * dy
        q[at + 1] += xx * dx + xy * dy
        q[at + 2] += xy * dx + yy * dy
    if abs(q[0] - p[0]) < 1.0 and abs(q[6] - p[6]) < 1.0:
        for k in range(12):
            p[k] = q[k]


@nb.njit(cache=True, nogil=True, **INNER)
def _scratch(rows, columns, kind):  # type: ignore[no-untyped-def]
    """Scratch array (rows, columns) of the type of ``kind``, aligned to 64 bytes.

    A vector is then one line of the cache.
    """
    raw = np.empty(rows * columns + 64 // kind.itemsize, kind.dtype)
    skip = (-raw.ctypes.data % 64) // kind.itemsize
    return raw[skip : skip + rows * columns].reshape(rows, columns)


@nb.njit(cache=True, nogil=True)
def refine_points(  # type: ignore[no-untyped-def]
    first, last, image, gx, gy, coef_ref, mask, origin_ref, coef, origin_cur, xy, order, parameters, known,
    radius, circle, second, cubic, tolerance, max_iterations, texture, noise, neighbour_reach,
    cache, cached, cache_row, status, zncc, iterations, sigma,
):  # fmt: skip
    """IC-GN of the points of some chunks. These are independent: results do not depend on the number of threads.

    Parameters
    ----------
    first, last : of the chunks of CHUNK points in ``order``, the last one exclusive.
    image, gx, gy, mask : (h, w), grey levels, their gradient and the mask of the reference's crop at origin_ref (x, y).
    coef_ref : padded coefficients of that crop. coef : padded coefficients of the current image's crop at origin_cur.
    xy : (n, 2) px, points. order : (n,), the order in which they are taken.
    parameters : (n, 12), start values, replaced by the results. known : (n,) bool, points to refine.
    radius, circle : of the subset, px, and whether it is a circle or a square.
    second : True for shape functions of second order, None for first. cubic : True for a spline of degree 3, None for
        degree 5.
    tolerance : px, of a step's effect on the subset's rim. max_iterations : after which a point is given up.
    texture : least root-mean-square gradient. noise : standard deviation of the grey levels, 0 to take it from the
        residual.
    neighbour_reach : px; a point no farther from the previous one starts from that one's result if this is a reliable
        match and agrees with the point's own start value; 0 for never.
    cache : (N, width_of_subset), values of N subsets of this reference. cached : (N,) bool, rows that are filled.
        cache_row : (n,), each point's row, -1 for none. The first two are filled on the way.
    status, zncc, iterations, sigma : (n,), the last (n, 2) px; results, filled where known.
    """
    corner, uncut, strips = template(radius, circle)
    flat_ref, flat, n = coef_ref.ravel(), coef.ravel(), corner.shape[1]
    m = (n + LANES - 1) // LANES * LANES
    corner_f = np.zeros((2, m), coef.dtype)
    for v in range(n):
        corner_f[0, v], corner_f[1, v] = corner[0, v], corner[1, v]
    offset = corner[1] * image.shape[1] + corner[0]
    image_, gx_, gy_, mask_ = image.ravel(), gx.ravel(), gy.ravel(), mask.ravel()
    px, place, lanes = _scratch(4, n * LANES, flat), _scratch(4, m, flat), _scratch(MOMENTS, LANES, flat)
    bits, cell, bend = np.empty(n, BITS), np.empty((3, m), np.int32), np.empty(2, coef.dtype)
    H, moment, vectors = np.empty((12, 12)), np.empty((7, 15)), np.empty((5, 16))
    A, B = np.empty((6, 6)), np.empty((6, 6))
    for chunk in range(first, last):
        before, convergence = -1, np.zeros(3)
        for k in order[chunk * CHUNK : (chunk + 1) * CHUNK]:
            if known[k]:
                if before >= 0:
                    _start_from_previous(parameters[before], xy[k] - xy[before], neighbour_reach, parameters[k])
                result = _refine_point(
                    image_, gx_, gy_, flat_ref, _U(coef_ref.shape[1]), mask_, image.shape, flat, coef.shape,
                    xy[k, 0] - origin_ref[0], xy[k, 1] - origin_ref[1], xy[k, 0] - origin_cur[0],
                    xy[k, 1] - origin_cur[1], parameters[k], corner, corner_f, offset, uncut, strips,
                    radius, second, cubic, tolerance, max_iterations, texture, noise,
                    cache, cached, cache_row[k], convergence,
                    px, bits, place, cell, bend, lanes, H, moment, vectors, A, B,
                )  # fmt: skip
                status[k] = result[0]
                zncc[k] = result[1]
                iterations[k] = result[2]
                sigma[k, 0] = result[3]
                sigma[k, 1] = result[4]
                before = k if neighbour_reach > 0.0 and result[0] == GOOD and result[1] > _RELIABLE else -1
