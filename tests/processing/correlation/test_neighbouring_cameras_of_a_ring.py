"""A deforming limb seen by two neighbouring cameras of a ring, from an independent renderer with exact truth.

Matched between the cameras and three steps apart with no calibration, no mask and no start value. First order is
biased across a curved surface, second order is not.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from ringdic.correlation import CorrelationSettings, correlate_points, prepare_current, prepare_reference
from ringdic.geometry.camera import Intrinsics
from ringdic.session.images import read_gray

BORDER = 10.0  # mm of the speckled band left out at either end


def project(camera, xyz):
    """Pixels (..., 2) of world points (..., 3) in a camera with its lens."""
    K = np.array([[camera["fx"], camera["skew"], camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
    lens = Intrinsics(K, np.array(camera["dist_k1k2p1p2k3"]), (camera["width"], camera["height"]))
    x = xyz @ np.array(camera["R"]).T + np.array(camera["t"])
    xy = lens.distort_normalised(x[..., :2] / x[..., 2:])
    return xy @ K[:2, :2].T + K[:2, 2]


@pytest.fixture(scope="module")
def ring(shared_data: Path) -> Path:
    """Folder of the rendered ring."""
    return shared_data / "rendered_ring"


@pytest.mark.parametrize(
    ("cameras", "steps", "order", "bias", "rms"),
    [((0, 0), (0, 2), 1, 0.005, 0.03), ((0, 1), (0, 0), 1, 0.15, 0.2), ((9, 10), (0, 2), 2, 0.015, 0.06)],
)
def test_every_visible_point_is_matched(ring, cameras, steps, order, bias, rms):
    with np.load(ring / "limb" / "truth.npz") as truth:
        band = np.broadcast_to((truth["z"] > BORDER) & (truth["z"] < 250 - BORDER), truth["X_ref"].shape[:2])
        seen = band.copy()
        for camera, step in zip(cameras, steps, strict=True):
            seen &= truth["visible"][step, camera].astype(bool) & (truth["cosview"][step, camera] > 0.5)
        xyz = [truth["x"][step][seen] for step in steps]
    described = json.loads((ring / "cameras_truth.json").read_text())["cameras"]
    images = [
        read_gray(ring / "limb" / "specimen" / described[camera]["name"] / f"{step:03d}.jpg")
        for camera, step in zip(cameras, steps, strict=True)
    ]
    xy, to = (project(described[camera], x) for camera, x in zip(cameras, xyz, strict=True))
    settings = CorrelationSettings(radius=12, step=20, order=order)
    result = correlate_points(prepare_reference(images[0]), prepare_current(images[1]), xy, settings)
    error = result.uv - (to - xy)
    print(f"{result.good.sum()} of {len(xy)}, bias {np.nanmean(error, axis=0)}, rms {np.nanstd(error, axis=0)} px")
    assert result.good.mean() > 0.99
    assert np.nanmax(np.hypot(*error.T)) < 1.0
    assert np.all(np.abs(np.nanmean(error, axis=0)) < bias)
    assert np.all(np.sqrt(np.nanmean(error**2, axis=0)) < rms)
