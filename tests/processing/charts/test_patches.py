"""Patches of surface seen from one camera: exact for planes, their warps against exact projections."""

import numpy as np
import pytest
from ringdic.charts.patches import Patches, axial_rays, depths, optical_axis, patches_from_warps, warps_between
from ringdic.geometry.camera import Camera, Intrinsics

CENTRE = np.array([0.0, 0.0, 120.0])


def camera(azimuth: float, height: float = 120.0) -> Camera:
    """A camera with lens distortion on a ring of 350 mm that looks at the ring's middle."""
    a = np.radians(azimuth)
    place = np.array([350 * np.cos(a), 350 * np.sin(a), height])
    forward = (CENTRE - place) / np.linalg.norm(CENTRE - place)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    K = np.array([[800.0, -0.4, 370.0], [0.0, 801.0, 490.0], [0.0, 0.0, 1.0]])
    plain = K.copy()
    plain[0, 1] = 0.0
    P = plain @ np.column_stack([R, -R @ place])
    return Camera(
        f"{azimuth:.0f}", P / P[2, 3], (740, 984), Intrinsics(K, np.array([0.17, -0.28, 0, 0, 0]), (740, 984))
    )


FIRST, SECOND = camera(0.0), camera(30.0, 90.0)


def plane(point: np.ndarray, normal: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Points of a plane on the lines of sight of pixels of the first camera."""
    rays = FIRST.ray(px)
    t = ((point - FIRST.centre) @ normal) / (rays @ normal)
    return FIRST.centre + t[..., None] * rays


def test_depth_is_measured_along_the_optical_axis() -> None:
    assert depths(FIRST, FIRST.centre + 100.0 * optical_axis(FIRST)) == pytest.approx(100.0)
    rays = axial_rays(FIRST, np.array([[30.0, 40.0], [700.0, 900.0]]))
    assert rays @ optical_axis(FIRST) == pytest.approx(1.0)


@pytest.mark.parametrize("turn", [-40.0, 0.0, 25.0])
def test_a_match_tells_the_slant_of_a_plane(turn: float) -> None:
    """Exact affine warps of a plane give back its normal; the lens bends the plane by less than 1e-3 over a subset."""
    a = np.radians(turn)
    normal = np.array([np.cos(a), np.sin(a), 0.2])
    normal /= np.linalg.norm(normal)
    px = np.array([[300.0, 450.0], [420.0, 600.0], [365.0, 480.0]])
    e = 0.5
    right, left, down, up = (
        SECOND.project(plane(CENTRE, normal, px + step)) for step in ([e, 0], [-e, 0], [0, e], [0, -e])
    )
    gradient = np.stack([(right - left) / (2 * e), (down - up) / (2 * e)], axis=-1) - np.eye(2)
    patches, travel = patches_from_warps(FIRST, SECOND, px, plane(CENTRE, normal, px), gradient)
    assert np.abs(patches.normals(FIRST) @ normal - 1.0).max() < 1e-6
    moved = SECOND.project(FIRST.centre + axial_rays(FIRST, px) / (patches.inverse_depth + 1e-7)[:, None])
    expected = np.linalg.norm(moved - SECOND.project(plane(CENTRE, normal, px)), axis=1) / 1e-7
    assert travel == pytest.approx(expected, rel=1e-3)


def test_warps_of_a_curved_patch_are_those_of_the_cylinder_that_it_was_taken_from() -> None:
    """The quadratic of a cylinder's inverse depth warps a subset of 10 px radius to within 0.01 px."""
    px = np.array([[365.0, 480.0], [330.0, 520.0], [430.0, 430.0]])

    def on_cylinder(at: np.ndarray) -> np.ndarray:
        d, o = FIRST.ray(at), FIRST.centre
        a, b = d[..., 0] ** 2 + d[..., 1] ** 2, o[0] * d[..., 0] + o[1] * d[..., 1]
        t = (-b - np.sqrt(b * b - a * (o[0] ** 2 + o[1] ** 2 - 57.0**2))) / a
        return o + t[..., None] * d

    def inverse(at: np.ndarray) -> np.ndarray:
        return 1.0 / depths(FIRST, on_cylinder(at))

    h = 4.0
    x, y = np.array([h, 0.0]), np.array([0.0, h])
    slope = np.stack([inverse(px + x) - inverse(px - x), inverse(px + y) - inverse(px - y)], axis=1) / (2 * h)
    second = [
        inverse(px + x) - 2 * inverse(px) + inverse(px - x),
        0.25 * (inverse(px + x + y) - inverse(px + x - y) - inverse(px - x + y) + inverse(px - x - y)),
        inverse(px + y) - 2 * inverse(px) + inverse(px - y),
    ]
    patches = Patches(px, inverse(px), slope, np.stack(second, axis=1) / h**2)
    warp = warps_between(SECOND, px, patches.stencil(FIRST, 6.0), 6.0)
    for offset in np.array([[0.0, 0.0], [8.0, -5.0], [-7.0, 7.0], [0.0, 10.0]]):
        dx, dy = offset
        along = np.array([1, 0, dx, dy, 0, 0, dx * dx / 2, dx * dy, dy * dy / 2, 0, 0, 0])
        across = np.array([0, 1, 0, 0, dx, dy, 0, 0, 0, dx * dx / 2, dx * dy, dy * dy / 2])
        predicted = px + offset + np.stack([warp @ along, warp @ across], axis=1)
        assert np.abs(predicted - SECOND.project(on_cylinder(px + offset))).max() < 0.01
