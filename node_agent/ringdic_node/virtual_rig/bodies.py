"""Solid bodies of known form, by name: plates, boxes, rods and bodies like limbs, standing where the target stood.

Bodies with a front turn it to the azimuth ``FACING``, the middle of an arc of cameras.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ringdic_node.virtual_rig.rig import FACING
from ringdic_node.virtual_rig.scenes.solid import MIDDLE, Solid
from ringdic_node.virtual_rig.solid import BOX, BRANCHES, COLUMN

_FRONT = math.radians(FACING)
_TARGET_RADIUS = 57.0  # mm
_BAND = (-120.0, 120.0)  # mm, of speckles on a body that is longer
_NEVER = 1e6


def solid_bodies() -> Mapping[str, Callable[[], Solid]]:
    """Functions that make the bodies, by name.

    ``plate-tangent``  150 x 210 mm, in the plane that touches the target in front
    ``plate-axis``     150 x 210 mm, through the target's axis
    ``box-90``         90 x 90 x 200 mm, edges rounded to 8 mm, turned by 20° from facing
    ``box-100``        a cube of 100 mm, edges rounded to 8 mm, turned by 45°: an edge faces
    ``rod-20`` ``rod-30`` ``rod-75``  of these radii, 220 mm high
    ``cone``           radius 70 to 30 mm
    ``bean``           a section with a hollow in front
    ``hourglass``      radius 62 mm, 38 at the waist
    ``limb``           a calf, 50 to 66 mm
    ``limb-tilted``    tilted by 15° and shifted by 40 mm
    ``foot``           a lower leg and a foot, bent at the ankle
    ``stump``          a residual limb with a closed, rounded upper end
    ``two-rods``       rods of radius 30 and 22 mm, 75 mm apart
    """
    return {
        "plate-tangent": lambda: _plate(_TARGET_RADIUS),
        "plate-axis": lambda: _plate(0.0),
        "box-90": lambda: rounded_box((90.0, 90.0, 200.0), 8.0, FACING + 20.0),
        "box-100": lambda: rounded_box((100.0, 100.0, 100.0), 8.0, FACING + 45.0),
        "rod-20": lambda: upright_column(20.0),
        "rod-30": lambda: upright_column(30.0),
        "rod-75": lambda: upright_column(75.0),
        "cone": lambda: upright_column(50.0, slope=-20.0 / 110.0),
        "bean": lambda: upright_column(52.0, dent=(-16.0, 2.8, _FRONT)),
        "hourglass": lambda: upright_column(62.0, swell=(-24.0, 0.0, 55.0)),
        "limb": _limb,
        "limb-tilted": lambda: _limb((10.0, -11.18, 0.0), (35.0, -19.4, 0.0)),
        "foot": _foot,
        "stump": lambda: upright_column(
            52.0, slope=0.06, swell=(6.0, -30.0, 50.0), ends=(-260.0, 200.0), dome=(15.0, 60.0), flat=1.12
        ),
        "two-rods": _two_rods,
    }


def rounded_box(size: tuple[float, float, float], edge: float, azimuth_deg: float) -> Solid:
    """A box with rounded edges whose first side faces an azimuth.

    size : edges, mm. edge : radius of the rounding, mm.
    """
    x, y, z = (0.5 * each for each in size)
    return Solid((BOX, x, y, z, edge), (-x, -y, -z, x, y, z), turn_deg=(0.0, 0.0, azimuth_deg))


def upright_column(
    radius: float,
    slope: float = 0.0,
    swell: tuple[float, ...] = (0.0, 0.0, 1.0),
    oval: tuple[float, float] = (0.0, 0.0),
    dent: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ends: tuple[float, float] = (-110.0, 110.0),
    dome: tuple[float, float] | None = None,
    flat: float = 1.0,
) -> Solid:
    """An upright body whose radius is a function of angle and height, closed by flat ends or by a dome above.

    radius : in the middle, mm, and its slope over the height. swell : mm, its z, its width, and its share by the side
    at an angle. oval : mm and angle. dent : mm, its sharpness, its angle. ends : lowest and highest z, mm. dome : z at
    which it begins, its height, mm. flat : by which the body is thinner along y.
    """
    own = (*swell, 0.0, 0.0)[:5]
    closing = (_NEVER, 0.0) if dome is None else (dome[0], (radius + slope * (dome[0] + dome[1])) / dome[1])
    shape = (COLUMN, radius, slope, *own, *oval, *dent, *ends, *closing, flat)
    theta, z = np.meshgrid(np.linspace(0.0, 2.0 * math.pi, 181), np.linspace(*ends, 181))
    widest = (
        radius + slope * z + own[0] * np.exp(-(((z - own[1]) / own[2]) ** 2)) * (1.0 + own[3] * np.cos(theta - own[4]))
    )
    widest += oval[0] * np.cos(2.0 * (theta - oval[1])) + dent[0] * np.exp(dent[1] * (np.cos(theta - dent[2]) - 1.0))
    reach = float(widest.max()) + 0.5
    top = ends[1] if dome is None else dome[0] + 1.3 * dome[1]
    band = (max(ends[0], _BAND[0]), _BAND[1]) if ends[0] < _BAND[0] or top > 130.0 else (-_NEVER, _NEVER)
    return Solid(shape, (-reach, -reach / flat, ends[0], reach, reach / flat, top), band=band)


def branches(ends: Sequence[tuple[float, ...]], blend: float) -> Solid:
    """Rods with round ends that pass into one another over a width, mm.

    ends : of each rod, x y z and radius at one end, then at the other, mm.
    """
    shape = (BRANCHES, blend, float(len(ends)), *(value for rod in ends for value in rod))
    points = np.array(ends).reshape(-1, 4)
    low, high = (points[:, :3] - points[:, 3:]).min(axis=0) - 1.0, (points[:, :3] + points[:, 3:]).max(axis=0) + 1.0
    low, high = low - 0.2 * blend, high + 0.2 * blend
    band = (max(float(low[2]), _BAND[0]), min(float(high[2]), _BAND[1]))
    return Solid(shape, (*map(float, low), *map(float, high)), band=band)  # type: ignore[arg-type]


def _plate(distance: float) -> Solid:
    """A plate of 150 x 210 mm, 1.5 mm thick, whose front is at a distance from the axis and faces the cameras."""
    plate = rounded_box((1.5, 150.0, 210.0), 0.5, FACING)
    off = distance - 0.75
    return Solid(plate.shape, plate.box, plate.turn_deg, (off * math.cos(_FRONT), off * math.sin(_FRONT), MIDDLE[2]))


def _limb(
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0), aside: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Solid:
    calf = upright_column(54.0, 5.0 / 125.0, (6.0, 40.0, 60.0, 0.5, 2.0), oval=(1.5, 0.5), ends=(-280.0, 300.0))
    middle = (MIDDLE[0] + aside[0], MIDDLE[1] + aside[1], MIDDLE[2] + aside[2])
    return Solid(calf.shape, calf.box, turn_deg, middle, _BAND)


def _foot() -> Solid:
    """A leg that comes from above, with the heel below it and the foot towards the side of the cameras."""
    leg = (-25.0, 0.0, 260.0, 46.0, -25.0, 0.0, -40.0, 30.0)
    heel = (-25.0, 0.0, -40.0, 30.0, -38.0, 0.0, -72.0, 26.0)
    foot = (-25.0, 0.0, -62.0, 34.0, 75.0, 0.0, -80.0, 20.0)
    body = branches((leg, heel, foot), 30.0)
    return Solid(body.shape, body.box, (0.0, 0.0, FACING + 40.0), MIDDLE, body.band)


def _two_rods() -> Solid:
    x = 37.5
    body = branches(((-x, 0.0, -80.0, 30.0, -x, 0.0, 80.0, 30.0), (x, 0.0, -80.0, 22.0, x, 0.0, 80.0, 22.0)), 0.0)
    return Solid(body.shape, body.box, (0.0, 0.0, FACING + 90.0), MIDDLE, body.band)
