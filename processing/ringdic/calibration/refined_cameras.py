"""Cameras that move between the steps: their poses found again at each step from the points that all of them follow.

Only where three cameras and more see a point do lines of sight tell the motion of one from that of the surface: of two
cameras, what moves a match along the epipolar line looks like depth. A motion of all cameras together cannot be told
from ringdic.arrays import Floats
from one of the body; the least motion that fits is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ringdic.arrays import Floats
from ringdic.calibration.pose_refinement import Refinement, refine_poses
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import reprojection_residuals, triangulate

#: Mean residual of a camera beyond which one has moved, px; of thousands of points it is known to a tenth of that.
LIMIT = 0.03


@dataclass
class RefinedCameras:
    """The cameras of a rig, and where they stood at the steps at which they were seen to have moved.

    cameras : as calibrated. found : by step.
    """

    cameras: Sequence[Camera]
    found: dict[int, Refinement] = field(default_factory=dict)

    def __call__(self, step: int, px: Floats, sigma: Floats) -> Sequence[Camera]:
        """The cameras of a step, by the points that they saw: px, sigma (C, n, 2), NaN where a camera did not."""
        residuals = reprojection_residuals(self.cameras, triangulate(self.cameras, px), px)
        count = np.isfinite(residuals[..., 0]).sum(axis=1)
        mean = np.nansum(residuals, axis=1) / np.maximum(count, 1)[:, None]
        if not (np.linalg.norm(mean, axis=1) > LIMIT).any():
            return self.cameras
        try:
            refined = refine_poses(self.cameras, px, sigma)
        except ComputationError:  # too few points are left: the step is as good as its cameras
            return self.cameras
        self.found[step] = refined
        return refined.cameras

    def figures(self, steps: Sequence[str]) -> list[dict[str, Any]]:
        """Each step with moved cameras, as JSON values: residuals before and after, px, and turns and shifts."""
        rows = []
        for step, refined in sorted(self.found.items()):
            turn, shift = (np.linalg.norm(part, axis=1) for part in np.split(refined.motion, 2, axis=1))
            rows.append(
                {
                    "step": steps[step],
                    "before_px": float(np.nanmax(refined.before)),
                    "after_px": float(np.nanmax(refined.after)),
                    "cameras": {
                        camera.id: {"turn_deg": float(np.degrees(turn[k])), "shift_mm": float(shift[k])}
                        for k, camera in enumerate(self.cameras)
                    },
                }
            )
        return rows

    def sentences(self, steps: Sequence[str]) -> list[str]:
        """What the operator should know: where cameras moved."""
        rows = self.figures(steps)
        if not rows:
            return []
        worst = max(rows, key=lambda row: row["before_px"])
        return [
            f"cameras moved since the reference in {', '.join(row['step'] for row in rows)}: lines of sight missed one "
            f"another by up to {worst['before_px']:.2f} px ({worst['step']}), {worst['after_px']:.2f} px after the "
            "poses were refined there; fix the cameras"
        ]
