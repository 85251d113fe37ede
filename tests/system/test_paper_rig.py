"""The paper's real rig, two of its cameras, imported as a folder and processed with no click."""

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from processing.results import Results, read_results
from processing.rigid_motion import kabsch
from processing.session import newest_results

PAIR = Path(__file__).parents[1] / "rigs" / "multidic_pair" / "arrange.py"


def _arrange(data: Path, folder: Path) -> Path:
    spec = importlib.util.spec_from_file_location("arrange_multidic_pair", PAIR)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.arrange(data, folder)


@pytest.fixture(scope="module")
def results(ringdic: Callable, shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Results:
    folder = tmp_path_factory.mktemp("paper")
    source = _arrange(shared_data / "multidic_rig", folder / "source")
    session = folder / "session"
    settings = ["--set", "correlation.radius_px=21", "--set", "correlation.step_px=12"]
    ringdic("import", source, session, timeout_s=400)
    ringdic("process", session, *settings, timeout_s=400)
    return read_results(newest_results(session))


@pytest.fixture(scope="module")
def reference(shared_data: Path):
    return np.load(shared_data / "multidic_rig" / "reference.npz")


def _cylinder(xyz: np.ndarray) -> np.ndarray:
    """Distances (n,) mm of points from the axis of the best-fitting cylinder."""

    def radii(p: np.ndarray) -> np.ndarray:
        axis = np.array([p[0], p[1], 1.0]) / np.hypot(1.0, np.hypot(p[0], p[1]))
        return np.linalg.norm(np.cross(xyz - [p[2], p[3], 0.0], axis), axis=1)

    fit = least_squares(lambda p: radii(p) - p[4], [0.0, 0.0, 0.0, 0.0, 57.0])
    return radii(fit.x)


def test_control_points(results: Results, figures) -> None:
    error = results.calibration["pairs"][0]
    figures("paper's rig: control points, RMS", f"{error['rms_mm']:.4f} mm", "≤ 0.07 (MultiDIC 0.060)")
    assert error["points"] >= 80
    assert error["rms_mm"] <= 0.07


def test_the_cylinder_has_its_diameter(results: Results, figures) -> None:
    radii = _cylinder(results.vertices_ref)
    diameter, scatter = 2 * radii.mean(), 2 * radii.std()
    figures("paper's rig: diameter of frame 1", f"{diameter:.3f} mm", "114.00 ± 0.10 (MultiDIC 113.99)")
    figures("paper's rig: STD of 2 r", f"{scatter:.3f} mm", "≤ 0.06 (MultiDIC 0.041)")
    assert abs(diameter - 114.0) <= 0.10
    assert scatter <= 0.06


@pytest.mark.parametrize("step", [1, 2])
def test_the_motion_is_rigid(results: Results, figures, step: int) -> None:
    moved = results.motion(step).apply(results.vertices[step])
    distance = np.linalg.norm(moved - results.vertices_ref, axis=1)
    residual = float(np.sqrt(np.nanmean(distance**2)))
    strain = float(np.nanmedian(results.deformation(step).E_magnitude))
    figures(f"paper's rig: rigid residual, frame {step + 1}", f"{residual:.4f} mm", "≤ 0.02 (MultiDIC 0.012)")
    figures(f"paper's rig: median |E|, frame {step + 1}", f"{strain:.2e}", "≤ 1.5e-3 (MultiDIC 1.0e-3)")
    assert residual <= 0.02
    assert strain <= 1.5e-3


def test_the_points_are_multidics(results: Results, reference, figures) -> None:
    matches = results.matches[0]
    vertex = {(int(x), int(y)): v for (x, y), v in zip(matches.xy, matches.vertex, strict=True)}
    grid = np.round(reference["points2d_201"][0]).astype(int)
    mine = np.array([vertex.get((int(x), int(y)), -1) for x, y in grid])
    common = mine >= 0
    figures("paper's rig: MultiDIC's points measured here", f"{common.sum()} of {len(grid)}", "≥ 99 %")
    assert common.mean() >= 0.99
    for frame in range(3):
        ours, theirs = results.vertices[frame][mine[common]], reference["points3d"][frame][common]
        distance = np.linalg.norm(kabsch(ours, theirs).apply(ours) - theirs, axis=1)
        rms = float(np.sqrt(np.nanmean(distance**2)))
        figures(f"paper's rig: points against MultiDIC's, frame {frame + 1}", f"{rms:.4f} mm RMS", "≤ 0.04")
        assert np.isfinite(distance).mean() >= 0.99
        assert rms <= 0.04


def test_the_cameras_unrest_is_reported(results: Results) -> None:
    # The vertical residual of this pair is +0.13, +0.24, +0.35 px, projected minus measured, in frames 1, 2, 3.
    drift = results.summary["drift_px"]["201-202"]
    np.testing.assert_allclose(drift, [-0.13, -0.24, -0.35], atol=0.05)  # measured minus projected
