"""The distance between two measurements of one surface: known offsets, known noise, and no error of its own."""

from collections.abc import Callable

import numpy as np
import pytest
from ringdic.merging import Mismatch, mismatches
from ringdic.mesh.mesh import Mesh


def bowl(shift: float, outwards: float = 0.0, noise: float = 0.0, size: float = 40.0, seed: int = 0) -> Mesh:
    """A doubly curved cap, z = -x²/80 - y²/120, with a grid that is shifted, moved and noisy along its normals."""
    n = int(size / 1.5)
    x, y = (np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij")) * 1.5 - size / 2 + shift).reshape(2, -1)
    normal = np.stack([x / 40, y / 60, np.ones(x.size)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off = outwards + noise * np.random.default_rng(seed).standard_normal(x.size)
    vertices = np.stack([x, y, -(x**2) / 80 - y**2 / 120], axis=1) + off[:, None] * normal
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def only(*sheets: Mesh) -> Mismatch:
    (found,) = mismatches(sheets, reach=2.0)
    return found


def test_the_same_curved_surface_with_another_grid_has_no_mismatch() -> None:
    """Triangles of 1.5 mm on a radius of 40 mm lie up to 14 µm below it; the mismatch must not."""
    found = only(bowl(0.0), bowl(0.6))
    assert found.points > 1000
    assert found.largest < 0.002
    assert abs(found.bias) < 0.0003


def test_an_offset_is_found_with_its_sign() -> None:
    found = only(bowl(0.0), bowl(0.6, outwards=0.05))
    assert (found.first, found.second) == (0, 1)
    assert found.bias == pytest.approx(0.05, abs=0.0005)
    assert found.mean == pytest.approx(0.05, abs=0.0005)
    assert found.std < 0.001
    assert only(bowl(0.6, outwards=0.05), bowl(0.0)).bias == pytest.approx(-0.05, abs=0.0005)


def test_noise_is_found_at_its_size(figures: Callable) -> None:
    """Both surfaces are noisy: one vertex, against three corners averaged by weights with a mean square of 1/2.

    The rms lies between that of one vertex alone and that of the difference of two.
    """
    sigma = 0.02
    found = only(bowl(0.0, noise=sigma, seed=1), bowl(0.6, noise=sigma, seed=2))
    figures("mismatch of two noisy surfaces, rms over sigma", f"{found.rms / sigma:.2f}", "1 … √2")
    assert sigma < found.rms < np.sqrt(2) * sigma
    assert abs(found.bias) < 4 * sigma / np.sqrt(found.points / 9)
    assert found.mean == pytest.approx(np.sqrt(2 / np.pi) * found.rms, rel=0.05)


def test_what_does_not_lie_over_one_another_has_none() -> None:
    far = bowl(0.0)
    assert mismatches([far, Mesh(far.vertices + np.array([100.0, 0, 0]), far.faces)], reach=2.0) == ()
    assert mismatches([far, Mesh(far.vertices + np.array([0, 0, 5.0]), far.faces)], reach=2.0) == ()
    assert mismatches([far, Mesh(far.vertices, far.faces[:, ::-1])], reach=2.0) == ()
