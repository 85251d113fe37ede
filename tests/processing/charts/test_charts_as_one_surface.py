"""Exact charts of a plate at two heights merged, and views that contradict one another."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ringdic.charts.agreement import triangulate_agreeing
from ringdic.charts.chart import Chart
from ringdic.charts.series import SurfaceSeries
from ringdic.charts.surface import ReferenceSurface, reference_surface
from ringdic.correlation import grid
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.topology import Kind, borders, overlap_area
from ringdic.results.series import StepCache
from ringdic.settings import Settings

STEP, APART = 10, 0.1  # px; mm between the two plates


def camera(x: float, name: str) -> Camera:
    """A camera 300 mm above the plate z = 0 that looks straight down, with 10 px a mm there."""
    R = np.diag([1.0, -1.0, -1.0])
    K = np.array([[3000.0, 0.0, 500.0], [0.0, 3000.0, 400.0], [0.0, 0.0, 1.0]])
    P = K @ np.column_stack([R, -R @ [x, 0.0, 300.0]])
    return Camera(name, P / P[2, 3], (1001, 801))


CAMERAS = [camera(x, name) for x, name in ((-30.0, "A"), (0.0, "B"), (30.0, "C"))]


def chart(own: int, other: int, left: int, right: int, height: float) -> Chart:
    """A chart of the plate z = ``height`` between two columns of its own camera; every C_LS tells its point."""
    mask = np.zeros((801, 1001), bool)
    mask[200:601, left : right + 1] = True
    xy, faces = grid(mask, STEP)
    first = CAMERAS[own]
    ray = first.ray(xy)
    xyz = first.centre + ray * ((height - first.centre[2]) / ray[:, 2])[:, None]
    n = len(xy)
    c_ls = np.stack([np.zeros(n), 0.01 + 1e-5 * np.arange(n)])
    return Chart(
        np.array([own, other]), xy, faces, np.stack([xy, CAMERAS[other].project(xyz)]),
        np.full((2, n, 2), 0.01, np.float32), np.zeros((2, n, 2), np.float32), np.zeros((2, n), np.float32),
        c_ls.astype(np.float32), np.zeros((2, n), np.int8), np.ones((2, n, 5), np.float32), np.ones(2),
    )  # fmt: skip


def merged(heuristic: str) -> ReferenceSurface:
    charts = [chart(0, 1, 500, 850, 0.0), chart(2, 1, 150, 500, APART)]
    return reference_surface(CAMERAS, charts, STEP, 0.05, heuristic)


@pytest.mark.parametrize("heuristic", ["combined", "correlation"])
def test_every_vertex_keeps_its_own_values(heuristic: str) -> None:
    whole, surface = merged("none"), merged(heuristic)
    assert len(surface.xyz) < len(whole.xyz)
    np.testing.assert_array_equal(np.unique(surface.faces), np.arange(len(surface.xyz)))
    where = {tuple(xyz): k for k, xyz in enumerate(whole.xyz)}
    old = np.array([where[tuple(xyz)] for xyz in surface.xyz])
    for name in ("own", "c_ls", "chi2", "degrees"):
        np.testing.assert_array_equal(getattr(surface, name), getattr(whole, name)[old])
    for name in ("px", "sigma", "scatter", "texture"):
        np.testing.assert_array_equal(getattr(surface, name), getattr(whole, name)[:, old])
    np.testing.assert_allclose(surface.xyz[:, 2], np.where(surface.own == 0, 0.0, APART), atol=1e-6)


def test_the_merged_plate_is_one_sheet_without_overlap() -> None:
    surface = merged("combined")
    mesh = Mesh(surface.xyz, surface.faces)
    (rim,) = borders(mesh)
    assert rim.kind is Kind.RIM
    assert overlap_area(mesh, reach=1.0) == 0.0
    corners = surface.own[surface.faces]
    assert (corners != corners[:, :1]).any(), "triangles join the two charts"


@pytest.mark.parametrize("heuristic", ["none", "combined"])
def test_the_distance_between_the_charts_is_told_either_way(heuristic: str) -> None:
    ((first, second, points, mean, std, bias, *_),) = merged(heuristic).mismatch
    assert (first, second) == (0, 1)
    assert points > 50
    assert mean == pytest.approx(APART, abs=1e-6)
    assert std == pytest.approx(0.0, abs=1e-6)
    assert bias == pytest.approx(APART, abs=1e-6)


def test_results_tell_which_triangles_join_charts_and_how_far_these_are_apart(tmp_path: Path) -> None:
    surface = merged("combined")
    pairs = [("A", "B"), ("B", "C")]
    series = SurfaceSeries(
        "plates", CAMERAS, pairs, ["A", "C"], ["reference"], surface, lambda *_: None, Settings(), StepCache(tmp_path)
    )
    results, figures = series.reference, series.agreement
    corners = results.vertex_pair[results.faces]
    np.testing.assert_array_equal(results.pair == -1, (corners != corners[:, :1]).any(axis=1))
    assert set(results.pair) == {-1, 0, 1}
    assert figures["mismatch_mm"] == pytest.approx(APART, abs=1e-6)
    assert figures["mismatch_std_mm"] == pytest.approx(0.0, abs=1e-5)
    (row,) = figures["mismatches"]
    assert row["charts"] == ["A", "C"]
    assert row["bias_mm"] == pytest.approx(APART, abs=1e-6)


def test_points_of_a_plane_beside_their_places_on_the_grid_lie_on_the_surface_of_their_neighbours() -> None:
    flat = chart(0, 1, 500, 850, 0.0)
    xy = flat.xy.copy()
    right = xy[:, 0] == 850
    xy[right, 0] -= 4.0
    px = flat.px.copy()
    px[0] = xy
    ray = CAMERAS[0].ray(xy)
    px[1] = CAMERAS[1].project(CAMERAS[0].centre - ray * (CAMERAS[0].centre[2] / ray[:, 2])[:, None])
    surface = reference_surface(CAMERAS, [replace(flat, xy=xy, px=px)], STEP, 0.05)
    assert len(surface.xyz) == len(xy)
    px[1, np.flatnonzero(right)[20]] += [3.0, 0.0]  # 0.8 mm before the plate
    assert len(reference_surface(CAMERAS, [replace(flat, xy=xy, px=px)], STEP, 0.05).xyz) == len(xy) - 1


def test_a_view_that_contradicts_the_others_is_dropped_and_two_that_do_are_no_point() -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform([-15, -20, -5], [15, 20, 5], (300, 3))
    noise = 0.01
    px = np.stack([camera.project(xyz) for camera in CAMERAS]) + noise * rng.standard_normal((3, 300, 2))
    px[2, :20] += [0.0, 3.0]
    px[2, 20:40] = np.nan
    px[1, 20:40] += [0.0, 3.0]
    points, used = triangulate_agreeing(CAMERAS, px, np.full(px.shape, noise))
    assert not used[2, :20].any()
    assert used[:2, :20].all()
    assert np.isnan(points.xyz[20:40]).all()
    assert used[:, 40:].all()
    good = np.r_[0:20, 40:300]
    error = (points.xyz - xyz)[good]
    whitened = np.einsum("ni,nij,nj->n", error, np.linalg.inv(points.covariance[good]), error)
    assert whitened.mean() == pytest.approx(3.0, abs=4 * np.sqrt(6 / len(good)))


def test_charts_without_a_match_are_refused() -> None:
    lost = chart(0, 1, 500, 850, 0.0)
    lost.px[1], lost.status[1] = np.nan, 3
    likeness = rf"share a textured surface: {len(lost.xy)} points were lost, .* the images do not look alike; focus"
    with pytest.raises(ComputationError, match=likeness):
        reference_surface(CAMERAS, [lost], STEP, 0.05)
    with pytest.raises(ComputationError, match="share a textured surface: no camera has places with a depth"):
        reference_surface(CAMERAS, [], STEP, 0.05)
