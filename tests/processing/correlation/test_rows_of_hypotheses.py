"""The search among interpolated warp hypotheses against every warp tried plainly, all pixels interpolated."""

import cv2
import numpy as np
import pytest
from ringdic.correlation import WarpHypotheses, prepare_current, prepare_reference, search_hypotheses, search_warps

RADIUS, SIZE = 12, 220


def speckle_image(seed=0, width=SIZE):
    """Speckle some 5 px wide, about 128 ± 30. (SIZE, width)."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (SIZE, width))
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.8)
    return (128.0 + 30.0 * smooth / smooth.std()).clip(0.0, 255.0)


def displacement(x, y):
    """Displacement u, v at positions x, y of an affine motion, px."""
    return 2.3 + 0.02 * (x - 110) - 0.03 * (y - 110), -1.7 + 0.04 * (x - 110) + 0.01 * (y - 110)


def image_pair():
    """Reference and current image such that reference(x) = current(x + displacement(x))."""
    current = speckle_image()
    x, y = np.meshgrid(np.arange(SIZE, dtype=float), np.arange(SIZE, dtype=float))
    u, v = displacement(x, y)
    to = [(each).astype(np.float32) for each in (x + u, y + v)]
    return cv2.remap(current, *to, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), current


def points():
    """Positions (n, 2) px, a margin from the rim."""
    at = np.arange(30.0, SIZE - 30.0, 14.0)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def zncc_of_every_warp(reference, current, xy, warps):
    """ZNCC (n, K) of all warps over every second pixel of a circle, bilinear in the current image.

    reference, current : images. xy : (n, 2) px. warps : (n, K, 6). -1 where a pixel lies outside the current image.
    """
    offset = np.arange(-RADIUS, RADIUS + 1, 2)
    dx, dy = (each.ravel() for each in np.meshgrid(offset, offset))
    circle = dx**2 + dy**2 <= RADIUS**2
    dx, dy = dx[circle], dy[circle]
    score = np.full(warps.shape[:2], -1.0)
    for k, (x0, y0) in enumerate(xy.astype(int)):
        f = reference[y0 + dy, x0 + dx] - reference[y0 + dy, x0 + dx].mean()
        for h, (u, v, ux, uy, vx, vy) in enumerate(warps[k]):
            x, y = x0 + u + (1 + ux) * dx + uy * dy, y0 + v + vx * dx + (1 + vy) * dy
            if not (min(x.min(), y.min()) >= 0 and max(x.max(), y.max()) < len(current) - 1):  # NaN too
                continue
            j, i = np.floor(x).astype(int), np.floor(y).astype(int)
            s, t = x - j, y - i
            upper = (1 - s) * current[i, j] + s * current[i, j + 1]
            lower = (1 - s) * current[i + 1, j] + s * current[i + 1, j + 1]
            g = (1 - t) * upper + t * lower
            score[k, h] = f @ (g - g.mean()) / np.sqrt((f @ f) * ((g - g.mean()) ** 2).sum())
    return score


def hypotheses_through_the_match(xy, seed=3):
    """Hypotheses from 60 px before the true match to 60 px beyond, 81 warps between 11 knots.

    They pass a little beside the true match of the points xy (n, 2), and the first knot of every third point is NaN.
    """
    rng = np.random.default_rng(seed)
    along = np.linspace(-60.0, 60.0, 11)
    knots = np.zeros((len(xy), 11, 6))
    knots[..., 0] = displacement(*xy.T)[0][:, None] + along + rng.uniform(-0.4, 0.4, (len(xy), 1))
    knots[..., 1] = displacement(*xy.T)[1][:, None] + 0.1 * along + rng.uniform(-0.4, 0.4, (len(xy), 1))
    knots[..., 2:] = np.array([0.02, -0.03, 0.04, 0.01]) + rng.normal(0, 0.02, (len(xy), 1, 4))
    knots[::3, 0] = np.nan
    return WarpHypotheses(knots, np.linspace(0.0, 10.0, 81))


@pytest.mark.parametrize("kind", [np.float64, np.uint8, np.uint16])
def test_the_first_trial_on_fewer_pixels_loses_no_match(kind):
    scale = 1 if kind != np.uint16 else 200
    reference, current = ((scale * image).clip(0, 255 * scale).astype(kind) for image in image_pair())
    xy = points()
    hypotheses = hypotheses_through_the_match(xy)
    plain = zncc_of_every_warp(reference.astype(float), current.astype(float), xy, hypotheses.warps)
    assert (plain == -1.0).mean() > 0.1  # of those that leave the image the test says something too
    best = search_hypotheses(reference, prepare_current(current), xy, hypotheses, RADIUS)
    everyone, index = np.arange(len(xy)), plain.argmax(axis=1)
    assert (best.index == index).all()
    np.testing.assert_array_equal(best.warps, hypotheses.warps[everyone, index])
    np.testing.assert_allclose(best.zncc, plain[everyone, index], atol=1e-5)
    apart = np.hypot(*np.moveaxis(hypotheses.warps[..., :2] - best.warps[:, None, :2], -1, 0)) > 4.0
    second = np.where(apart, plain, -1.0).max(axis=1)
    close = second > best.zncc - 0.2  # what is far below the best may be known roughly
    np.testing.assert_allclose(best.second_peak[close], second[close], atol=1e-5)
    assert (best.second_peak[~close] < best.zncc[~close] - 0.1).all()


def test_a_second_match_as_good_as_the_best_is_the_second_peak():
    strip = speckle_image(width=36)
    image = np.tile(strip, 6)
    xy = np.array([[90.0, 100.0], [92.0, 120.0]])  # 36 px farther it looks the same
    knots = np.zeros((2, 2, 6))
    knots[:, :, 0] = [-20.0, 60.0]
    hypotheses = WarpHypotheses(knots, np.linspace(0.0, 1.0, 81))
    best = search_hypotheses(image, prepare_current(image), xy, hypotheses, RADIUS)
    np.testing.assert_allclose(best.warps[:, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(best.second_peak, 1.0, atol=1e-6)


def test_a_lower_limit_of_the_zncc_changes_no_match_above_it():
    reference, current = image_pair()
    current[:, :110] = speckle_image(seed=9)[:, :110]  # the left half shows something else
    xy = points()
    hypotheses = hypotheses_through_the_match(xy)
    prepared = prepare_current(current)
    plain, pruned = (
        search_hypotheses(reference, prepared, xy, hypotheses, RADIUS, zncc_min=limit) for limit in (-1.0, 0.8)
    )
    of_use = plain.zncc > 0.8
    assert 0.2 < of_use.mean() < 0.8
    np.testing.assert_array_equal(pruned.index[of_use], plain.index[of_use])
    np.testing.assert_array_equal(pruned.zncc[of_use], plain.zncc[of_use])
    np.testing.assert_array_equal(pruned.second_peak[of_use], plain.second_peak[of_use])
    assert (pruned.zncc[~of_use] <= 0.8).all()


def test_interpolated_hypotheses_give_the_result_of_all_their_warps():
    reference, current = image_pair()
    xy = points()
    hypotheses, prepared = hypotheses_through_the_match(xy), prepare_current(current)
    best = search_hypotheses(reference, prepared, xy, hypotheses, RADIUS)
    warps, zncc, second = search_warps(prepare_reference(reference), prepared, xy, hypotheses.warps, RADIUS)
    np.testing.assert_allclose(warps, best.warps, atol=1e-12)
    np.testing.assert_allclose(zncc, best.zncc, atol=1e-6)
    np.testing.assert_allclose(second, best.second_peak, atol=1e-6)


def test_an_even_image_has_no_match():
    reference, xy = speckle_image(), np.array([[110.0, 110.0]])
    for level in (7.3, 250.0, 60000.0):
        even = prepare_current(np.full(reference.shape, level))
        best = search_hypotheses(reference, even, xy, hypotheses_through_the_match(xy), RADIUS)
        assert best.zncc[0] == -1.0
        assert np.isnan(best.warps).all()
