"""The common frame grid of a rig whose sensors run freely: its period and phase from all cameras. Stdlib only.

A sensor that runs freely exposes at its own times, t + k T. The moment of a capture is put on the grid that lies best
amid those of all cameras, on the controller's clock; a camera whose frames lie elsewhere is named.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import mean, median

LONGEST_PERIOD_NS = 10_000_000_000  # a longer one is no frame period


@dataclass(frozen=True)
class FrameTiming:
    """Times of a sensor that takes frames continuously: one frame's, on the controller's clock, and the period, ns."""

    time_ns: int
    period_ns: int

    def near(self, moment_ns: int) -> int:
        """Time of the frame nearest to a moment, ns."""
        frames = (2 * (moment_ns - self.time_ns) + self.period_ns) // (2 * self.period_ns)
        return self.time_ns + frames * self.period_ns


def frame_timing(time_ns: int | None, period_ns: int | None, offset_ns: int) -> FrameTiming | None:
    """The timing that a node tells, on the controller's clock; None where it tells none or an impossible period.

    time_ns : of a frame on the node's wall clock. period_ns : its period. offset_ns : of that clock from the
    controller's.
    """
    if time_ns is None or period_ns is None or not 0 < period_ns <= LONGEST_PERIOD_NS:
        return None
    return FrameTiming(time_ns - offset_ns, period_ns)


@dataclass(frozen=True)
class FrameGrid:
    """Frame grid of a rig.

    time_ns, period_ns : one of its frames, on the controller's clock, and its period. deviations_ns : by camera, from
    the grid, within half a period. tolerance_ns : deviation beyond which a camera is off the grid.
    """

    time_ns: int
    period_ns: int
    deviations_ns: Mapping[str, int] = field(default_factory=dict)
    tolerance_ns: int | None = None

    @property
    def spread_ns(self) -> int:
        """Difference between the latest and the earliest camera, ns."""
        return max(self.deviations_ns.values()) - min(self.deviations_ns.values())

    @property
    def off(self) -> tuple[str, ...]:
        """Ids of the cameras that are off the grid by more than the tolerance, or than a tenth of the period."""
        limit = self.period_ns / 10 if self.tolerance_ns is None else self.tolerance_ns
        return tuple(camera for camera, deviation in self.deviations_ns.items() if abs(deviation) > limit)

    def at_or_after(self, moment_ns: int) -> int:
        """Time of the first frame that is not before a moment, ns."""
        return self.time_ns - (self.time_ns - moment_ns) // self.period_ns * self.period_ns

    def to_json(self) -> dict[str, object]:
        """The grid as the record of a capture keeps it."""
        return {"period_ns": self.period_ns, "spread_ns": self.spread_ns, "deviations_ns": dict(self.deviations_ns)}


def common_grid(frames: Mapping[str, FrameTiming], tolerance_ns: int | None = None) -> FrameGrid | None:
    """The grid amid the frames of all cameras; None without any.

    The phase is the mean over the cameras that lie within the tolerance of the median one (the camera whose summed
    distance to the others, around the period, is least), so that one camera elsewhere does not draw the grid.
    """
    if not frames:
        return None
    period = round(median(timing.period_ns for timing in frames.values()))
    latest = max(timing.time_ns for timing in frames.values())
    near = {camera: timing.near(latest) for camera, timing in frames.items()}

    def apart(one: int, other: int) -> int:
        return (one - other + period // 2) % period - period // 2

    middle = min(near.values(), key=lambda time: sum(abs(apart(other, time)) for other in near.values()))
    limit = period / 10 if tolerance_ns is None else tolerance_ns
    shift = round(mean(apart(time, middle) for time in near.values() if abs(apart(time, middle)) <= limit))
    phase = middle + shift
    return FrameGrid(phase, period, {camera: apart(time, phase) for camera, time in near.items()}, tolerance_ns)


def off_grid(grid: FrameGrid) -> str:
    """Sentence that names the cameras whose frames lie off the grid."""
    listed = ", ".join(f"camera {camera} by {grid.deviations_ns[camera] / 1e6:+.2f} ms" for camera in grid.off)
    return (
        f"the frames of {listed} lie off the rig's frame grid of {grid.period_ns / 1e6:g} ms: these cameras expose "
        "at other moments; check that their sensors are synchronised (`sync` in node.toml)"
    )
