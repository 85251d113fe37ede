"""Twelve cameras from a renderer that is not this project's: a deforming limb, imported and processed with no click."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from processing.results import Results, read_results
from processing.session import newest_results

TURN = 2 * np.pi


@dataclass
class Truth:
    """The limb's true surfaces as splines over (theta, z)."""

    theta: np.ndarray
    z: np.ndarray
    positions: list[list[RectBivariateSpline]]
    seen_by: np.ndarray  # (theta, z): cameras that see the reference under 60°

    @classmethod
    def read(cls, path: Path) -> "Truth":
        truth = np.load(path)
        theta, z = truth["theta"], truth["z"]
        seen_by = ((truth["visible"][0] > 0) & (truth["cosview"][0] > 0.5)).sum(axis=0)
        return cls(theta, z, [_splines(theta, z, positions) for positions in truth["x"]], seen_by)

    def at(self, step: int, theta: np.ndarray, z: np.ndarray, **derivative: int) -> np.ndarray:
        """Positions, or their derivatives (dx by theta, dy by z), (n, 3)."""
        return np.stack([spline.ev(theta % TURN, z, **derivative) for spline in self.positions[step]], axis=-1)

    def nearest(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """theta, z and signed distance of the nearest points of the reference surface, by Gauss-Newton."""
        theta, z = np.arctan2(xyz[:, 1], xyz[:, 0]), xyz[:, 2].copy()
        for _ in range(10):
            t, s = self.at(0, theta, z, dx=1), self.at(0, theta, z, dy=1)
            e = xyz - self.at(0, theta, z)
            A = np.array([[np.sum(t * t, 1), np.sum(t * s, 1)], [np.sum(t * s, 1), np.sum(s * s, 1)]])
            b = np.stack([np.sum(t * e, 1), np.sum(s * e, 1)], axis=1)
            step = np.linalg.solve(np.moveaxis(A, 2, 0), b[..., None])[..., 0]
            theta, z = theta + step[:, 0], z + step[:, 1]
        normal = np.cross(self.at(0, theta, z, dx=1), self.at(0, theta, z, dy=1))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return theta, z, np.sum((xyz - self.at(0, theta, z)) * normal, axis=1)


def _splines(theta: np.ndarray, z: np.ndarray, positions: np.ndarray) -> list[RectBivariateSpline]:
    pad = 6
    round_ = np.concatenate([theta[-pad:] - TURN, theta, theta[:pad] + TURN])
    closed = np.concatenate([positions[-pad:], positions, positions[:pad]])
    return [RectBivariateSpline(round_, z, closed[..., k]) for k in range(3)]


@pytest.fixture(scope="module")
def results(ringdic: Callable, shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Results:
    session = tmp_path_factory.mktemp("limb") / "session"
    source = shared_data / "rendered_ring" / "limb"
    settings = ["--set", "correlation.radius_px=12", "--set", "correlation.step_px=6"]
    ringdic("import", source, session, timeout_s=500)
    ringdic("process", session, *settings, timeout_s=500)
    return read_results(newest_results(session))


@pytest.fixture(scope="module")
def truth(shared_data: Path) -> Truth:
    return Truth.read(shared_data / "rendered_ring" / "limb" / "truth.npz")


@pytest.fixture(scope="module")
def material(results: Results, truth: Truth) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    theta, z, distance = truth.nearest(results.vertices_ref)
    return theta, z, distance, (z >= truth.z[0]) & (z <= truth.z[-1])  # the truth covers the speckled band


def test_all_cameras_and_pairs_take_part(results: Results, shared_data: Path, figures) -> None:
    centres = np.load(shared_data / "rendered_ring" / "limb" / "target_truth.npz")["projected_px"]
    assert len(results.cameras) == 12
    assert len(results.pairs) == 12
    assert set(results.vertex_pair) == set(range(12))
    worst = 0.0
    for k, camera in enumerate(results.calibration["cameras"]):
        dots = camera["dots"]
        rows, columns = np.array(dots["rows"]) - 1, np.array(dots["columns"]) - 1
        offset = np.linalg.norm(np.array(dots["px"]) - centres[k, rows, columns], axis=1)
        worst = max(worst, float(offset.max()))
        assert len(rows) >= 100
    figures("rendered limb: dots numbered rightly, largest offset", f"{worst:.2f} px", "a column is over 20 px")
    assert worst < 0.5


def test_control_points(results: Results, figures) -> None:
    rms = [pair["rms_mm"] for pair in results.calibration["pairs"]]
    figures("rendered limb: control points, RMS, worst of 12 pairs", f"{max(rms):.4f} mm", "≤ 0.05")
    assert len(rms) == 12
    assert max(rms) <= 0.05


def test_the_shape(material, figures) -> None:
    _, _, distance, inside = material
    rms, worst = float(np.sqrt(np.mean(distance[inside] ** 2))), float(np.abs(distance[inside]).max())
    figures("rendered limb: distance from the true surface, RMS", f"{rms:.4f} mm", "≤ 0.08")
    figures("rendered limb: largest distance from the surface", f"{worst:.3f} mm", "≤ 1")
    assert inside.mean() > 0.95
    assert rms <= 0.08
    assert worst <= 1.0


@pytest.mark.parametrize("step", [1, 2])
def test_the_displacement(results: Results, truth: Truth, material, figures, step: int) -> None:
    theta, z, _, inside = material
    moved = truth.at(step, theta, z) - truth.at(0, theta, z)
    error = np.linalg.norm(results.vertices[step] - results.vertices_ref - moved, axis=1)[inside]
    rms, worst = float(np.sqrt(np.nanmean(error**2))), float(np.nanmax(error))
    figures(f"rendered limb: displacement of step {step}, RMS", f"{rms:.4f} mm", "≤ 0.05")
    figures(f"rendered limb: largest error of step {step}", f"{worst:.3f} mm", "≤ 1")
    assert np.isfinite(error).mean() > 0.98
    assert rms <= 0.05
    assert worst <= 1.0


def test_the_coverage(results: Results, truth: Truth, material, figures) -> None:
    theta, z, _, _ = material
    fine = 8
    picture = np.zeros((len(truth.z) * fine, len(truth.theta) * fine), np.uint8)
    per_theta, per_z = len(truth.theta) * fine / TURN, fine / (truth.z[1] - truth.z[0])
    corners = theta[results.faces]
    corners = corners[:, :1] + (corners - corners[:, :1] + np.pi) % TURN - np.pi
    for turn in (-TURN, 0.0, TURN):
        xy = np.stack([(corners + turn) * per_theta, (z[results.faces] - truth.z[0]) * per_z], axis=-1)
        for triangle in np.round(xy[(xy[..., 0].max(1) >= 0) & (xy[..., 0].min(1) < picture.shape[1])] * 16):
            cv2.fillConvexPoly(picture, triangle.astype(np.int32), 255, shift=4)
    covered = picture[::fine, ::fine].T[: len(truth.theta), : len(truth.z)] > 0
    grid = np.meshgrid(truth.theta, truth.z, indexing="ij")
    area = np.linalg.norm(np.cross(truth.at(0, *grid, dx=1), truth.at(0, *grid, dy=1)), axis=-1)
    seen = truth.seen_by >= 2
    share = float((area * (covered & seen)).sum() / (area * seen).sum())
    figures("rendered limb: covered share of what two cameras see", f"{share:.1%}", "≥ 90 %")
    assert share >= 0.9
