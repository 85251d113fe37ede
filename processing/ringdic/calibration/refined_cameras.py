"""Refinement of the poses at steps at which cameras have moved, from the points that are tracked in all cameras.

Three cameras or more must see a point for the motion of one of them to be separated from that of the surface: with two
cameras, a motion that shifts matches along the epipolar lines looks like a change of depth. A common motion of all
cameras cannot be separated from a rigid motion of the body; the smallest motion that fits is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ringdic.arrays import Pixels
from ringdic.calibration.pose_refinement import PoseRefinement, refine_poses
from ringdic.errors import ComputationError
from ringdic.findings import Finding
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import reprojection_residuals, triangulate

#: Mean reprojection residual beyond which a camera has moved, px; thousands of points give it to a tenth of that.
LIMIT = 0.03


@dataclass
class RefinedCameras:
    """The cameras of a rig at every step, with refined poses where they have moved since the calibration.

    cameras : as calibrated. refinements : by step, for the steps at which a camera has moved.
    """

    cameras: Sequence[Camera]
    refinements: dict[int, PoseRefinement] = field(default_factory=dict)

    def __call__(self, step: int, px: Pixels, sigma: Pixels) -> Sequence[Camera]:
        """The cameras of a step: as calibrated, or with refined poses where one has moved.

        px, sigma : (C, n, 2) px, points tracked in the cameras and their standard deviations, NaN where not seen.
        """
        residuals = reprojection_residuals(self.cameras, triangulate(self.cameras, px), px)
        count = np.isfinite(residuals[..., 0]).sum(axis=1)
        mean = np.nansum(residuals, axis=1) / np.maximum(count, 1)[:, None]
        if not (np.linalg.norm(mean, axis=1) > LIMIT).any():
            return self.cameras
        try:
            refined = refine_poses(self.cameras, px, sigma)
        except ComputationError:  # too few points for a refinement
            return self.cameras
        self.refinements[step] = refined
        return refined.cameras

    def figures(self, steps: Sequence[str]) -> list[dict[str, Any]]:
        """Residuals (px), rotations and translations at the steps at which cameras had moved, as JSON values.

        steps : names of all steps.
        """
        rows = []
        for step, refined in sorted(self.refinements.items()):
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

    def findings(self, steps: Sequence[str]) -> list[Finding]:
        """A finding that names the steps at which cameras had moved; empty where none moved."""
        rows = self.figures(steps)
        if not rows:
            return []
        worst = max(rows, key=lambda row: row["before_px"])
        sentence = (
            f"cameras moved since the reference in {', '.join(row['step'] for row in rows)}: lines of sight missed one "
            f"another by up to {worst['before_px']:.2f} px ({worst['step']}), {worst['after_px']:.2f} px after the "
            "poses were refined there; fix the cameras"
        )
        ids = tuple(camera.id for camera in self.cameras)
        return [Finding("camera-moved", sentence, ids, worst["step"], worst["before_px"], LIMIT, "px")]
