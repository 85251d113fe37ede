"""Times of exposure that are known, recovered from the tracks of a moving body with true standard deviations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from ringdic.arrays import Floats
from ringdic.calibration.parameters import CameraParameters
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Camera
from ringdic.measure import synchrony_of_session
from ringdic.measure.synchrony import TimeOffsets, time_offsets
from ringdic.session.records import CameraRecord, CaptureRecord
from scipy.spatial.transform import Rotation

TIMES = np.concatenate([[0.0], 3.0 + 0.6 * np.arange(7)])
FOCAL, FAR, NOISE = 1500.0, 400.0, 0.03
ROW = 20e-6


def ring(count: int, random: np.random.Generator | None = None) -> list[Camera]:
    """Cameras that look at the origin from an arc, each calibrated wrongly by 0.1 mrad and 0.05 mm if ``random``."""
    cameras = []
    for k, azimuth in enumerate(np.linspace(-35.0, 35.0, count)):
        out = Rotation.from_euler("z", azimuth, degrees=True).apply([1.0, 0.0, 0.0])
        down = np.array([0.0, 0.0, -1.0])
        R = np.stack([np.cross(down, -out), down, -out])
        t = -R @ (FAR * out)
        if random is not None:
            R = Rotation.from_rotvec(random.normal(0, 1e-4, 3)).as_matrix() @ R
            t = t + random.normal(0, 0.05, 3)
        P = np.array([[FOCAL, 0, 500], [0, FOCAL, 400], [0, 0, 1.0]]) @ np.column_stack([R, t])
        cameras.append(Camera(f"{k + 1}", P / P[2, 3], (1000, 800)))
    return cameras


def body(n: int, random: np.random.Generator) -> Floats:
    angle, z = random.uniform(-0.4, 0.4, n), random.uniform(-40, 40, n)
    return np.stack([50 * np.cos(angle), 50 * np.sin(angle), z], axis=1)


def moved(points: Floats, t: Floats) -> Floats:
    """The points (n, 3) at times (n,) s: at rest until 1 s, then swinging and turning slowly."""
    phase = np.where(t > 1.0, 0.7 * (t - 1.0), 0.0)[:, None]
    turned = Rotation.from_rotvec(phase * [0.02, 0.03, 0.15]).apply(points)
    return turned + np.sin(phase) * [3.0, 12.0, 8.0] + (1 - np.cos(2 * phase)) * [1.0, -3.0, 2.0]


def tracked(offsets: Floats, seed: int, rolling: bool = False) -> tuple[list[Camera], Floats, Floats]:
    """Cameras as calibrated, points (n, 3), and tracks by cameras that expose so much later than planned, s."""
    random = np.random.default_rng(seed)
    true, calibrated = ring(len(offsets)), ring(len(offsets), random)
    points = body(300, random)
    px = np.empty((len(TIMES), len(true), len(points), 2))
    for f, time in enumerate(TIMES):
        for c, camera in enumerate(true):
            t = np.full(len(points), time + offsets[c])
            px[f, c] = camera.project(moved(points, t))
            if rolling:
                for _ in range(3):  # each row sees the body at its own time
                    t = time + offsets[c] + ROW * (px[f, c, :, 1] - 400)
                    px[f, c] = camera.project(moved(points, t))
            px[f, c] += random.normal(0, NOISE, (len(points), 2))
    # As the results have it: tracked from where the calibrated cameras show the points at rest.
    at_rest = np.stack([camera.project(points) for camera in calibrated])
    px += at_rest - px[0] + random.normal(0, 1e-9, px.shape)
    hidden = random.random(px.shape[1:3]) < 0.2
    px[:, hidden] = np.nan
    return calibrated, points, px


def seen(offsets: Floats, seed: int, rolling: bool = False) -> TimeOffsets:
    """What is found of cameras that expose so much later than planned, s."""
    cameras, _, px = tracked(offsets, seed, rolling)
    return time_offsets(cameras, px, np.hypot(NOISE, NOISE), TIMES, np.full(len(cameras), ROW) if rolling else None)


@pytest.mark.parametrize("rolling", [False, True], ids=["global shutter", "rolling shutter"])
def test_offsets_of_up_to_30_ms_are_recovered_to_half_a_millisecond_with_a_true_sigma(rolling):
    pulls = []
    for seed in range(6):
        offsets = np.random.default_rng(100 + seed).uniform(0.0, 0.030, 5)
        found = seen(offsets, seed, rolling)
        error = found.offset - (offsets - offsets.mean())
        assert np.abs(error).max() < 0.5e-3
        assert found.sigma.max() < 0.5e-3
        pulls.append(error / found.sigma)
    rms = np.sqrt(np.mean(np.square(pulls)))
    assert 0.5 < rms < 1.5, "the errors are as large as is stated"


def test_a_single_camera_that_is_late_is_told_from_the_others():
    found = seen(np.array([0.0, 0.0, 0.008, 0.0]), 3)
    report = found.to_json()["cameras"]
    assert report["3"]["offset_ms"] == pytest.approx(6.0, abs=0.5)
    assert all(report[id_]["offset_ms"] == pytest.approx(-2.0, abs=0.5) for id_ in ("1", "2", "4"))


@pytest.fixture
def session(monkeypatch):
    """A processed session whose third camera exposes 12 ms late, of which its node stamps 4 ms."""
    cameras, points, px = tracked(np.array([0.0, 0.0, 0.012, 0.0]), 5)
    fire = [round(1e9 * time) for time in TIMES]
    steps = [f"{f + 1:04d}-specimen" for f in range(len(fire))]
    records = [
        CaptureRecord(
            name, f + 1, "specimen", "s", "closed", fire_at_ns=at,
            cameras={c.id: CameraRecord("ok", time_ns=at + 4_000_000 * (c.id == "3")) for c in cameras},
        )
        for f, (name, at) in enumerate(zip(steps, fire, strict=True))
    ]  # fmt: skip
    matches = [
        SimpleNamespace(
            cameras=(c.id,), vertex=np.arange(len(points)), px=px[:, [k]], sigma=np.full_like(px[:, [k]], 0.04)
        )
        for k, c in enumerate(cameras)
    ]
    results = SimpleNamespace(cameras=cameras, steps=steps, vertices_ref=points, matches=matches)
    captures = [SimpleNamespace(id=record.capture_id, record=record) for record in records]
    monkeypatch.setattr(synchrony_of_session, "newest_results", lambda session, run: session)
    monkeypatch.setattr(synchrony_of_session, "read_results", lambda path: results)
    monkeypatch.setattr(synchrony_of_session, "open_session", lambda path: SimpleNamespace(captures=captures))
    return captures


def test_a_session_tells_which_stamps_are_wrong(session):
    report = synchrony_of_session.session_synchrony(Path("s"))
    wrong = [line for line in report.lines() if line.endswith("the stamps are wrong")]
    assert [line.split(":")[0] for line in wrong] == ["camera 1", "camera 2", "camera 3", "camera 4"]
    third = report.to_json()["cameras"]["3"]
    assert third["offset_ms"] == pytest.approx(9.0, abs=0.5)
    assert third["stamped_ms"] == pytest.approx(3.0, abs=1e-6)


def test_imported_images_need_the_time_between_their_steps(session):
    for capture in session:
        capture.record = replace(capture.record, fire_at_ns=None)
    with pytest.raises(InputError, match="--period"):
        synchrony_of_session.session_synchrony(Path("s"))
    report = synchrony_of_session.session_synchrony(Path("s"), period_s=0.6)
    assert report.to_json()["cameras"]["3"]["offset_ms"] == pytest.approx(9.0, abs=0.5)
    assert report.to_json()["cameras"]["3"]["stamped_ms"] is None


def test_a_body_at_rest_few_steps_and_few_points_are_refused_with_what_to_do():
    cameras = ring(3)
    points = body(100, np.random.default_rng(0))
    still = np.broadcast_to(np.stack([camera.project(points) for camera in cameras]), (8, 3, 100, 2))
    with pytest.raises(ComputationError, match=r"moves by 0\.0 px/s"):
        time_offsets(cameras, still, 0.03, TIMES)
    with pytest.raises(ComputationError, match="4 steps are too few"):
        time_offsets(cameras, still[:4], 0.03, TIMES[:4])
    lost = still.copy()
    lost[3, 1:] = np.nan
    with pytest.raises(ComputationError, match="0 points are tracked"):
        time_offsets(cameras, lost, 0.03, TIMES)


def test_the_true_cameras_are_the_calibrated_ones_but_for_a_small_motion():
    one, other = (CameraParameters.of(camera) for camera in (ring(3)[1], ring(3, np.random.default_rng(0))[1]))
    assert 0 < np.abs(one.rotation - other.rotation).max() < 1e-3
