"""What all renderers share: the room behind the bodies, the light on a surface, the direction of a pixel's ray."""

from __future__ import annotations

import math
import zlib
from pathlib import Path

import numba as nb

from ringdic_node.virtual_rig.texture import covered

# The key under which compiled kernels are kept on disk includes this stamp, so they are rebuilt when any file of the
# renderer changes (numba itself looks at this file alone).
STAMP = zlib.crc32(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.rglob("*.py"))))
WHITE, BLACK, SKIN = 0.80, 0.05, 0.30  # reflectance times exposure


@nb.njit(nogil=True)
def room_radiance(o, d, per):  # type: ignore[no-untyped-def]
    """Radiance of the background: a dark room with rings of LED strips at the cameras' radius.

    o, d : origin of the ray in the world, mm, and its direction. per : width of a pixel at distance 1.
    """
    a = d[0] * d[0] + d[1] * d[1]
    b = o[0] * d[0] + o[1] * d[1]
    c = o[0] * o[0] + o[1] * o[1] - 380.0 * 380.0
    t = (-b + math.sqrt(max(b * b - a * c, 0.0))) / a
    h = o[2] + t * d[2]
    arc = 380.0 * math.atan2(o[1] + t * d[1], o[0] + t * d[0])
    wide = t * per
    value = 0.010 + 0.00002 * max(0.0, 300.0 - abs(h - 60.0))
    value += 0.02 * (1.0 - covered(-40.0 - h, wide)) * (1.0 + 0.3 * math.sin(0.35 * h + 0.02 * arc))
    for centre in (-12.0, 40.0, 150.0, 165.0, 215.0):
        off = abs(h - centre)
        if off > 50.0:
            continue
        value += 0.03 / (1.0 + (max(off - 5.0, 0.0) / 6.0) ** 2)
        lamp = covered(off - 3.0, wide) * covered(-0.6 - math.sin(0.9 * arc), 0.9 * wide)
        value = max(value, covered(off - 5.0, wide) * (0.75 + 0.35 * lamp))
    return value


@nb.njit(nogil=True)
def brightness(cosine):  # type: ignore[no-untyped-def]
    """Brightness of a white surface lit from all sides. cosine : of the angle between its normal and the ray."""
    return 0.40 + 0.60 * cosine


@nb.njit(nogil=True)
def to_world(R, x, y, d):  # type: ignore[no-untyped-def]
    """Write the direction (x, y, 1) of the camera's frame, turned to the world frame, to d. R : world to camera."""
    for i in range(3):
        d[i] = R[0, i] * x + R[1, i] * y + R[2, i]
