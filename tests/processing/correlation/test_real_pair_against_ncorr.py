"""The real rig's image pairs: every point is matched, and agrees with Ncorr's biquintic first-order matches."""

from pathlib import Path

import numpy as np
import pytest
from ringdic.correlation import CorrelationSettings, correlate_points, grid, prepare_current, prepare_reference
from ringdic.correlation.command import correlate_files
from ringdic.session.images import read_gray, read_mask

SETTINGS = CorrelationSettings(radius=21, step=12, order=1, subset="circle")
LIMITS = {"201": 0.015, "202": 0.08}  # px, 95 % of the points


@pytest.fixture(scope="module")
def rig(shared_data: Path) -> Path:
    return shared_data / "multidic_rig"


@pytest.fixture(scope="module")
def ncorr(rig: Path) -> dict[str, np.ndarray]:
    with np.load(rig / "reference.npz") as file:
        return {name: file[name] for name in file.files if name.startswith(("points2d_2", "corrcoef", "face"))}


@pytest.fixture(scope="module")
def reference(rig: Path):
    image = read_gray(rig / "speckle" / "201_1.jpg")
    return prepare_reference(image, read_mask(rig / "roi_mask.png", image.shape), SETTINGS)


def test_grid_and_grey_levels_are_those_of_the_reference(rig, ncorr):
    image = read_gray(rig / "speckle" / "201_1.jpg")
    xy, faces = grid(read_mask(rig / "roi_mask.png", image.shape), 12)
    np.testing.assert_array_equal(xy, ncorr["points2d_201"][0])
    assert len(faces) == len(ncorr["faces"])

    def turn(triangles):
        a, b = xy[triangles[:, 1]] - xy[triangles[:, 0]], xy[triangles[:, 2]] - xy[triangles[:, 0]]
        return np.sign(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])

    assert set(turn(faces)) == set(turn(ncorr["faces"])) == {-1.0}
    grey = image[xy[:, 1].astype(int), xy[:, 0].astype(int)].astype(float)
    np.testing.assert_allclose(grey[ncorr["faces"]].mean(axis=1), ncorr["face_gray"], atol=1e-9)


@pytest.mark.parametrize(("camera", "frame"), [("201", 2), ("201", 3), ("202", 1), ("202", 2), ("202", 3)])
def test_all_points_are_matched_and_agree_with_ncorr(rig, ncorr, reference, camera, frame):
    truth = ncorr[f"points2d_{camera}"][frame - 1]
    xy = ncorr["points2d_201"][0]
    current = prepare_current(read_gray(rig / "speckle" / f"{camera}_{frame}.jpg"), None, SETTINGS)
    result = correlate_points(reference, current, xy, SETTINGS)
    error = np.hypot(*(xy + result.uv - truth).T)
    p50, p95 = np.percentile(error, [50, 95])
    summary = f"{camera}_{frame}: {result.good.sum()} of {len(xy)}"
    print(f"{summary}, median {p50:.5f}, 95 % {p95:.5f}, largest {error.max():.5f} px")
    assert result.good.all()
    assert error.max() < 1.0
    assert p50 <= 0.005
    assert p95 <= LIMITS[camera]
    # The same subset, criterion and interpolation: the coefficients agree far beyond the noise of the positions.
    np.testing.assert_allclose(result.c_ls, ncorr[f"corrcoef_{camera}"][frame - 1], atol=1e-4)


def test_files_are_correlated_into_points(rig, ncorr, tmp_path):
    out = tmp_path / "points.npz"
    summary = correlate_files(
        rig / "speckle" / "201_1.jpg",
        rig / "speckle" / "201_2.jpg",
        out,
        CorrelationSettings(radius=21, step=36),
        mask=rig / "roi_mask.png",
        threads=1,
    )
    assert summary["threads"] == 1
    assert summary["points"] == summary["good"]
    assert set(summary["seconds"]) == {"prepare", "start", "refine"}
    with np.load(out) as points:
        n = summary["points"]
        shapes = {name: points[name].shape for name in points.files if name != "faces"}
        assert shapes == {
            "xy": (n, 2), "uv": (n, 2), "gradient": (n, 2, 2), "zncc": (n,),
            "iterations": (n,), "status": (n,), "sigma": (n, 2),
        }  # fmt: skip
        assert points["faces"].shape[1] == 3
        known = {tuple(p): k for k, p in enumerate(ncorr["points2d_201"][0])}
        rows = [known[tuple(p)] for p in points["xy"]]
        truth = ncorr["points2d_201"][1][rows]
        assert np.hypot(*(points["xy"] + points["uv"] - truth).T).max() < 0.01
    assert [p.name for p in tmp_path.iterdir()] == ["points.npz"]
