"""The DLT: exact on exact points, equal to MultiDIC's stored parameters, not affected by planted gross errors."""

import numpy as np
import pytest
from ringdic.calibration import dlt
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera, Intrinsics


def cylinder(columns: int = 8) -> np.ndarray:
    angle, z = np.meshgrid(np.arange(columns) * 12 / 57, 10 + 12 * np.arange(20.0))
    return np.column_stack([57 * np.cos(angle.ravel()), 57 * np.sin(angle.ravel()), z.ravel()])


@pytest.fixture
def truth() -> np.ndarray:
    return np.array([-8.6, 0.64, 0.08, 1220.0, -2.5, -4.3, -7.7, 2511.0, -1.5e-3, -2.6e-3, 6.6e-5])


def test_exact_points_give_the_camera_back(truth):
    xyz = cylinder()
    px = Camera("a", dlt.to_projection(truth), (1, 1)).project(xyz)
    assert np.allclose(dlt.solve_dlt(xyz, px), truth, rtol=1e-9)
    assert np.abs(dlt.residuals(truth, xyz, px)).max() < 1e-10


@pytest.mark.parametrize("camera", ["201", "202"])
@pytest.mark.parametrize("kind", ["raw", "undistorted"])
def test_parameters_equal_those_of_multidic(shared_data, camera, kind):
    reference = np.load(shared_data / "multidic_rig" / "reference.npz")
    centroids = "calib_centroids" + ("_undistorted" if kind == "undistorted" else "")
    L = dlt.solve_dlt(reference[f"calib_points_xyz_{camera}"], reference[f"{centroids}_{camera}"])
    wanted = reference[f"dlt_{kind}_{camera}"]
    assert np.linalg.norm(L - wanted) <= 1e-10 * np.linalg.norm(wanted)
    # Each one on its own, small denominators included: 1e-9 of its effect at the target's size.
    effect = np.array([100, 100, 100, 1] * 2 + [1e5] * 3)
    assert np.abs((L - wanted) * effect).max() < 1e-6


@pytest.mark.parametrize("camera", ["201", "202"])
def test_undistorted_centroids_equal_those_of_multidic(shared_data, camera):
    reference = np.load(shared_data / "multidic_rig" / "reference.npz")
    lens = Intrinsics(reference[f"K_{camera}"], reference[f"dist_{camera}"], (2464, 3280))
    undistorted = lens.to_undistorted(reference[f"calib_centroids_{camera}"])
    assert np.abs(undistorted - reference[f"calib_centroids_undistorted_{camera}"]).max() < 1e-6


def test_gross_errors_are_left_out_and_nothing_else(truth):
    rng = np.random.default_rng(7)
    xyz = cylinder()
    px = Camera("a", dlt.to_projection(truth), (1, 1)).project(xyz) + rng.normal(0, 0.05, (len(xyz), 2))
    bad = rng.choice(len(xyz), 10, replace=False)
    px[bad] += rng.choice([-1, 1], (10, 2)) * rng.uniform(3, 40, (10, 2))
    L, inliers = dlt.solve_dlt_robust(xyz, px)
    assert sorted(np.flatnonzero(~inliers)) == sorted(bad)
    assert np.array_equal(L, dlt.solve_dlt(xyz[inliers], px[inliers]))


def test_a_plane_or_a_handful_of_points_is_not_a_camera(truth):
    xyz = cylinder()
    px = Camera("a", dlt.to_projection(truth), (1, 1)).project(xyz)
    plane = np.abs(xyz[:, 0] - 57) < 1e-9
    with pytest.raises(ComputationError, match="one plane"):
        dlt.solve_dlt(xyz[plane], px[plane])
    with pytest.raises(ComputationError, match="at least 6"):
        dlt.solve_dlt(xyz[:5], px[:5])
