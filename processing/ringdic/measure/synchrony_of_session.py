"""Synchrony of a processed session: the optical time offsets of its cameras beside those that the nodes stamped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Pixels
from ringdic.errors import InputError
from ringdic.measure.synchrony import TimeOffsets, time_offsets
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.session.folder import newest_results, open_session
from ringdic.session.records import CaptureRecord

_MOST = 6000  # points of which the tracks are read


@dataclass(frozen=True)
class SynchronyReport:
    """Optical offsets of C cameras, and the offsets of the times that their nodes stamped.

    stamped : (C,) seconds, mean over the steps, from the mean of all cameras; NaN where a camera has no stamps.
    """

    offsets: TimeOffsets
    stamped: Floats

    def to_json(self) -> dict[str, Any]:
        """The report as JSON values, times in ms; null where a camera has no stamps."""
        report = self.offsets.to_json()
        for id_, stamp in zip(self.offsets.cameras, self.stamped, strict=True):
            report["cameras"][id_]["stamped_ms"] = None if np.isnan(stamp) else float(1e3 * stamp)
        return report

    def lines(self) -> list[str]:
        """The report as lines of text."""
        found = self.offsets
        head = (
            f"{found.points} points at {found.steps} steps; offsets from the mean of the {len(found.cameras)} cameras"
        )
        return [head, *(self._line(k) for k in range(len(found.cameras)))]

    def _line(self, k: int) -> str:
        offset, sigma, stamp = 1e3 * self.offsets.offset[k], 1e3 * self.offsets.sigma[k], 1e3 * self.stamped[k]
        line = f"camera {self.offsets.cameras[k]}: exposes {offset:+.2f} ± {sigma:.2f} ms"
        if np.isnan(stamp):
            return line
        differs = abs(offset - stamp) > 3 * sigma + 0.5
        return f"{line}, stamped {stamp:+.2f} ms" + (": the stamps are wrong" if differs else "")


def session_synchrony(session: Path, run: int | None = None, period_s: float | None = None) -> SynchronyReport:
    """Measure the synchrony of a processed session's cameras from its specimen captures.

    The body rests at the first capture, and moves smoothly through the others.

    Parameters
    ----------
    session : its folder.
    run : number of the processing run; None takes the newest.
    period_s : time from one step to the next, s, for imported images; None takes the captures' planned moments.

    Raises
    ------
    InputError
        The session has no results, or its captures have no times and no period is given.
    ComputationError
        The tracks do not tell.
    """
    results = read_results(newest_results(session, run))
    records = {capture.id: capture.record for capture in open_session(session).captures}
    steps = [records[name] for name in results.steps if name in records]
    if len(steps) < len(results.steps):
        raise InputError(f"{session}: not every step of the results has its capture any more; process it again")
    times = _times(session, steps, period_s)
    ids = [camera.id for camera in results.cameras]
    px, sigma = _tracks(results)
    offsets = time_offsets(results.cameras, px, sigma, times, _row_times(steps, ids))
    return SynchronyReport(offsets, _stamped(steps, ids))


def _times(session: Path, steps: Sequence[CaptureRecord], period_s: float | None) -> Floats:
    if period_s is not None:
        return period_s * np.arange(len(steps), dtype=float)
    planned = [record.fire_at_ns for record in steps]
    if any(moment is None for moment in planned):
        raise InputError(f"{session}: imported images have no times; give the time between steps with --period")
    first = planned[0] or 0
    return np.array([((moment or 0) - first) / 1e9 for moment in planned])


def _tracks(results: Results) -> tuple[Pixels, Pixels]:
    """Tracks (F, C, n, 2) px of some vertices in all cameras, and their standard deviations; NaN for none."""
    index = {camera.id: c for c, camera in enumerate(results.cameras)}
    alone = [each for each in results.matches if len(each.cameras) == 1]
    if len(alone) < 2:
        raise InputError(
            "the results hold no tracks of single cameras; process the session with surface.method = global"
        )
    views = np.zeros(len(results.vertices_ref), dtype=int)
    for each in alone:
        known = (each.vertex >= 0) & np.isfinite(each.px).all(axis=(0, 1, 3))
        views[each.vertex[known]] += 1
    shared = np.flatnonzero(views >= 2)
    chosen = shared[np.linspace(0, len(shared) - 1, min(len(shared), _MOST)).astype(int)] if len(shared) else shared
    place = np.full(len(views), -1)
    place[chosen] = np.arange(len(chosen))
    out = np.full((2, len(results.steps), len(index), len(chosen), 2), np.nan)
    for each in alone:
        at = np.where(each.vertex >= 0, place[each.vertex], -1)
        used, c = at >= 0, index[each.cameras[0]]
        out[0][:, c, at[used]], out[1][:, c, at[used]] = each.px[:, 0, used], each.sigma[:, 0, used]
    return out[0], out[1]


def _row_times(steps: Sequence[CaptureRecord], ids: Sequence[str]) -> Floats | None:
    """Seconds from row to row of each camera, (C,); None where all shutters are global or unknown."""
    rows = [next((r.cameras[id_].row_time_ns for r in steps if id_ in r.cameras), None) for id_ in ids]
    if not any(rows):
        return None
    return np.array([(each or 0.0) / 1e9 for each in rows])


def _stamped(steps: Sequence[CaptureRecord], ids: Sequence[str]) -> Floats:
    """Mean offsets (C,) s of the stamped times from the mean of all cameras, over the steps after the first."""
    late = np.full((len(steps), len(ids)), np.nan)
    for f, record in enumerate(steps):
        for c, id_ in enumerate(ids):
            entry = record.cameras.get(id_)
            if entry is not None and entry.time_ns is not None and record.fire_at_ns is not None:
                late[f, c] = (entry.time_ns - record.fire_at_ns) / 1e9
    late = late[1:]
    counts = np.isfinite(late).sum(axis=0)
    means = np.where(counts > 0, np.nansum(late, axis=0) / np.maximum(counts, 1), np.nan)
    known = np.isfinite(means)
    return means - (means[known].mean() if known.any() else 0.0)
