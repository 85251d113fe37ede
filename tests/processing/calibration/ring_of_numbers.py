"""A ring of twelve full-scale cameras made of numbers, without images, with boards and a target to calibrate it.

Centroids come from the outline of each dot, by Green's theorem: nothing of the models under test.
"""

import cv2
import numpy as np
from ringdic.calibration import dlt
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.intrinsics import IntrinsicsFit, calibrate_intrinsics
from ringdic.calibration.patch import PrintedSheet, sheet_points
from ringdic.calibration.target import DotObservations, dot_points
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.session.rig import Target

TARGET = Target("dot-cylinder", 57.0, 20, 12.0, 10.0, 30, 12.0, 4.0)
SIZE = (2464, 3280)
BOARD = np.stack(np.meshgrid(np.arange(14) * 10.0, np.arange(19) * 10.0), axis=-1).reshape(-1, 2)
NAMES = [f"c{number:02d}" for number in range(1, 13)]


def turned(omega: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(np.asarray(omega, dtype=float))[0]


def camera_on_the_ring(name: str, azimuth_deg: float, rng: np.random.Generator) -> Camera:
    """A camera of the paper's kind, 350 mm from the axis, set up by hand."""
    azimuth = np.deg2rad(azimuth_deg)
    centre = np.array([350 * np.cos(azimuth), 350 * np.sin(azimuth), 124]) + rng.normal(0, 3, 3)
    z = np.array([0, 0, 124.0]) - centre
    x = np.cross(z, [0, 0, 1])
    axes = np.array([x / np.linalg.norm(x), np.cross(z, x) / np.linalg.norm(np.cross(z, x)), z / np.linalg.norm(z)])
    R = turned(rng.normal(0, np.deg2rad(1.5), 3)) @ axes
    K = np.array([[2611.7, -1.37, 1246.5], [0, 2615.4, 1627.7], [0, 0, 1]])
    K[:2] += [[rng.normal(0, 6), 0, rng.normal(0, 30)], [0, rng.normal(0, 6), rng.normal(0, 15)]]
    lens = Intrinsics(K, np.array([rng.normal(0.18, 0.01), -0.295, 1.5e-4, 6.8e-4, -0.05]), SIZE)
    P = lens.K_undistorted @ np.column_stack([R, -R @ centre])
    return Camera(name, P / P[2, 3], SIZE, lens)


def lens_from_boards(
    lens: Intrinsics,
    noise: float,
    rng: np.random.Generator,
    heights: np.ndarray | float = 0.0,
    stretch: float = 0.0,
) -> IntrinsicsFit:
    """A lens fitted to ten views of a board.

    noise : of the corners, px. heights : of the corners, mm. stretch : of the squares along the board, as a part.
    """
    flat = (BOARD - BOARD.mean(axis=0)) * [1, 1 + stretch]
    board = np.column_stack([flat, heights * np.ones(len(BOARD))])
    views = []
    for _ in range(10):
        R = turned(rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.3])
        points = board @ R.T + rng.uniform(-1, 1, 3) * [20, 30, 40] + [0, 0, 320]
        px = lens.distort_normalised(points[:, :2] / points[:, 2:]) @ lens.K[:2, :2].T + lens.K[:2, 2]
        views.append(px + noise * rng.normal(size=px.shape))
    return calibrate_intrinsics(views, BOARD, SIZE, radial=3, drop_percentile=100)


def outline_centroids(
    camera: Camera, sz: np.ndarray, radius: float, shape: str, size: float, points: int = 400
) -> np.ndarray:
    """Centroids of the images of dots round (s, z) (n, 2) on a cylinder, from the points of each outline."""
    side = np.linspace(-0.5, 0.5, points // 4, endpoint=False)
    half = np.full(points // 4, 0.5)
    parts = [(side, -half), (half, side), (-side, half), (-half, -side)]
    outline = size * np.concatenate([np.column_stack(part) for part in parts])
    if shape == "circle":
        angle = np.arange(points) * 2 * np.pi / points
        outline = 0.5 * size * np.column_stack([np.cos(angle), np.sin(angle)])
    around = sz[:, None] + outline
    angle = around[..., 0] / radius
    px = camera.project(np.stack([radius * np.cos(angle), radius * np.sin(angle), around[..., 1]], axis=-1))
    origin = px.mean(axis=1)
    p = px - origin[:, None]
    q = np.roll(p, -1, axis=1)
    area = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return origin + np.sum((p + q) * area[..., None], axis=1) / (3 * area.sum(axis=1)[:, None])


def observed(
    camera: Camera,
    lens: Intrinsics | None,
    fit: IntrinsicsFit | None,
    noise: float,
    rng: np.random.Generator,
    *,
    target: Target = TARGET,
    sheet: PrintedSheet | None = None,
    print_errors: np.ndarray | None = None,
    points: int = 400,
) -> CameraCalibration:
    """DLT calibration of a camera that sees the true target: the start of the adjustment."""
    sheet = sheet or PrintedSheet.nominal(target)
    rows, columns = (axis.ravel() for axis in np.mgrid[1 : target.rows + 1, 1 : target.columns + 1])
    xyz = dot_points(target, rows, columns)
    seen = camera.incidence_cosine(xyz, xyz * [1 / 57, 1 / 57, 0]) > np.cos(np.deg2rad(55))
    rows, columns, xyz = rows[seen], columns[seen], xyz[seen]
    sz = sheet_points(target, sheet, rows, columns)
    if print_errors is not None:
        sz = sz + print_errors[rows - 1, columns - 1]
    px = outline_centroids(camera, sz, sheet.radius, target.dot_shape, target.dot_size_mm, points)
    px = px + noise * rng.normal(size=px.shape)
    flat = px if lens is None else lens.to_undistorted(px)
    L = dlt.solve_dlt(xyz, flat)
    dots = DotObservations(camera.id, rows, columns, px, xyz, 0.0, float("inf"))
    estimate = Camera(camera.id, dlt.to_projection(L), SIZE, lens)
    return CameraCalibration(estimate, dots, dlt.residuals(L, xyz, flat), 0, fit, np.zeros_like(px))


def lens_values(lens: Intrinsics) -> np.ndarray:
    return np.array([lens.K[0, 0], lens.K[1, 1], lens.K[0, 1], lens.K[0, 2], lens.K[1, 2], *lens.distortion])


def pose(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    M = np.linalg.solve(camera.intrinsics.K_undistorted, camera.P)
    M = M / np.cbrt(np.linalg.det(M[:, :3]))
    return M[:, :3], M[:, 3]
