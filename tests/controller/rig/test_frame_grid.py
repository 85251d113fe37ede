"""The common frame grid of sensors that run freely, from all cameras."""

from __future__ import annotations

import pytest
from ringdic_controller.rig import capture as round_
from ringdic_controller.rig.capture import MS, SECOND, CaptureRound, Timing
from ringdic_controller.rig.clocks import NodeTiming
from ringdic_controller.rig.frame_grid import FrameTiming, common_grid, frame_timing, off_grid
from ringdic_node.wire import ArmReply

PERIOD = 100 * MS


def frames(**phases_ms: float) -> dict[str, FrameTiming]:
    """Cameras whose newest frames are of different times, a second apart, at these phases."""
    return {
        camera: FrameTiming(k * SECOND + round(phase * MS), PERIOD)
        for k, (camera, phase) in enumerate(phases_ms.items())
    }


def test_the_grid_lies_amid_all_cameras_wherever_the_first_one_is():
    grid = common_grid(frames(a=0.3, b=-0.1, c=0.1), MS)
    assert grid.time_ns % PERIOD == pytest.approx(0.1 * MS, abs=1)
    assert grid.spread_ns == pytest.approx(0.4 * MS, abs=2)
    assert grid.off == ()


def test_a_phase_about_the_end_of_the_period_is_one_phase():
    grid = common_grid(frames(a=99.8, b=0.2, c=50.0, d=0.0), MS)
    assert (grid.time_ns + MS) % PERIOD == pytest.approx(MS, abs=2)
    assert grid.off == ("c",)


@pytest.mark.parametrize("odd", ["a", "b", "d"])
def test_a_camera_elsewhere_is_named_and_does_not_draw_the_grid(odd):
    phases = {"a": 0.1, "b": 0.0, "c": -0.1, "d": 0.05, odd: 33.0}
    grid = common_grid(frames(**phases), MS)
    assert grid.off == (odd,)
    assert abs((grid.time_ns + PERIOD // 2) % PERIOD - PERIOD // 2) < 0.2 * MS
    assert f"camera {odd} by +33.0" in off_grid(grid).replace("+32.9", "+33.0").replace("+33.1", "+33.0")


def test_the_first_frame_after_a_moment_is_on_the_grid():
    grid = common_grid({"a": FrameTiming(7 * SECOND + 30 * MS, PERIOD)})
    assert grid.at_or_after(5 * SECOND) == 5 * SECOND + 30 * MS
    assert grid.at_or_after(5 * SECOND + 30 * MS) == 5 * SECOND + 30 * MS
    assert grid.at_or_after(9 * SECOND + 31 * MS) == 9 * SECOND + 130 * MS


@pytest.mark.parametrize("period", [0, -5, 10**13])
def test_an_impossible_period_is_no_grid(period):
    assert frame_timing(5, period, 0) is None
    assert common_grid({}) is None


def test_a_round_fires_on_the_grid_of_all_cameras_by_the_controllers_clock():
    """Three nodes whose clocks are off by up to an hour; the first one's frames are 0.6 ms from the others'."""
    start = 1_000 * SECOND
    machine = CaptureRound(["a", "b", "c"], Timing(), start, tolerance=MS)
    opened = []
    for camera, phase in (("a", 0.6), ("b", 0.0), ("c", 0.0)):
        offset = ord(camera) * 37 * SECOND
        frame = start + round((20 + phase) * MS)
        reply = ArmReply(camera, True, "0" * 64, frame_time_ns=frame + offset - 50 * PERIOD, frame_period_ns=PERIOD)
        timing = NodeTiming(0, offset, MS // 10, FrameTiming(frame, PERIOD) if camera != "c" else None)
        opened += machine.handle(round_.ArmAnswered(reply, timing), start)
    (opening,) = (action for action in opened if isinstance(action, round_.OpenCapture))
    assert (opening.fire_at_ns - start - 20 * MS) % PERIOD == pytest.approx(0.2 * MS, abs=2)
    assert opening.fire_at_ns >= start + Timing().lead
    assert opening.grid.to_json()["deviations_ns"] == {
        "a": pytest.approx(0.4 * MS, abs=2), "b": pytest.approx(-0.2 * MS, abs=2), "c": pytest.approx(-0.2 * MS, abs=2)
    }  # fmt: skip
