"""Two cameras that show different instants of a rigid body's motion, which their lines of sight alone do not tell.

Where the body moves along the line through both cameras, lines of sight still meet, but too near or too far by the same
share everywhere. In the images the body keeps its size, so it is measured to shrink as it comes nearer: by the ratio of
the distances, and without any other deformation. Nor does a camera that moved along that line show otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Points
from ringdic.findings import Finding
from ringdic.geometry.camera import Camera
from ringdic.strain.rigid_motion import kabsch

_LEAST = 0.002  # change of size that is looked at
_ALIKE = 0.25  # of it, by which it may differ from that of the distance
_REST = 0.3  # of the misfit of a rigid motion, that a change of size may leave
_FEWEST = 50  # points


def two_instants(cameras: Sequence[Camera], before: Points, after: Points, step: str) -> Finding | None:
    """The finding on a step at which a body changes its size as two cameras' distance from it; None where it does not.

    cameras : two. before, after : (n, 3) mm, points of the body at the reference and at the step, NaN where lost. step
    : its name.
    """
    common = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    if len(cameras) != 2 or common.sum() < _FEWEST:
        return None
    motion = kabsch(before[common], after[common])
    moved, there = motion.apply(before[common]), after[common]
    p, q = moved - moved.mean(axis=0), there - there.mean(axis=0)
    size = float(np.sum(p * q) / np.sum(p * p))
    rigid, rest = (float(np.sqrt(np.mean(np.sum((q - factor * p) ** 2, axis=1)))) for factor in (1.0, size))
    middle = 0.5 * (cameras[0].centre + cameras[1].centre)
    far, then = (float(np.linalg.norm(xyz[common].mean(axis=0) - middle)) for xyz in (after, before))
    change, expected = np.log(size), np.log(far / then)
    if abs(size - 1.0) < _LEAST or abs(change - expected) > _ALIKE * abs(change) or rest > _REST * rigid:
        return None
    ids = tuple(camera.id for camera in cameras)
    sentence = (
        f"{step}: the body is {100.0 * (size - 1.0):+.2f} % in size and {far - then:+.2f} mm in its distance, in the "
        f"same proportion and otherwise as rigid as at the reference: camera {' and '.join(ids)} show different "
        "instants of its motion, or one of them moved. Check that their images of this step belong together"
    )
    return Finding("instants-differ", sentence, ids, step, abs(100.0 * (size - 1.0)), 100.0 * _LEAST, "%")
