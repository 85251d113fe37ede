"""The scatter of strain over windows, stated against found, for errors that neighbours share as subsets do."""

from collections.abc import Callable

import numpy as np
import pytest
from ringdic.mesh.mesh import Mesh
from ringdic.strain.window import strain_window
from ringdic.uncertainty.strain import subset_correlation
from ringdic.uncertainty.window import window_scatter

RADIUS_PX, PX_A_MM = 20, 10.0
REACH = (2 * RADIUS_PX + 1) / PX_A_MM
SIGMA = np.array([1.0e-3, 0.5e-3, 0.7e-3])  # mm, x y z


def tube(around: int = 60, along: int = 9) -> Mesh:
    angle, z = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(float(along)), indexing="ij")
    radius = around / (2 * np.pi)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1).reshape(-1, 3)
    n = np.arange(around * along).reshape(around, along)
    m = np.roll(n, -1, axis=0)
    a, b, c, d = (part.ravel() for part in (n[:, :-1], m[:, :-1], m[:, 1:], n[:, 1:]))
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def subsets(apart: np.ndarray) -> np.ndarray:
    return subset_correlation(apart * PX_A_MM, RADIUS_PX)


def strangers(apart: np.ndarray) -> np.ndarray:
    return np.zeros_like(apart)


@pytest.mark.parametrize(("alike", "width"), [(subsets, 4.0), (subsets, 8.0), (strangers, 5.0)])
def test_stated_and_found_scatter_agree(alike: Callable[[np.ndarray], np.ndarray], width: float) -> None:
    mesh, draws = tube(), 120
    distance = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices[None], axis=2)
    correlation = np.where(distance > 0, alike(distance), 1.0)
    root = np.linalg.cholesky(correlation + 1e-9 * np.eye(len(correlation)))
    window = strain_window(mesh, width)
    moved = mesh.vertices * [1.0, 1.0, 1.1]  # stretches that differ, so that noise does not sort them
    rng = np.random.default_rng(1)
    found = []
    for _ in range(draws):
        noise = root @ rng.normal(size=mesh.vertices.shape) * SIGMA
        seen = window.deformation(moved + noise)
        found.append([seen.lambda1, seen.lambda2])
    stated = window_scatter(window, alike, REACH).stretch_sigma(
        window.deformation(moved), np.tile(SIGMA, (len(mesh.vertices), 1))
    )
    ratio = np.std(found, axis=0, ddof=1).T / stated
    # One window's spread is known to 1 / √(2 · 119) = 6.5 %; the median over 960 windows far better.
    np.testing.assert_allclose(np.median(ratio, axis=0), 1.0, atol=0.04)
    assert np.percentile(ratio, 2.5) > 0.8
    assert np.percentile(ratio, 97.5) < 1.2


def test_errors_that_all_points_share_move_them_and_strain_nothing() -> None:
    window = strain_window(tube(), 3.0)
    found = window.deformation(window.mesh.vertices * [1.0, 1.0, 1.1])
    sigma = np.tile(SIGMA, (len(window.mesh.vertices), 1))
    alone = window_scatter(window, strangers, REACH).stretch_sigma(found, sigma)
    shared = window_scatter(window, np.ones_like, 10.0).stretch_sigma(found, sigma)
    assert np.nanmin(alone) > 1e-5
    assert np.nanmax(shared) < 1e-9


def test_lost_triangles_and_unknown_deviations_are_not_sure_of_anything() -> None:
    mesh = tube()
    window = strain_window(mesh, 5.0)
    moved, sigma = mesh.vertices * [1.0, 1.0, 1.1], np.tile(SIGMA, (len(mesh.vertices), 1))
    moved[100] = np.nan
    sigma[300] = np.nan
    stated = window_scatter(window, subsets, REACH).stretch_sigma(window.deformation(moved), sigma)
    np.testing.assert_array_equal(np.isnan(stated).any(axis=1), np.isin(mesh.faces, [100, 300]).any(axis=1))
