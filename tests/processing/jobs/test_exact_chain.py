"""Undistortion, triangulation, rigid motion and deformation against MultiDIC's own numbers on the paper's rig."""

from pathlib import Path

import numpy as np
import pytest
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.triangulation import reprojection_residuals, triangulate, triangulate_undistorted
from ringdic.strain.deformation import deformation
from ringdic.strain.deformation import isotropy as face_isotropy
from ringdic.strain.rigid_motion import kabsch

pytestmark = pytest.mark.shared
IDS = ("201", "202")


@pytest.fixture(scope="module")
def reference(shared_data: Path) -> dict[str, np.ndarray]:
    with np.load(shared_data / "multidic_rig" / "reference.npz") as arrays:
        return {name: arrays[name] for name in arrays}


@pytest.fixture(scope="module")
def cameras(reference: dict[str, np.ndarray]) -> list[Camera]:
    size = (2464, 3280)
    return [
        Camera(
            name,
            np.append(reference[f"dlt_undistorted_{name}"], 1.0).reshape(3, 4),
            size,
            Intrinsics(reference[f"K_{name}"], reference[f"dist_{name}"], size),
        )
        for name in IDS
    ]


def test_pixels_are_undistorted_as_by_multidic(reference: dict[str, np.ndarray], cameras: list[Camera]) -> None:
    for name, camera in zip(IDS, cameras, strict=True):
        found = camera.undistort(reference[f"points2d_{name}"])
        np.testing.assert_allclose(found, reference[f"points2d_undistorted_{name}"], rtol=0, atol=1e-6)


@pytest.mark.parametrize("frame", [0, 1, 2])
def test_points_are_triangulated_as_by_multidic(
    reference: dict[str, np.ndarray], cameras: list[Camera], frame: int
) -> None:
    undistorted = np.stack([reference[f"points2d_undistorted_{name}"][frame] for name in IDS])
    exact = triangulate_undistorted(np.stack([camera.P for camera in cameras]), undistorted)
    np.testing.assert_allclose(exact, reference["points3d"][frame], rtol=0, atol=1e-7)
    whole = triangulate(cameras, np.stack([reference[f"points2d_{name}"][frame] for name in IDS]))
    np.testing.assert_allclose(whole, reference["points3d"][frame], rtol=0, atol=1e-7)


def test_the_pair_jitters_by_the_known_vertical_residuals(
    reference: dict[str, np.ndarray], cameras: list[Camera]
) -> None:
    for frame, expected in enumerate((0.13, 0.24, 0.35)):
        px = np.stack([reference[f"points2d_{name}"][frame] for name in IDS])
        vertical = reprojection_residuals(cameras, reference["points3d"][frame], px)[..., 1].mean(axis=1)
        assert vertical[0] == pytest.approx(-expected, abs=0.02)  # measured minus projected
        assert vertical[1] == pytest.approx(expected, abs=0.02)


def test_the_rigid_motion_is_multidics(reference: dict[str, np.ndarray]) -> None:
    points = reference["points3d"]
    for frame in (1, 2):
        motion = kabsch(points[frame], points[0])
        np.testing.assert_allclose(motion.R, reference["rbm_R"][frame], rtol=0, atol=1e-10)
        np.testing.assert_allclose(motion.t, reference["rbm_t"][frame], rtol=0, atol=1e-7)
        removed = reference["points3d_rbm_removed"][frame]
        np.testing.assert_allclose(motion.apply(points[frame]), removed, rtol=0, atol=1e-7)


def test_every_deformation_field_is_multidics(reference: dict[str, np.ndarray]) -> None:
    points, faces = reference["points3d"], reference["faces"]
    found = deformation(points[0], points[1:], faces)
    same = {
        "F": "F", "E": "E_tensor", "e": "almansi_tensor", "J": "J", "lambda1": "lambda1", "lambda2": "lambda2",
        "E1": "E_pc1", "E2": "E_pc2", "e1": "almansi_pc1", "e2": "almansi_pc2", "E_magnitude": "E_mgn",
        "e_magnitude": "almansi_mgn", "E_equivalent": "E_eq", "e_equivalent": "almansi_eq",
        "E_shear": "E_shear_max", "e_shear": "almansi_shear_max", "normal_current": "normal_cur",
        "area": "area_ref_mm2",
    }  # fmt: skip
    for ours, theirs in same.items():
        np.testing.assert_allclose(getattr(found, ours), reference[theirs], rtol=0, atol=1e-10, err_msg=ours)
    index = face_isotropy(points, faces)
    np.testing.assert_allclose(index, reference["face_isotropy_index"], rtol=0, atol=1e-10)


def test_principal_directions_are_multidics_up_to_sign(reference: dict[str, np.ndarray]) -> None:
    points, faces = reference["points3d"], reference["faces"]
    found = deformation(points[0], points[1:], faces)
    # Round-off, below 1e-11 in a strain, turns its directions by (round-off / gap of the principal values).
    gap = (found.E2 - found.E1)[..., None]
    assert gap.min() > 1e-7
    same = {
        "direction1_reference": ("E_pc1_dir_ref",),
        "direction2_reference": ("E_pc2_dir_ref",),
        "direction1_current": ("E_pc1_dir_cur", "almansi_pc1_dir_cur"),
        "direction2_current": ("E_pc2_dir_cur", "almansi_pc2_dir_cur"),
    }
    for ours, theirs in same.items():
        direction = getattr(found, ours)
        for name in theirs:
            sign = np.sign(np.einsum("...i,...i->...", direction, reference[name]))[..., None]
            error = np.abs(direction - sign * reference[name])
            assert (error <= 1e-10 + 1e-11 / gap).all(), (ours, name, error.max())
