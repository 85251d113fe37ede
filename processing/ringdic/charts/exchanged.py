"""Whether an image that does not match its partner's is another camera's, or mirrored: features tell.

By the calibration, lines of sight through features of two images meet, where the surface may be, for the cameras that
took the images and for hardly any others.
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Image, Pixels
from ringdic.charts.depth_map import DepthImages
from ringdic.charts.plane_sweep import DepthRange
from ringdic.correlation import prepare_current, prepare_reference
from ringdic.correlation.features import matched_features
from ringdic.geometry.triangulation import reprojection_residuals, triangulate

_MISS = 1.5  # px of the reduced images, by which lines of sight that meet pass a feature
_FEWEST = 20  # features whose lines of sight meet
_TIMES = 3.0  # times as many as with the cameras as they are

_EXCHANGED = (
    "the image of camera {0} shows what camera {1} would; the two may be exchanged: put each image where it belongs"
)
_MIRRORED = "the image of camera {0} is mirrored; turn it back"


def exchanged_or_mirrored(images: DepthImages, k: int, partner: int, space: DepthRange, least: int = 0) -> str:
    """Say where features show that an image of two cameras is another's, or mirrored; an empty text where they do not.

    images : of all cameras. k, partner : indices of the two. space : where the surface may be. least :
    number of features that must agree at least.
    """
    ids = [camera.id for camera in images.cameras]
    pictures = images.current(k).image, images.current(partner).image
    first, second = _features(images, *pictures)
    back, there = _features(images, np.ascontiguousarray(pictures[0][:, ::-1]), pictures[1])
    turned, here = _mirrored(first, pictures[0]), _mirrored(second, pictures[1])
    both = f"{_MIRRORED.format(f'{ids[k]}, like that of camera {ids[partner]},')}"
    tried = [(both, (k, partner), turned, here)]
    # Features of the turned image lie at the same pixels in an image that was mirrored before.
    tried.append((_MIRRORED.format(ids[k]), (k, partner), back, there))
    at, mirrored = _mirrored(back, pictures[0]), _mirrored(there, pictures[1])
    tried.append((_MIRRORED.format(ids[partner]), (k, partner), at, mirrored))
    others = [c for c in range(len(ids)) if c not in (k, partner)]
    tried.append((_EXCHANGED.format(ids[k], ids[partner]), (partner, k), first, second))
    tried += [(_EXCHANGED.format(ids[k], ids[c]), (c, partner), first, second) for c in others]
    tried += [(_EXCHANGED.format(ids[partner], ids[c]), (k, c), first, second) for c in others]
    counts = [_meeting(images, pair, space, one, other) for _, pair, one, other in tried]
    best = int(np.argmax(counts))
    own = _meeting(images, (k, partner), space, first, second)
    return tried[best][0] if counts[best] >= max(_FEWEST, least, _TIMES * own) else ""


def _features(images: DepthImages, first: Image, second: Image) -> tuple[Pixels, Pixels]:
    """Positions (n, 2) px of the features that two images have in common, in each."""
    reference = prepare_reference(first, np.ones(first.shape, bool), images.settings)
    return matched_features(reference, prepare_current(second, settings=images.settings))


def _mirrored(px: Pixels, image: Image) -> Pixels:
    """Positions (n, 2) px in the mirrored image."""
    return np.column_stack([image.shape[1] - 1 - px[:, 0], px[:, 1]])


def _meeting(images: DepthImages, pair: tuple[int, int], space: DepthRange, first: Pixels, second: Pixels) -> int:
    """Number of features (n, 2) px whose lines of sight from two cameras meet where the surface may be."""
    cameras = [images.cameras[c] for c in pair]
    if not len(first):
        return 0
    px = np.stack([first, second])
    xyz = triangulate(cameras, px)
    miss = np.linalg.norm(reprojection_residuals(cameras, xyz, px), axis=2).max(axis=0)
    with np.errstate(invalid="ignore"):
        return int(((miss < _MISS) & space.holds(cameras[0], xyz) & space.holds(cameras[1], xyz)).sum())
