"""Warp hypotheses from proxy cylinders, and the region that two cameras share."""

import numpy as np
import pytest
from ringdic.geometry.camera import Camera
from ringdic.sweep.proxies import cylinder_intersections, stereo_hypotheses, sweep_radii
from ringdic.sweep.region import (
    ImageLattice,
    coherent_depths,
    contrast,
    image_lattice,
    lattice_normals,
    lattice_region,
    within_incidence,
)


def camera_towards_axis(azimuth_deg: float) -> Camera:
    """Camera at 350 mm from the z axis, looking at it."""
    a = np.radians(azimuth_deg)
    centre = np.array([350 * np.cos(a), 350 * np.sin(a), 120.0])
    z = -np.array([np.cos(a), np.sin(a), 0.0])
    y = np.array([0.0, 0.0, -1.0])
    R = np.stack([np.cross(y, z), y, z])
    K = np.array([[1300.0, 0, 615.5], [0, 1300, 819.5], [0, 0, 1]])
    P = K @ np.column_stack([R, -R @ centre])
    return Camera(f"c{azimuth_deg:g}", P / P[2, 3], (1232, 1640))


FIRST, SECOND = camera_towards_axis(0), camera_towards_axis(30)


def surface(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) mm of a cylinder and their positions (n, 2) px in the first camera."""
    theta, z = np.meshgrid(np.radians(np.linspace(-20, 45, 9)), np.linspace(40, 200, 5))
    xyz = np.stack([radius * np.cos(theta), radius * np.sin(theta), z], axis=-1).reshape(-1, 3)
    return xyz, FIRST.project(xyz)


def test_the_nearer_intersection_is_found() -> None:
    xyz, px = surface(57.0)
    np.testing.assert_allclose(cylinder_intersections(FIRST, px, np.array([57.0]))[:, 0], xyz, atol=1e-9)


def test_the_hypothesis_of_the_true_radius_is_the_true_match() -> None:
    xyz, px = surface(55.0)
    hypotheses = stereo_hypotheses(FIRST, SECOND, px, np.array([50.0, 55.0]), 10.0)
    np.testing.assert_allclose(px + hypotheses.warps[:, 1, :2], SECOND.project(xyz), atol=1e-8)


def test_the_gradients_predict_the_match_nearby() -> None:
    _, px = surface(57.0)
    radii = np.array([57.0])
    here = stereo_hypotheses(FIRST, SECOND, px, radii, 1.0).warps[:, 0]
    there = stereo_hypotheses(FIRST, SECOND, px + np.array([3.0, -2.0]), radii, 1.0).warps[:, 0]
    moved = here[:, :2] + here[:, 2:].reshape(-1, 2, 2) @ np.array([3.0, -2.0])
    np.testing.assert_allclose(there[:, :2], moved, atol=0.06)  # what the curvature leaves over 3.6 px
    assert np.abs(here[:, 2]).max() > 0.2  # strong gradients, so the test says something


def test_a_line_of_sight_beside_the_proxy_has_no_hypothesis() -> None:
    assert np.isnan(stereo_hypotheses(FIRST, SECOND, np.array([[5.0, 800.0]]), np.array([57.0]), 5.0).warps).all()


def test_the_sweep_is_centred_and_positive() -> None:
    radii = sweep_radii(57.0, 20.0, 0.25)
    assert radii[len(radii) // 2] == pytest.approx(57.0)
    assert np.diff(radii).max() <= 0.2501
    assert sweep_radii(10.0, 20.0, 1.0).min() > 0


def test_a_lattice_keeps_its_margin_and_its_multiples() -> None:
    points = image_lattice((100, 80), 12, 15)
    assert points.xy[..., 0].min() >= 15
    assert points.xy[..., 0].max() < 85
    assert points.xy[..., 1].max() < 65
    assert np.all(points.xy % 12 == 0)


def test_an_isolated_depth_is_not_coherent_and_smaller_pieces_are_dropped() -> None:
    radius = np.full((12, 12), 57.0)
    radius[4, 4] = 49.0
    candidates = np.ones((12, 12), bool)
    candidates[:, 8:10] = False  # columns 10 and 11 are cut off
    good = coherent_depths(radius, candidates, 2.0)
    assert not good[4, 4]
    assert good[:, :8].sum() == 12 * 8 - 1
    assert not good[:, 10:].any()
    both = coherent_depths(radius, candidates, 2.0, min_positions=20)
    assert both[:, 10:].all()
    assert not both[4, 4]
    assert (coherent_depths(radius, candidates, 2.0, min_positions=30) == good).all()


def test_normals_of_a_cylinder_point_along_its_radii() -> None:
    theta, z = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(0, 50, 6))
    xyz = np.stack([57 * np.cos(theta), 57 * np.sin(theta), z], axis=-1)
    normals = lattice_normals(xyz)
    np.testing.assert_allclose(normals[:, 1:-1, 0], np.cos(theta)[:, 1:-1], atol=1e-9)
    np.testing.assert_allclose(normals[..., 2], 0, atol=1e-9)


def test_positions_above_the_limit_of_incidence_are_left_out() -> None:
    theta, z = np.meshgrid(np.radians(np.arange(-80.0, 110, 5)), np.linspace(100, 140, 5))
    xyz = np.stack([57 * np.cos(theta), 57 * np.sin(theta), z], axis=-1)
    visible = within_incidence(xyz, (FIRST, SECOND), 60.0)[2]
    angles = np.degrees(theta[2])
    # A camera at 350 mm sees the cylinder's point at angle a under a + asin(57 sin a / distance).
    assert not visible[np.abs(angles + 35) < 1].any()
    assert visible[np.abs(angles - 15) < 1].all()
    assert not visible[angles > 65].any()


def test_the_region_covers_the_good_positions_only() -> None:
    points = image_lattice((200, 200), 20, 20)
    good = (points.xy[..., 0] >= 60) & (points.xy[..., 0] <= 120) & (points.xy[..., 1] >= 60)
    mask = lattice_region(ImageLattice(points.xy, 20), good, (200, 200))
    assert mask[100, 60:121].all()
    assert not mask[:, :48].any()
    assert not mask[:48].any()


def test_contrast_is_the_rms_gradient() -> None:
    x = np.arange(200.0)
    image = np.tile(100 + 50 * np.sin(2 * np.pi * x / 20), (100, 1)).astype(np.float32)
    # The derivative of a sine, sampled by a central difference: amplitude 50 sin(2 pi / 20), root mean square / √2.
    expected = 50 * np.sin(2 * np.pi / 20) / np.sqrt(2)
    assert contrast(image, np.array([[100.0, 50.0]]), 20)[0] == pytest.approx(expected, rel=0.02)
    assert contrast(np.full((50, 50), 7, np.uint8), np.array([[25.0, 25.0]]), 5)[0] == 0.0


def test_interpolated_warps_of_many_radii_agree_with_exact_ones() -> None:
    _, px = surface(57.0)
    radii = sweep_radii(57.0, 20.0, 0.28)
    together = stereo_hypotheses(FIRST, SECOND, px, radii, 20.0)
    single = [stereo_hypotheses(FIRST, SECOND, px, radii[k : k + 1], 20.0) for k in range(len(radii))]
    warps = np.concatenate([each.warps for each in single], axis=1)
    both = np.isfinite(warps).all(axis=2) & np.isfinite(together.warps).all(axis=2)
    assert both.mean() > 0.95 * np.isfinite(warps).all(axis=2).mean()
    off = np.abs(together.warps - warps)[both]
    assert off[:, :2].max() < 0.2  # px; the peak of the correlation is some px wide
    assert np.quantile(off[:, 2:], 0.99) < 0.01
    assert off[:, 2:].max() < 0.1  # where the surface turns away


def test_bounds_on_the_radii_leave_the_warps_inside_unchanged() -> None:
    _, px = surface(57.0)
    radii = sweep_radii(57.0, 20.0, 0.28)
    low, high = np.linspace(45.0, 55.0, len(px)), np.linspace(50.0, 70.0, len(px))
    some = stereo_hypotheses(FIRST, SECOND, px, radii, 20.0, (low, high)).warps
    every = stereo_hypotheses(FIRST, SECOND, px, radii, 20.0).warps
    of_use = (low[:, None] <= radii) & (radii <= high[:, None])
    np.testing.assert_array_equal(some[of_use], every[of_use])
    assert np.isfinite(some[of_use]).any()
    far = (radii < low[:, None] - 4.0) | (radii > high[:, None] + 4.0)
    assert np.isnan(some[far]).all()
