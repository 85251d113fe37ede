"""The paper's ring: twelve IMX219 in portrait on a circle of 700 mm diameter (Solav et al. 2018, Table 1)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ringdic_node.virtual_rig.arrays import Floats
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.rotation import rotation

WIDTH, HEIGHT = 2464, 3280  # px, portrait
RING_RADIUS = 350.0  # mm
FACING = 45.0  # degrees, azimuth of the middle of an arc of cameras
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
    """The cameras of a simulated rig, in the order of the ring.

    pairs : ids of the camera pairs as rig.toml lists them; empty leaves the neighbours to be pairs.
    """

    cameras: tuple[VirtualCamera, ...]
    pairs: tuple[tuple[str, str], ...] = ()

    def rig_toml(self) -> str:
        """Text of ``rig.toml`` as a laboratory would write it: target, board, nominal azimuths, but no true poses."""
        entries = [f'\n[[cameras]]\nid = "{c.id}"\nazimuth_deg = {c.azimuth_deg:.1f}\n' for c in self.cameras]
        listed = ", ".join(f'["{first}", "{second}"]' for first, second in self.pairs)
        return _HEADER + "".join(entries) + (f"\n[pairs]\npairs = [{listed}]\n" if self.pairs else "")


def paper_rig(cameras: int = 12, scale: float = 1.0, seed: int = 0) -> VirtualRig:
    """A ring with the paper's geometry, whose cameras scatter about it as real ones do.

    Intrinsics scatter as in Table 1, but for two: k2 by a fifth of its standard deviation there, because the
    estimates of k2 and k3 compensate each other; k3 about 0, because the mean of Table 1 (-0.19 ± 0.45) would fold the
    corners of the image over. Positions scatter by 3 mm, viewing directions by 1.5°.

    cameras : their number. scale : of the images, 1 is 2464 x 3280 px. seed : of the scatter.
    """
    return VirtualRig(_cameras([_Place(360.0 * i / cameras) for i in range(cameras)], scale, seed))


def arc_rig(cameras: int = 4, spacing_deg: float = 30.0, scale: float = 1.0, seed: int = 0) -> VirtualRig:
    """An arc of the paper's ring about the azimuth ``FACING``, its cameras ``spacing_deg`` apart.

    cameras, scale, seed : as of `paper_rig`.
    """
    first = FACING - 0.5 * spacing_deg * (cameras - 1)
    return VirtualRig(_cameras([_Place((first + i * spacing_deg) % 360.0) for i in range(cameras)], scale, seed))


def two_row_rig(ring: int = 12, above: int = 6, scale: float = 1.0, seed: int = 0) -> VirtualRig:
    """The paper's ring and a second row of cameras that look down at 33°, so that a body's upper end is seen.

    Pairs are the neighbours in each row, and each upper camera with the nearest one of the ring. ring, above : numbers
    of cameras in the rows. scale, seed : as of `paper_rig`.
    """
    places = [_Place(360.0 * i / ring) for i in range(ring)]
    places += [_Place((FACING + 360.0 * i / above) % 360.0, *_ABOVE) for i in range(above)]
    cameras = _cameras(places, scale, seed)
    rows = (cameras[:ring], cameras[ring:])
    pairs = [(row[i].id, row[(i + 1) % len(row)].id) for row in rows for i in range(len(row))]
    for camera in rows[1]:
        below = min(rows[0], key=lambda other: abs((other.azimuth_deg - camera.azimuth_deg + 180.0) % 360.0 - 180.0))
        pairs.append((below.id, camera.id))
    return VirtualRig(cameras, tuple(pairs))


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


@dataclass(frozen=True)
class _Place:
    """Where a camera stands, and the height on the axis that it looks at: azimuth in degrees, lengths in mm."""

    azimuth: float
    distance: float = RING_RADIUS
    height: float = _HEIGHT_OF_RING
    looks_at: float = _HEIGHT_OF_RING


#: Of a second row: 385 mm from the target's axis at 140 mm, looking down at 33°.
_ABOVE = (322.9, 349.7, 140.0)


def _cameras(places: Sequence[_Place], scale: float, seed: int) -> tuple[VirtualCamera, ...]:
    if len(places) < 2:
        raise ValueError(f"a ring needs at least 2 cameras, not {len(places)}")
    if not 0.05 <= scale <= 1.0:
        raise ValueError(f"the scale must lie between 0.05 and 1, not {scale}")
    rng = np.random.default_rng([seed, 20180])
    return tuple(_camera(i, place, scale, rng) for i, place in enumerate(places))


def _camera(i: int, place: _Place, scale: float, rng: np.random.Generator) -> VirtualCamera:
    fx, fy = rng.normal(2611.7, 5.8), rng.normal(2615.4, 5.6)
    cx, cy, skew = rng.normal(1246.5, 34.5), rng.normal(1627.7, 16.9), rng.normal(-1.37, 0.37)
    k1, k2, k3 = rng.normal(0.179, 0.018), rng.normal(-0.295, 0.033), rng.normal(0.0, 0.03)
    p1, p2 = rng.normal(1.5e-4, 2.3e-4), rng.normal(6.8e-4, 6.6e-4)
    a = math.radians(place.azimuth)
    centre = np.array([place.distance * math.cos(a), place.distance * math.sin(a), place.height])
    centre += rng.normal(0, 3.0, 3)
    R = rotation(rng.normal(0, math.radians(1.5), 3)) @ _looking_at(centre, np.array([0.0, 0.0, place.looks_at]))
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
        azimuth_deg=place.azimuth,
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
