"""The paper's real rig, two of its cameras, imported as a folder and processed with no click."""

import importlib.util
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.session.folder import newest_results
from ringdic.strain.rigid_motion import kabsch
from scipy.optimize import least_squares

#: As in the sample: Ncorr's radius 21 px and spacing 11 px, which is a step of 12.
SUBSETS = ("correlation.radius_px=21", "correlation.step_px=12")
PAIR = Path(__file__).parents[1] / "rigs" / "multidic_pair" / "arrange.py"


def _arrange(data: Path, folder: Path) -> Path:
    spec = importlib.util.spec_from_file_location("arrange_multidic_pair", PAIR)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.arrange(data, folder)


#: The paper's way, its correlation with the bundle's cameras, and the better way.
WAYS = {
    "paper's way": ("method=paper",),
    "paper's way, bundle": ("method=paper", "calibration.method=bundle"),
    "best": (),
}


@pytest.fixture(scope="module")
def session(ringdic: Callable, shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pair with MultiDIC's region of interest."""
    folder = tmp_path_factory.mktemp("paper")
    source = _arrange(shared_data / "multidic_rig", folder / "source")
    (source / "mask").mkdir()
    shutil.copyfile(shared_data / "multidic_rig" / "roi_mask.png", source / "mask" / "201.png")
    ringdic("import", source, folder / "session", timeout_s=400)
    return folder / "session"


@pytest.fixture(scope="module")
def ways(ringdic: Callable, session: Path) -> dict[str, Results]:
    found = {}
    for way, options in WAYS.items():
        settings = [each for name in (*SUBSETS, *options) for each in ("--set", name)]
        ringdic("process", session, *settings, timeout_s=400)
        found[way] = read_results(newest_results(session))
    return found


@pytest.fixture(scope="module")
def results(ways: dict[str, Results]) -> Results:
    return ways["paper's way"]


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


def _figures(results: Results) -> dict[str, tuple[float, ...]]:
    """The rows of the table of MultiDIC's README that a session gives; a number for each of frames 2 and 3."""
    error = results.calibration["pairs"][0]
    radii = _cylinder(results.vertices_ref[np.isfinite(results.vertices_ref).all(axis=1)])
    rigid, median, high, J, J_std = [], [], [], [], []
    for step in (1, 2):
        distance = np.linalg.norm(results.motion(step).apply(results.vertices[step]) - results.vertices_ref, axis=1)
        rigid.append(float(np.sqrt(np.nanmean(distance**2))))
        deformed = results.deformation(step)
        median.append(float(np.nanmedian(deformed.E_magnitude)))
        high.append(float(np.nanpercentile(deformed.E_magnitude, 95)))
        J.append(float(np.nanmean(deformed.J)))
        J_std.append(float(np.nanstd(deformed.J)))
    return {
        "control points: mean vector, RMS, mm": (error["mean_mm"], error["rms_mm"]),
        "dots off their projection, RMS, px": tuple(row["residual_rms"] for row in results.summary["cameras"]),
        "diameter off 114, STD of 2 r, mm": (2 * radii.mean() - 114.0, 2 * radii.std()),
        "rigid residual, frames 2, 3, mm": tuple(rigid),
        "|E| median, frames 2, 3": tuple(median),
        "|E| 95 %, frames 2, 3": tuple(high),
        "J mean, frames 2, 3": tuple(J),
        "J STD, frames 2, 3": tuple(J_std),
    }


#: What MultiDIC reaches, to the digits of its README, the last digit rounded up: no figure may be above.
MULTIDIC = {
    "control points: mean vector, RMS, mm": (0.0037, 0.060),
    "dots off their projection, RMS, px": (0.37, 0.32),
    "diameter off 114, STD of 2 r, mm": (0.0125, 0.0415),
    "rigid residual, frames 2, 3, mm": (0.0125, 0.0125),
    "|E| median, frames 2, 3": (1.05e-3, 1.06e-3),
    "|E| 95 %, frames 2, 3": (2.25e-3, 2.26e-3),
    "J STD, frames 2, 3": (1.05e-3, 1.08e-3),
}


def test_every_figure_of_multidic_is_reached(ways: dict[str, Results], figures) -> None:
    found = {way: _figures(results) for way, results in ways.items()}
    for way, rows in found.items():
        for what, values in rows.items():
            bound = MULTIDIC.get(what, (0.9996, 0.9997))
            told = ", ".join(f"{value:+.5f}" for value in values)
            figures(f"paper's rig, {way}: {what}", told, ", ".join(f"{each:g}" for each in bound))
    for what, bound in MULTIDIC.items():
        values = np.abs(found["paper's way, bundle"][what])
        # Two errors cancel in MultiDIC's mean diameter: dots' centroids make it larger, flat subsets smaller.
        bound = (0.05, bound[1]) if "diameter" in what else bound
        assert (values <= bound).all(), what
    for rows in found.values():
        # A rigid body: what J is off 1 is the cameras' unrest, as large for MultiDIC (0.9996 to 0.9997).
        assert np.abs(np.array(rows["J mean, frames 2, 3"]) - 1).max() < 5e-4
        assert rows["control points: mean vector, RMS, mm"][1] <= 0.060
        assert abs(rows["diameter off 114, STD of 2 r, mm"][0]) <= 0.05
        assert rows["diameter off 114, STD of 2 r, mm"][1] <= 0.0415
    better = found["best"]
    assert max(better["rigid residual, frames 2, 3, mm"]) <= 0.0145
    assert better["diameter off 114, STD of 2 r, mm"][1] <= 0.03


def test_matches_are_as_sure_as_ncorr_s(results: Results, reference, figures) -> None:
    ours = [np.nanmedian(c) for c in results.correlation]
    theirs = [float(np.median(reference["corrcoef_202"][frame])) for frame in range(3)]
    worst = float(np.nanmax(results.correlation))
    figures("paper's rig: C_LS median by frame", ", ".join(f"{c:.4f}" for c in ours), "0.019-0.020")
    figures("paper's rig: C_LS largest", f"{worst:.4f}", "0.066")
    assert np.isclose(ours[0], theirs[0], rtol=0.01)
    # Later images are matched to their own camera's, and look more alike than those of two cameras.
    assert all(own < 0.5 * across for own, across in zip(ours[1:], theirs[1:], strict=True))
    assert worst <= 0.068


def test_the_points_are_multidics(results: Results, reference, figures) -> None:
    matches = results.matches[0]
    vertex = {(int(x), int(y)): v for (x, y), v in zip(matches.xy, matches.vertex, strict=True)}
    grid = np.round(reference["points2d_201"][0]).astype(int)
    mine = np.array([vertex.get((int(x), int(y)), -1) for x, y in grid])
    common = mine >= 0
    # Where the pattern ends within the drawn region, no point lies beyond the pixels that subsets use.
    figures("paper's rig: MultiDIC's points measured here", f"{common.sum()} of {len(grid)}", "≥ 98.5 %")
    assert common.mean() >= 0.985
    for frame in range(3):
        ours, theirs = results.vertices[frame][mine[common]], reference["points3d"][frame][common]
        distance = np.linalg.norm(kabsch(ours, theirs).apply(ours) - theirs, axis=1)
        rms = float(np.sqrt(np.nanmean(distance**2)))
        figures(f"paper's rig: points against MultiDIC's, frame {frame + 1}", f"{rms:.4f} mm RMS", "≤ 0.04")
        assert np.isfinite(distance).mean() >= 0.99
        assert rms <= 0.04


def test_the_cameras_unrest_is_reported(ways: dict[str, Results]) -> None:
    # The vertical residual of camera 201 is +0.13, +0.24, +0.35 px, projected minus measured, in frames 1, 2, 3.
    drift = ways["paper's way"].summary["drift_px"]["201"]
    np.testing.assert_allclose(drift, [-0.13, -0.24, -0.35], atol=0.05)  # measured minus projected
    for way, results in ways.items():
        assert results.summary["verdict"] != "do not use", way
        moved = [each for each in results.summary["findings"] if each["code"] in ("camera-moved", "camera-drift")]
        assert any(results.steps[2] in each["sentence"] for each in moved), way


def test_the_calibration_says_what_to_do_better(ways: dict[str, Results]) -> None:
    calibration = ways["paper's way, bundle"].summary["calibration"]
    assert "camera 201: board views cover 38 % of the image; take views nearer the corners" in calibration["advice"]
    assert 0.01 < calibration["bundle"]["print_errors_rms_mm"] < 0.05
    assert calibration["pairs"][0]["angle_deg"] == pytest.approx(36.7, abs=1.0)
