"""Two cameras that show different instants of a motion along the line through both are told by the body's size."""

import numpy as np
import pytest
from ringdic.charts.instants import two_instants
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import triangulate

STEP = "0002-specimen"


def facing_pair() -> list[Camera]:
    """Two cameras without distortion, 180 mm apart and 300 mm before the origin, turned towards it."""
    cameras = []
    for k, x in enumerate((-90.0, 90.0)):
        forwards = np.array([-x, 0.0, 300.0]) / np.hypot(x, 300.0)
        right = np.array([forwards[2], 0.0, -forwards[0]])
        R = np.stack([right, np.cross(forwards, right), forwards])
        P = np.array([[2600.0, 0, 1200], [0, 2600, 1600], [0, 0, 1]]) @ np.column_stack([R, -R @ [x, 0, -300.0]])
        cameras.append(Camera(f"c{k}", P / P[2, 3], (2400, 3200)))
    return cameras


def plate() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-40, 40, 15), np.linspace(-60, 60, 15))
    return np.stack([x.ravel(), y.ravel(), 0.05 * x.ravel()], axis=1)


def measured(cameras: list[Camera], *seen: np.ndarray) -> np.ndarray:
    """Points measured by cameras that show the body at different places, with 0.02 px of noise."""
    rng = np.random.default_rng(3)
    px = [camera.project(xyz) + rng.normal(0, 0.02, (len(xyz), 2)) for camera, xyz in zip(cameras, seen, strict=True)]
    return triangulate(cameras, np.stack(px))


@pytest.mark.parametrize("shift", [2.0, -0.7])
def test_a_plate_that_moved_sideways_between_two_exposures_is_told_by_its_size(shift: float) -> None:
    cameras, xyz = facing_pair(), plate()
    apart = measured(cameras, xyz + np.array([shift, 0, 0]), xyz)
    finding = two_instants(cameras, measured(cameras, xyz, xyz), apart, STEP)
    assert (finding.code, finding.cameras, finding.step) == ("instants-differ", ("c0", "c1"), STEP)
    assert finding.value == pytest.approx(100 * abs(shift) / 180, rel=0.1)  # by similar triangles


@pytest.mark.parametrize("change", ["none", "nearer", "warmer", "longer", "swollen"])
def test_a_plate_that_both_cameras_show_at_one_instant_is_left_alone(change: str) -> None:
    cameras, xyz = facing_pair(), plate()
    after = {
        "none": xyz, "nearer": xyz - np.array([0.0, 0.0, 5.0]), "warmer": 1.004 * xyz,
        "longer": xyz * np.array([0.997, 1.01, 1.0]),
        "swollen": xyz - [0, 0, 3.0] + np.outer(np.cos(xyz[:, 1] / 40.0), [0, 0, -2.0]),
    }[change]  # fmt: skip
    before = measured(cameras, xyz, xyz)
    assert two_instants(cameras, before, measured(cameras, after, after), STEP) is None
