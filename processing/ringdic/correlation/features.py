"""Start values between cameras without a calibration: matched features and local affine maps through them.

Scale-invariant features (Lowe 2004) survive displacements of any size and foreshortening up to about 40°; the
propagation carries on from there.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.correlation.prepared import Current, Reference, as_8_bit

_PIXELS = 0.45e6  # reduce larger images to this; the detector doubles them again
_FEATURES = 2500
_RATIO = 0.85
_NEAREST = 14
_TRIALS = 120
_TOLERANCE = 3.0  # px of the full image a match may miss its local affine map


def feature_starts(reference: Reference, current: Current, xy: Floats, radius: int) -> Floats:
    """Start values (n, 12) from the affine map through the matched features around each point; NaN without one."""
    p, q = matched_features(reference, current)
    out = np.full((len(xy), 12), np.nan)
    if len(p) < 2 * _NEAREST:
        return out
    distance, near = scipy.spatial.cKDTree(p).query(xy, k=_NEAREST)
    for k in range(len(xy)):
        use = near[k][distance[k] < 8 * radius]
        if len(use) >= 5:
            out[k] = _local_affine(p[use] - xy[k], q[use] - p[use])
    return out


def matched_features(reference: Reference, current: Current) -> tuple[Floats, Floats]:
    """Positions (k, 2) px of mutually best features in the reference (inside its mask) and the current image."""
    scale = min(1.0, np.sqrt(_PIXELS / max(reference.image.size, current.image.size)))
    x0, y0 = reference.origin.astype(int)
    h, w = reference.mask.shape
    ref, mask = reference.image[y0 : y0 + h, x0 : x0 + w], reference.mask.astype(np.uint8) * 255
    points_r, words_r = _features(ref, mask, scale)
    points_c, words_c = _features(current.image, None, scale)
    if len(points_r) < 3 or len(points_c) < 3:
        return np.empty((0, 2)), np.empty((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forward = matcher.knnMatch(words_r, words_c, k=2)
    pairs = [(m[0].queryIdx, m[0].trainIdx, m[0].distance) for m in forward if m[0].distance < _RATIO * m[1].distance]
    best: dict[int, tuple[int, float]] = {}
    for query, train, distance in pairs:  # one reference feature for each current one
        if train not in best or distance < best[train][1]:
            best[train] = (query, distance)
    rows = np.array([(query, train) for train, (query, _) in best.items()], dtype=np.int64).reshape(-1, 2)
    return points_r[rows[:, 0]] + (x0, y0), points_c[rows[:, 1]]


def _features(image: NDArray, mask: NDArray | None, scale: float) -> tuple[Floats, NDArray[np.float32]]:
    """Feature positions (k, 2), px of the given image, and their descriptors (k, 128)."""
    grey: NDArray = as_8_bit(image)
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if mask is not None:
            mask = cv2.resize(mask, (grey.shape[1], grey.shape[0]), interpolation=cv2.INTER_NEAREST)
    found, words = cv2.SIFT.create(nfeatures=_FEATURES).detectAndCompute(grey, mask)
    if words is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    at = np.array([f.pt for f in found], dtype=np.float64)
    # The same words at the same place (several orientations) would spoil the ratio test only a little: keep them.
    return (at + 0.5) / scale - 0.5, np.asarray(words, dtype=np.float32)


def _local_affine(d: Floats, uv: Floats) -> Floats:
    """Parameters (12,) at the origin of the affine map most of the matches agree on; NaN if fewer than five do.

    d : (k, 2) px from the point; uv : (k, 2) px displacement. Least median over drawn triples, then least squares.
    """
    out = np.full(12, np.nan)
    k = len(d)
    draws = np.random.default_rng(0).random((_TRIALS, k)).argsort(axis=1)[:, :3]
    A = np.concatenate([np.ones((k, 1)), d], axis=1)
    area = np.abs(np.linalg.det(A[draws]))
    draws = draws[area > 1e-3 * max(area.max(), 1e-12)]
    if not len(draws):
        return out
    fits = np.linalg.solve(A[draws], uv[draws])
    miss = np.linalg.norm(A @ fits - uv, axis=2)
    votes = (miss < _TOLERANCE).sum(axis=1)
    inside = miss[np.argmax(votes)] < _TOLERANCE
    if inside.sum() < 5:
        return out
    fit = np.linalg.lstsq(A[inside], uv[inside], rcond=None)[0]
    out[:] = 0.0
    out[0:3], out[6:9] = fit[:, 0], fit[:, 1]
    return out
