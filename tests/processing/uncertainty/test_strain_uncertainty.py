"""How stretches scatter when the points do."""

import numpy as np
import pytest
from ringdic.strain.deformation import deformation
from ringdic.uncertainty.strain import corner_correlations, stretch_sigma, subset_correlation


def disc(radius: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(float)
    inside = x**2 + y**2 <= radius**2
    return x[inside], y[inside]


def place_weights(radius: int, order: int) -> np.ndarray:
    """Weight of every pixel of a disc in the least-squares value at its centre, on a square image."""
    x, y = disc(radius)
    terms = [np.ones_like(x), x, y] + ([x * x, x * y, y * y] if order == 2 else [])
    weights = np.linalg.pinv(np.column_stack(terms))[0]
    image = np.zeros((4 * radius + 1,) * 2)
    image[(y + 2 * radius).astype(int), (x + 2 * radius).astype(int)] = weights
    return image


@pytest.mark.parametrize("order", [1, 2])
def test_neighbours_are_as_alike_as_least_squares_over_their_pixels_makes_them(order: int) -> None:
    image = place_weights(20, order)
    for d in (0, 5, 10, 20, 30, 41):
        shifted = np.zeros_like(image)
        shifted[:, d:] = image[:, : image.shape[1] - d]
        exact = float(np.sum(image * shifted) / np.sum(image**2))
        stated = float(subset_correlation(np.array(d), 20.0, order))
        if order == 1:
            stated **= 1 / 1.15  # without what uneven slopes add
        assert stated == pytest.approx(exact, abs=0.03)


def test_far_points_have_nothing_in_common() -> None:
    np.testing.assert_allclose(subset_correlation(np.array([41.0, 100.0, 1e6]), 20.0), 0.0, atol=1e-12)
    assert subset_correlation(np.array(0.0), 20.0) == 1.0


def surface() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Four points of a bent sheet before and after a stretch with shear and a turn, and two triangles."""
    reference = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.1, 1.0, 0.2], [0.0, 0.9, 0.1]])
    F = np.array([[1.1, 0.06, 0.0], [0.0, 0.95, 0.0], [0.02, 0.0, 1.0]])
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    return reference, reference @ (turn @ F).T, np.array([[0, 1, 2], [0, 2, 3]])


def stretches(reference: np.ndarray, current: np.ndarray, faces: np.ndarray) -> np.ndarray:
    found = deformation(reference, current, faces)
    return np.column_stack([found.lambda1, found.lambda2])


@pytest.mark.parametrize("alike", [False, True])
def test_the_variance_is_that_of_the_stretches_own_derivatives(alike: bool) -> None:
    reference, current, faces = surface()
    rng, h = np.random.default_rng(0), 1e-6
    gain, sigma = rng.normal(size=(3, 4, 3, 2)), rng.uniform(0.5, 2.0, (3, 4, 2))
    gain[2, 1] = 0.0  # a camera that does not see a point
    sigma[2, 1] = np.nan
    # All at one place: errors of a camera are the same everywhere. Far apart: independent.
    px = np.zeros((3, 4, 2)) if alike else 1e6 * rng.normal(size=(3, 4, 2))
    shared = corner_correlations(px, faces, 20.0)
    found = stretch_sigma(deformation(reference, current, faces), reference, faces, gain, shared, sigma)
    variance = np.zeros((2, 2))
    for c in range(3):
        for axis in range(2):
            each = []
            for k in range(4):
                d = np.zeros_like(current)
                d[k] = gain[c, k, :, axis] * np.nan_to_num(sigma[c, k, axis]) * h
                each.append(
                    (stretches(reference, current + d, faces) - stretches(reference, current - d, faces)) / 2 / h
                )
            variance += np.sum(each, axis=0) ** 2 if alike else np.sum(np.square(each), axis=0)
    np.testing.assert_allclose(found, np.sqrt(variance), rtol=1e-4)


def test_a_common_error_of_all_points_is_no_strain() -> None:
    reference, current, faces = surface()
    gain = np.broadcast_to(np.eye(3)[:, :2], (1, 4, 3, 2)).copy()
    alike = corner_correlations(np.zeros((1, 4, 2)), faces, 20.0)
    found = stretch_sigma(deformation(reference, current, faces), reference, faces, gain, alike, np.ones((1, 4, 2)))
    np.testing.assert_allclose(found, 0.0, atol=1e-6)
