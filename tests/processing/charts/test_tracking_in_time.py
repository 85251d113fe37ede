"""A camera's points followed to a later image of a limb whose deformation is known exactly."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ringdic.charts.step_matching import ImageMatches, match_tracked_points
from ringdic.charts.tracked_points import tracked_points
from ringdic.correlation import CorrelationSettings, prepare_current, prepare_reference
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.session.images import read_gray

LATER = 2
SETTINGS = CorrelationSettings(radius=20, step=10)


@pytest.fixture(scope="module")
def limb(shared_data: Path):
    """A camera's images of the limb at rest and stretched, where its points truly are, and cosines of incidence."""
    folder = shared_data / "rendered_ring"
    one = json.loads((folder / "cameras_truth.json").read_text())["cameras"][0]
    K = np.array([[one["fx"], one["skew"], one["cx"]], [0.0, one["fy"], one["cy"]], [0.0, 0.0, 1.0]])
    inner = Intrinsics(K, np.array(one["dist_k1k2p1p2k3"]), (one["width"], one["height"]))
    P = inner.K_undistorted @ np.column_stack([one["R"], one["t"]])
    camera = Camera("cam_01", P / P[2, 3], inner.size, inner)
    images = [read_gray(folder / "limb" / "specimen" / "cam_01" / f"{k:03d}.jpg") for k in (0, LATER)]
    with np.load(folder / "limb" / "truth.npz") as truth:
        seen, cosine, x = truth["visible"][0, 0], truth["cosview"][0, 0].astype(float), truth["x"].astype(float)
    px = [camera.project(x[k]) for k in (0, LATER)]
    inside = (np.abs(px[0] - np.array(camera.size) / 2) < np.array(camera.size) / 2 - 25).all(axis=-1)
    keep = seen & inside & (cosine > np.cos(np.radians(60)))
    return images, [each[keep] for each in px], cosine[keep]


@pytest.fixture(scope="module")
def tracked(limb) -> tuple[ImageMatches, np.ndarray]:
    """The matches of all points, and their errors (n, 2) px."""
    (before, after), px, _ = limb
    reference = prepare_reference(before, None, SETTINGS)
    points = tracked_points(reference, px[0], SETTINGS)
    matches = match_tracked_points(reference, prepare_current(after, None, SETTINGS), points, None, SETTINGS)
    return matches, px[0] + matches.warp[:, :2] - px[1]


def test_points_of_a_strongly_bent_field_are_unbiased_and_quiet(limb, tracked, figures: Callable) -> None:
    matches, error = tracked
    facing = limb[2] > np.cos(np.radians(50))
    assert matches.good[facing].mean() > 0.998
    error = error[facing & matches.good]
    mean, std = error.mean(axis=0), error.std(axis=0)
    figures(
        "limb in time from optical flow, mean and STD of u, v",
        f"{mean[0]:+.4f} {mean[1]:+.4f}, {std[0]:.4f} {std[1]:.4f} px",
        "< 0.0015, < 0.006",
    )
    # The images' own noise alone is 0.0025 px before compression; plain first order is off by 0.03 px.
    assert (np.abs(mean) < 0.0015).all()
    assert (std < 0.006).all()


def test_stated_uncertainty_is_near_the_scatter_at_every_incidence(limb, tracked, figures: Callable) -> None:
    matches, error = tracked
    cosine = limb[2]
    for low, high in ((0, 45), (45, 55), (55, 60)):
        band = (cosine <= np.cos(np.radians(low))) & (cosine > np.cos(np.radians(high)))
        assert matches.good[band].mean() > 0.93
        band &= matches.good
        ratio = np.sqrt(np.mean((error[band] / matches.sigma[band]) ** 2))
        figures(
            f"limb in time from optical flow, {low}-{high} degrees, observed / stated", f"{ratio:.2f}", "0.75 to 1.8"
        )
        assert 0.75 < ratio < 1.8


def test_an_image_matched_with_itself_does_not_move(limb) -> None:
    (before, _), px, _ = limb
    settings = replace(SETTINGS, step=40)
    reference = prepare_reference(before, None, settings)
    points = tracked_points(reference, px[0][::9], settings)
    matches = match_tracked_points(reference, prepare_current(before, None, settings), points, None, settings)
    assert matches.good.mean() > 0.99
    assert np.abs(matches.warp[matches.good, :2]).max() < 1e-3
