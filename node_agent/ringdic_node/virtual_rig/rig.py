"""The paper's ring: twelve IMX219 in portrait on a circle of 700 mm diameter (Solav et al. 2018, Table 1)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ringdic_node.virtual_rig.arrays import Floats
from ringdic_node.virtual_rig.lens import VirtualCamera

WIDTH, HEIGHT = 2464, 3280  # px, portrait
RING_RADIUS = 350.0  # mm
_HEIGHT_OF_RING = 120.0  # mm above the target's lower edge

_HEADER = """[rig]
name = "virtual-ring"

[target]
kind = "dot-cylinder"
radius_mm = 57.0
rows = 20
row_spacing_mm = 12.0
first_row_z_mm = 10.0
columns = 30
column_spacing_mm = 12.0
dot_size_mm = 4.0
dot_shape = "square"

[board]
kind = "checkerboard"
squares = [15, 20]
square_mm = 10.0
"""


@dataclass(frozen=True)
class VirtualRig:
    """The cameras of a simulated ring, in ring order."""

    cameras: tuple[VirtualCamera, ...]

    def rig_toml(self) -> str:
        """Text of ``rig.toml`` as a laboratory would write it: target, board, nominal azimuths, but no true poses."""
        entries = [f'\n[[cameras]]\nid = "{c.id}"\nazimuth_deg = {c.azimuth_deg:.1f}\n' for c in self.cameras]
        return _HEADER + "".join(entries)


def paper_rig(cameras: int = 12, scale: float = 1.0, seed: int = 0) -> VirtualRig:
    """A ring with the paper's geometry, whose cameras scatter about it as real ones do.

    Intrinsics scatter as in Table 1, but for two: k2 by a fifth of its standard deviation there, because the
    estimates of k2 and k3 compensate each other; k3 about 0, because the mean of Table 1 (-0.19 ± 0.45) would fold the
    corners of the image over. Positions scatter by 3 mm, viewing directions by 1.5°.

    cameras : their number. scale : of the images, 1 is 2464 x 3280 px. seed : of the scatter.
    """
    if cameras < 2:
        raise ValueError(f"a ring needs at least 2 cameras, not {cameras}")
    if not 0.05 <= scale <= 1.0:
        raise ValueError(f"the scale must lie between 0.05 and 1, not {scale}")
    rng = np.random.default_rng([seed, 20180])
    return VirtualRig(tuple(_camera(i, cameras, scale, rng) for i in range(cameras)))


def write_truth(rig: VirtualRig, folder: Path) -> Path:
    """Write the true intrinsics and poses of all cameras to ``cameras_truth.json`` in a folder; return its path."""
    entries = [
        {
            "id": c.id,
            "size": [c.width, c.height],
            "K": c.K.tolist(),
            "distortion_k1_k2_p1_p2_k3": list(c.distortion),
            "R": c.R.tolist(),
            "t": c.t.tolist(),
        }
        for c in rig.cameras
    ]
    path = Path(folder) / "cameras_truth.json"
    path.write_text(json.dumps({"frame": "X_camera = R X_world + t, mm", "cameras": entries}, indent=1))
    return path


def _camera(i: int, count: int, scale: float, rng: np.random.Generator) -> VirtualCamera:
    azimuth = 360.0 * i / count
    fx, fy = rng.normal(2611.7, 5.8), rng.normal(2615.4, 5.6)
    cx, cy, skew = rng.normal(1246.5, 34.5), rng.normal(1627.7, 16.9), rng.normal(-1.37, 0.37)
    k1, k2, k3 = rng.normal(0.179, 0.018), rng.normal(-0.295, 0.033), rng.normal(0.0, 0.03)
    p1, p2 = rng.normal(1.5e-4, 2.3e-4), rng.normal(6.8e-4, 6.6e-4)
    a = math.radians(azimuth)
    centre = np.array([RING_RADIUS * math.cos(a), RING_RADIUS * math.sin(a), _HEIGHT_OF_RING]) + rng.normal(0, 3.0, 3)
    R = _turned(rng.normal(0, math.radians(1.5), 3)) @ _looking_at(centre, np.array([0.0, 0.0, _HEIGHT_OF_RING]))
    # A pixel of the smaller image covers 1/scale pixels of the large one; its centre moves accordingly.
    K = np.array(
        [
            [fx * scale, skew * scale, (cx + 0.5) * scale - 0.5],
            [0.0, fy * scale, (cy + 0.5) * scale - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    return VirtualCamera(
        id=f"cam_{i + 1:02d}",
        azimuth_deg=azimuth,
        K=K,
        distortion=np.array([k1, k2, p1, p2, k3]),
        R=R,
        t=-R @ centre,
        width=round(WIDTH * scale),
        height=round(HEIGHT * scale),
    )


def _looking_at(centre: Floats, point: Floats) -> Floats:
    """World-to-camera rotation of an upright camera at ``centre`` that looks at ``point``."""
    forward = (point - centre) / np.linalg.norm(point - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _turned(vector: Floats) -> Floats:
    """Rotation matrix of a rotation vector, rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    S = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * S + (1 - math.cos(angle)) * (S @ S))
