"""Detection of cameras that moved, by the mean distance of matches from their epipolar lines, step by step.

Matches between cameras that stand still lie on their epipolar lines in the mean. A mean distance at the reference step
shows a motion between calibration and reference; what is added at later steps shows a motion since.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ringdic.arrays import Floats
from ringdic.findings import Finding

#: Mean distance from the epipolar lines beyond which a camera has moved, px.
LIMIT = 0.1


def drift_findings(drift: Mapping[str, Floats], steps: Sequence[str], limit: float = LIMIT) -> tuple[Finding, ...]:
    """Findings that name the cameras that moved before or after the reference step; empty where none moved.

    drift : for each camera or pair (F,) px, signed mean distance from the epipolar line at each step, NaN where not
    measured. steps : F names. limit : px.
    """
    measured = {who: values for who, values in drift.items() if len(values)}
    before = {who: float(values[0]) for who, values in measured.items() if abs(values[0]) > limit}
    since = {who: values - np.nan_to_num(values[0]) for who, values in measured.items()}
    later = {who: values for who, values in since.items() if np.any(np.abs(values) > limit)}
    findings = []
    if before:
        worst = max(before, key=lambda who: abs(before[who]))
        sentence = (
            f"cameras {', '.join(before)}: at the reference matches lie off the epipolar line by up to "
            f"{before[worst]:+.2f} px in the mean ({worst}); a camera moved after the calibration, or the board views "
            "do not fit the target: fix the cameras and calibrate again"
        )
        findings.append(_finding(sentence, before, steps[0], before[worst], limit))
    if later:
        worst = max(later, key=lambda who: float(np.nanmax(np.abs(later[who]))))
        step = int(np.nanargmax(np.abs(later[worst])))
        sentence = (
            f"cameras {', '.join(later)}: matches drift off the epipolar line, by {later[worst][step]:+.2f} px in the "
            f"mean in {steps[step]} ({worst}); a camera moves between the steps: fix it, and take the displacements of "
            "such steps as good to that"
        )
        findings.append(_finding(sentence, later, steps[step], float(later[worst][step]), limit))
    return tuple(findings)


def _finding(sentence: str, cameras: Iterable[str], step: str, value: float, limit: float) -> Finding:
    return Finding("camera-drift", sentence, tuple(cameras), step, value, limit, "px")
