"""A cylinder that turns by 40 degrees: its motion, warps and matches, all of which are known exactly.

Images whose pattern is a formula on the cylinder; no interpolation anywhere.
"""

from functools import cache

import numpy as np
import pytest
from ringdic.charts.body_motion import PredictedPoints, SeenBody, SubsetPlanes, SurfaceFrames
from ringdic.charts.step_matching import match_tracked_points
from ringdic.charts.tracked_points import TrackedPoints, tracked_points
from ringdic.correlation import CorrelationSettings, Reference, prepare_current, prepare_reference
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint
from ringdic.strain.rigid_motion import RigidMotion

RADIUS = 57.0  # mm, of the cylinder about z
TURN = np.radians(40.0)
SIZE = (320, 200)
SETTINGS = CorrelationSettings(radius=10, step=5)
MOTION = RigidMotion(
    np.array([[np.cos(TURN), -np.sin(TURN), 0.0], [np.sin(TURN), np.cos(TURN), 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)
)
NOISE = 1.0  # grey levels


def camera_at(azimuth_deg: float) -> Camera:
    """A camera 800 mm from the axis, 2.5 px a mm on it."""
    a = np.radians(azimuth_deg)
    R = np.array([[-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, -1.0], [-np.cos(a), -np.sin(a), 0.0]])
    centre = 800.0 * np.array([np.cos(a), np.sin(a), 0.0])
    K = np.array([[2000.0, 0.0, SIZE[0] / 2], [0.0, 2000.0, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    P = K @ np.column_stack([R, -R @ centre])
    return Camera(f"at {azimuth_deg}", P / P[2, 3], SIZE)


CAMERAS = [camera_at(azimuth) for azimuth in (-60.0, 0.0, 60.0)]
CAMERA = CAMERAS[1]


def on_cylinder(px: np.ndarray) -> np.ndarray:
    """Where the camera's lines of sight meet the cylinder, (n, 3) mm; NaN where they miss it."""
    ray, start = CAMERA.ray(px), CAMERA.centre
    a, b = np.sum(ray[..., :2] ** 2, axis=-1), ray[..., :2] @ start[:2]
    with np.errstate(invalid="ignore"):
        way = (-b - np.sqrt(b * b - a * (start[:2] @ start[:2] - RADIUS**2))) / a
    return start + way[..., None] * ray


def moved_px(px: np.ndarray) -> np.ndarray:
    return CAMERA.project(MOTION.apply(on_cylinder(px)))


def pattern(xyz: np.ndarray) -> np.ndarray:
    """Grey levels on the surface: waves of 3 to 7 mm, about 128; a plain grey beside the cylinder."""
    rng = np.random.default_rng(4)
    along, z = RADIUS * np.arctan2(xyz[..., 1], xyz[..., 0]), xyz[..., 2]
    total = np.zeros(z.shape)
    for _ in range(80):
        k, towards, phase = 2 * np.pi / rng.uniform(3, 7), rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
        total += np.cos(k * (np.cos(towards) * along + np.sin(towards) * z) + phase)
    return np.nan_to_num(128.0 + 6.0 * total, nan=128.0)


def cosines(xyz: np.ndarray) -> np.ndarray:
    normals = xyz * [1.0, 1.0, 0.0] / RADIUS
    return np.stack([camera.incidence_cosine(xyz, normals) for camera in CAMERAS])


@cache
def body() -> SeenBody:
    """What the camera sees of points 2 mm apart, below 65 degrees."""
    theta, z = np.meshgrid(np.arange(-1.6, 1.6, 2.0 / RADIUS), np.arange(-38.0, 38.0, 2.0))
    xyz = np.stack([RADIUS * np.cos(theta.ravel()), RADIUS * np.sin(theta.ravel()), z.ravel()], axis=1)
    cosine = cosines(xyz)
    seen = cosine > np.cos(np.radians(65.0))
    frames = SurfaceFrames.of(CAMERAS, xyz, seen, np.argmax(cosine, axis=0), SETTINGS.radius)
    index = np.flatnonzero(seen[1])
    return SeenBody(CAMERA, index, xyz[index], CAMERA.project(xyz[index]), lambda: frames)


def grid() -> np.ndarray:
    """Multiples of 5 px on the cylinder that the camera sees below 63 degrees, (n, 2)."""
    xy = np.stack(np.meshgrid(np.arange(0.0, SIZE[0], 5.0), np.arange(20.0, SIZE[1] - 15.0, 5.0)), -1).reshape(-1, 2)
    xyz = on_cylinder(xy)
    return xy[np.isfinite(xyz[:, 0]) & (cosines(xyz)[1] > np.cos(np.radians(63.0))) & (np.abs(xyz[:, 2]) < 36.0)]


@cache
def prepared() -> tuple[Reference, TrackedPoints, np.ndarray]:
    """The reference, its points, and the image after the turn."""
    pixels = np.stack(np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1]))), axis=-1)
    xyz, noise = on_cylinder(pixels), np.random.default_rng(1).normal(0.0, NOISE, (2, *pixels.shape[:2]))
    reference = pattern(xyz) + noise[0]
    current = pattern(xyz @ MOTION.R) + noise[1]  # R' x: where the point seen now has been
    with np.errstate(invalid="ignore"):
        region = (cosines(xyz)[1] > np.cos(np.radians(64.0))) & (np.abs(xyz[..., 2]) < 37.0)
    one = prepare_reference(reference, region, SETTINGS)
    return one, tracked_points(one, grid(), SETTINGS, body()), current


def test_lines_of_sight_meet_the_curved_surface_and_not_its_tangent_planes() -> None:
    px = grid()
    stencil = body().points(px, 7.0)
    inner = np.isfinite(stencil).all(axis=(1, 2))
    assert inner.mean() > 0.9
    off = np.linalg.norm(stencil[inner][..., :2], axis=-1) - RADIUS
    assert np.abs(off).max() < 0.02  # mm; tangent planes leave the surface by up to 3 mm there


def test_the_motion_is_found_from_some_matches_of_which_a_quarter_are_wrong() -> None:
    px = body().px[::5]
    warp = np.zeros((len(px), 6))
    warp[:, :2] = moved_px(px) - px
    wrong = np.random.default_rng(0).random(len(px)) < 0.25
    warp[wrong, :2] += np.random.default_rng(2).uniform(-30.0, 30.0, (wrong.sum(), 2))
    warp[::7] = np.nan
    motion = body().motion(body().nearest(px), px, warp)
    assert motion is not None
    np.testing.assert_allclose(motion.R, MOTION.R, atol=1e-6)
    np.testing.assert_allclose(motion.t, MOTION.t, atol=1e-4)
    assert body().motion(body().nearest(px), px, np.full((len(px), 6), np.nan)) is None


def test_predicted_warps_are_those_of_the_turned_cylinder() -> None:
    px = grid()
    px = px[np.abs(px[:, 0] - SIZE[0] / 2) < 90]
    warps, cosine, _ = PredictedPoints(body(), px, px, np.ones_like(px), SETTINGS.radius, 5.0).after(MOTION)
    np.testing.assert_allclose(warps[:, :2], moved_px(px) - px, atol=0.01)  # fourth derivatives of the depth
    h = 0.5
    slope = (moved_px(px + np.array([h, 0.0])) - moved_px(px - np.array([h, 0.0]))) / (2 * h) - (1.0, 0.0)
    np.testing.assert_allclose(warps[:, [2, 4]], slope, atol=0.01)
    normals = on_cylinder(px) * [1.0, 1.0, 0.0] / RADIUS
    expected = CAMERA.incidence_cosine(MOTION.apply(on_cylinder(px)), normals @ MOTION.R.T)
    np.testing.assert_allclose(cosine, expected, atol=0.01)


@pytest.mark.parametrize("cut", [0.0, -2.0, -6.0])
def test_the_plane_of_a_subset_that_is_cut_off_is_that_of_its_pixels(cut: float) -> None:
    """A cubic field over the part x ≥ cut of a disc of 10 px, whose texture is denser to the right."""
    cubic, spacing = 1e-3, 2.0
    x, y = (each.ravel() for each in np.meshgrid(np.arange(cut, 40.0, spacing), np.arange(-20.0, 21.0, spacing)))
    centres = np.array([[0.0, 0.0], [20.0, 0.0]])
    slopes, bends = 3 * cubic * centres[:, 0] ** 2, 6 * cubic * centres[:, 0]
    warp = np.zeros((2, 12))
    warp[:, 0], warp[:, 2], warp[:, 6] = cubic * centres[:, 0] ** 3, slopes, bends
    shift = np.stack([cubic * x**3, np.zeros_like(x)], axis=1)
    dense = 1.0 + 0.05 * (x - cut)
    energy = np.stack([dense, np.ones_like(x)], axis=1)
    plane = SubsetPlanes(centres, np.array([0]), np.stack([x, y], axis=1), energy, 10.0, spacing).planes(warp, shift)
    fine = np.stack(np.meshgrid(np.arange(cut - 0.9, 10.1, 0.2), np.arange(-10.0, 10.1, 0.2)), axis=-1).reshape(-1, 2)
    fine = fine[np.hypot(*fine.T) <= 10.0]
    root = np.sqrt(1.0 + 0.05 * (fine[:, 0] - cut))
    exact = np.linalg.lstsq(np.insert(fine, 0, 1.0, axis=1) * root[:, None], cubic * fine[:, 0] ** 3 * root)[0]
    np.testing.assert_allclose(plane[0, :, 0], exact, rtol=0.1, atol=0.01)
    np.testing.assert_array_equal(plane[1], 0.0)
    np.testing.assert_allclose(plane[..., 1], 0.0, atol=1e-12)


def test_a_turn_of_forty_degrees_is_matched_to_the_noise_where_the_surface_is_known() -> None:
    reference, points, image = prepared()
    current = prepare_current(image, settings=SETTINGS)
    matches = match_tracked_points(reference, current, points, SETTINGS)
    xyz = MOTION.apply(on_cylinder(points.positions))
    cosine = CAMERA.incidence_cosine(xyz, xyz * [1.0, 1.0, 0.0] / RADIUS)
    truth = moved_px(points.positions) - points.positions
    seen = cosine > np.cos(np.radians(60.0))
    assert matches.good[seen].mean() > 0.98  # 0.94 where the neighbours alone tell of the turn
    assert (matches.status[cosine < np.cos(np.radians(76.0))] == LostPoint.OBLIQUE).all()
    good = seen & matches.good
    error = matches.warp[good, :2] - truth[good]
    assert np.sqrt(np.mean((error / matches.sigma[good]) ** 2)) < 1.4
    assert np.abs(error.mean(axis=0)).max() < 0.002
